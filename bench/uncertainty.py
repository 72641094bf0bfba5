"""How honest the stated uncertainty is: shares of points whose error is within k of their stated sigmas.

    python bench/uncertainty.py                             (both, one seed)
    python bench/uncertainty.py coverage [--rigs casey2011,bench2026] [--seeds 1] [--frequencies 1,8,64] [--shifts 8]
    python bench/uncertainty.py response [--rigs casey2011] [--seeds 1]
    python bench/uncertainty.py ends

`coverage`: a row a class of points. board, bust: 7 px and more from edges of depth or shadow; edges: points of the bust
that the filters left within 7 px of one; dark: the board at a tenth of the light; gamma: projected with an exponent off
by .1; defocus: projector blur of 3 px; textured: a board of print and checkers, albedo .05 to .9; blocks: boxes without
their edges. Of each, in per cent: `k=1`, `k=2`, error against truth within 1 and 2 stated sigmas; `rnd1`, `rnd2`, the
same of the difference of two scans that differ in nothing but noise, over sqrt 2, in which what is systematic cancels;
then the median sigma and the error's rms in mm. An honest sigma has 68.3 and 95.4; asked for are 60-76 and 92-98. The
worst of all seeds (farthest from 68.3) is shown.

`response`: the board by three shifts, projected with an exponent off by .3 either way: depth rms in mm as it is; with
`fringed decode --correct-ripple`; projected again with the gamma that the capture's own harmonics tell, and with the
one that flat grey levels tell; and with the right one. The worst of all seeds and of both ways. Asked for on casey2011
are .22 mm with (1,8,32) and .13 mm with (1,8,64), projected again.

`ends`: the board of bench2026, where the end of the projector's columns is in view, by PMP and Gray + PMP through blurs
of .7 to 6 projector px; by distance from the end: the share of places with a value, the median error in px, and per
cent within 2 stated sigmas, beside what it is without `field_end`. Exit status 1 if a figure is missed.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from dataclasses import dataclass

import numpy as np

from drivers.registry import open_camera, open_projector
from scanner.calibration.grey_levels import LEVELS, response_of_levels
from scanner.calibration.response import response_of_frames
from scanner.clock import VirtualClock
from scanner.compare import inside
from scanner.contrast import widen_at_edges
from scanner.decode import decoder_for, graypmp, pmp
from scanner.devices import CameraSettings, TriggerMode
from scanner.patterns import CameraFormat, PatternSequence, PmpPattern, ProjectorSize
from scanner.patterns.graypmp import default_gray_pmp
from scanner.patterns.sequence import Precorrection
from scanner.ripple_correction import widen_by_ripple, without_ripple
from scanner.scan import build_scan

RIGHT_GAMMA = 2.3
HONEST = ((60, 76), (92, 98))
"""Per cent of points within one and two sigmas"""
AFTER_MM = {32.0: 0.22, 64.0: 0.13}
"""Of three shifts on casey2011 by finest frequency, with the response told by harmonics or grey levels"""

DISTANCES = (-5, 0, 1, 2, 4, 6, 8, 10, 12, 16, 30)
"""From the end of the field inward, projector px: borders of the classes of `ends`"""


@dataclass(frozen=True)
class Class:
    """Points of one kind: scene, options of the simulated world, the gamma projected with, which points count."""

    name: str
    scene: str
    options: str = ""
    gamma: float = RIGHT_GAMMA
    edges: bool = False


CLASSES = (
    Class("board", "board"),
    Class("bust", "bust"),
    Class("edges", "bust", edges=True),
    Class("dark", "board", "exposure_scale=0.1"),
    Class("gamma +.1", "board", gamma=RIGHT_GAMMA + 0.1),
    Class("gamma -.1", "board", gamma=RIGHT_GAMMA - 0.1),
    Class("defocus", "board", "projector_blur_sigma_px=3"),
    Class("textured", "textured"),
    Class("blocks", "blocks"),
)


@dataclass(frozen=True)
class Taken:
    """One scan and what there is to know about it."""

    scan: object
    truth: object
    decoded: object
    calibration: object
    sequence: object
    camera: object
    frames: list


def take(rig, kind, pattern, seed):
    """Project and capture a pattern, decode and triangulate it with the true calibration."""
    device = f"{rig}/{kind.scene}?seed={seed}" + (f"&{kind.options}" if kind.options else "")
    clock = VirtualClock()
    camera, projector = (open_("simulated", device, {}, clock) for open_ in (open_camera, open_projector))
    cap = camera.capabilities
    size = ProjectorSize(projector.capabilities.width, projector.capabilities.height)
    sequence = PatternSequence(size, pattern, precorrection=Precorrection(gamma=kind.gamma))
    camera_format, frames = CameraFormat(cap.width, cap.height, cap.bits), []
    decoder = decoder_for(sequence, camera_format)
    camera.apply(CameraSettings(exposure_ns=33_333_333))
    projector.load([sequence.image(k) for k in range(len(sequence))])
    camera.start(TriggerMode.SOFTWARE)
    for position in range(len(sequence)):
        projector.show(position)
        clock.sleep_until(clock.now_ns() + 100_000_000)
        camera.trigger()
        frames.append(camera.pop(1_000_000_000).pixels.copy())
        decoder.add(position, frames[-1])
    decoded, truth, calibration = decoder.finish(), camera.truth(), camera.true_calibration()
    camera.close()
    projector.close()
    scan = widen_at_edges(build_scan(decoded, calibration), calibration.phase_axis)
    scan = widen_by_ripple(scan, sequence, calibration.phase_axis)
    return Taken(scan, truth, decoded, calibration, sequence, camera_format, frames)


def coverage(kind, one, other):
    """k=1, k=2, rnd1, rnd2 in per cent, median sigma and rms of the error in mm, points."""
    clear = inside(one.truth)
    where = (~clear if kind.edges else clear) & one.truth.lit
    z, sigma = one.scan.xyz[..., 2], one.scan.sigma_z
    error = z - one.truth.xyz[..., 2]
    where = where & np.isfinite(error) & np.isfinite(sigma)
    both = where & np.isfinite(other.scan.xyz[..., 2])
    apart = np.abs(z - other.scan.xyz[..., 2])[both] / np.hypot(sigma, other.scan.sigma_z)[both]
    off = np.abs(error)[where] / sigma[where]
    shares = [100 * np.mean(values <= k) for values in (off, apart) for k in (1, 2)]
    return [*shares, float(np.median(sigma[where])), float(np.sqrt(np.mean(error[where] ** 2))), int(where.sum())]


def print_coverage(chosen):
    """The table; whether every class is honest."""
    honest = True
    frequencies = tuple(float(f) for f in chosen.frequencies.split(","))
    for rig in chosen.rigs.split(","):
        axis = "x" if rig == "bench2026" else "y"
        pattern = PmpPattern((axis,), frequencies, (chosen.shifts,) * len(frequencies))
        print(f"{rig}, ({chosen.frequencies}) x {chosen.shifts}")
        print("| class | k=1 | k=2 | rnd1 | rnd2 | sigma mm | rms mm | points |\n|---|" + "---:|" * 7)
        for kind in CLASSES:
            if chosen.only and kind.name not in chosen.only.split(","):
                continue
            rows = [
                coverage(kind, take(rig, kind, pattern, seed), take(rig, kind, pattern, seed + 1000))
                for seed in range(chosen.seeds)
            ]
            worst = max(rows, key=lambda row: max(abs(row[0] - 68.3), abs(row[2] - 68.3)))
            honest &= all(low <= row[k] <= high for row in rows for k, (low, high) in enumerate(HONEST))
            cells = [f"{v:.1f}" for v in worst[:4]] + [f"{v:.4f}" for v in worst[4:6]] + [f"{worst[6]:,}"]
            print(f"| {kind.name} | " + " | ".join(cells) + " |", flush=True)

    return honest


def depth_rms(taken, decoded=None):
    """Inside, mm."""
    scan = taken.scan if decoded is None else build_scan(decoded, taken.calibration)
    error = (scan.xyz[..., 2] - taken.truth.xyz[..., 2])[inside(taken.truth)]
    return float(np.sqrt(np.nanmean(error**2)))


def gamma_of_levels(rig, seed):
    """What flat grey levels tell of the projector."""
    clock = VirtualClock()
    device = f"{rig}/board?seed={seed}"
    camera, projector = (open_("simulated", device, {}, clock) for open_ in (open_camera, open_projector))
    cap, size = camera.capabilities, projector.capabilities
    camera.apply(CameraSettings(exposure_ns=33_333_333))
    projector.load([np.full((size.height, size.width), v, np.uint8) for v in LEVELS])
    camera.start(TriggerMode.SOFTWARE)
    frames = []
    for i in range(len(LEVELS)):
        projector.show(i)
        clock.sleep_until(clock.now_ns() + 100_000_000)
        camera.trigger()
        frames.append(camera.pop(1_000_000_000).pixels.copy())
    camera.close()
    projector.close()
    return response_of_levels(LEVELS, frames, (1 << cap.bits) - 1).gamma


def print_response(chosen):
    """The table; whether what is asked for is reached."""
    reached = True
    print("| rig | pattern | as it is | --correct-ripple | by harmonics | by grey levels | right gamma |")
    print("|---|---|" + "---:|" * 5)
    for rig in chosen.rigs.split(","):
        axis = "x" if rig == "bench2026" else "y"
        for frequencies in ((1.0, 8.0, 32.0), (1.0, 8.0, 64.0)):
            pattern = PmpPattern((axis,), frequencies, (3, 3, 3))
            rows = []
            for seed in range(chosen.seeds):
                levels = depth_rms(take(rig, Class("", "board", gamma=gamma_of_levels(rig, seed)), pattern, seed + 100))
                right = depth_rms(take(rig, Class("", "board"), pattern, seed + 100))
                for off in (-0.3, 0.3):
                    wrong = take(rig, Class("", "board", gamma=RIGHT_GAMMA + off), pattern, seed)
                    straight = without_ripple(wrong.decoded, wrong.sequence)
                    told = response_of_frames(wrong.sequence, wrong.camera, wrong.frames).gamma
                    again = take(rig, Class("", "board", gamma=told), pattern, seed + 100)
                    rows.append([depth_rms(wrong), depth_rms(wrong, straight), depth_rms(again), levels, right])
            worst = np.max(rows, axis=0)
            reached &= rig != "casey2011" or bool(worst[2:4].max() <= AFTER_MM[frequencies[-1]])
            name = ",".join(f"{f:g}" for f in frequencies)
            print(f"| {rig} | ({name}) x 3 | " + " | ".join(f"{v:.3f}" for v in worst) + " |", flush=True)
    return reached


def at_end(taken):
    """By distance: share of places with a value, median error in px, per cent within 2 sigmas."""
    truth, values, sigma = taken.truth.columns, taken.decoded.columns, taken.decoded.sigma_columns
    distance, off = taken.sequence.projector.width - 0.5 - truth, np.abs(values - truth)
    rows = []
    for near, far in itertools.pairwise(DISTANCES):
        places = (distance >= near) & (distance < far)
        there = places & np.isfinite(values)
        error = float(np.median(off[there])) if there.any() else np.nan
        within = 100 * float(np.mean(off[there] <= 2 * sigma[there])) if there.any() else np.nan
        rows.append((there.sum() / max(places.sum(), 1), error, within))
    return rows


def print_ends():
    """The tables; whether nine in ten points of every class that has a value are within 2 sigmas."""
    honest, minds = True, pmp.mind_ends
    size = ProjectorSize(1920, 1080)
    for pattern in (PmpPattern(("x",)), default_gray_pmp(("x",), size, 64.0)):
        for blur in (0.7, 2, 4, 6):
            kind, found = Class("", "board", f"projector_blur_sigma_px={blur:g}"), []
            for mind in (lambda *_: None, minds):
                pmp.mind_ends = graypmp.mind_ends = mind
                found.append(at_end(take("bench2026", kind, pattern, 0)))
            print(f"{pattern.method}, blur {blur:g} px\n| from the end, px | before | | | after | | |")
            print("|---|" + "---:|" * 6 + "\n| | value | error | k=2 | value | error | k=2 |")
            for (near, far), before, after in zip(itertools.pairwise(DISTANCES), *found, strict=True):
                cells = [f"{share:.2f} | {error:.2f} | {within:.0f}" for share, error, within in (before, after)]
                print(f"| {near} to {far} | " + " | ".join(cells).replace("nan", "") + " |", flush=True)
                honest &= near < 0 or not after[2] < 90
    return honest


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("coverage", "response", "ends", "all"), nargs="?", default="all")
    parser.add_argument("--rigs", default="casey2011,bench2026")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--frequencies", default="1,8,64")
    parser.add_argument("--shifts", type=int, default=8)
    parser.add_argument("--only", default="", help="classes, by name")
    chosen = parser.parse_args()
    missed = []
    if chosen.what in ("coverage", "all") and not print_coverage(chosen):
        missed.append("a class lies outside 60-76 and 92-98 per cent")
    if chosen.what in ("response", "all") and not print_response(chosen):
        missed.append("a response leaves more than is asked for")
    if chosen.what == "ends" and not print_ends():
        missed.append("errors near the end of the field are beyond what is stated")
    print("\n".join(missed))
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
