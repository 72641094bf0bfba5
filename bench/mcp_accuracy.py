"""How right the MCP decoder is, on the simulated rig: a table over scenes, patterns and seeds.

Columns, as in mcp.md ("How to measure"): right, decoded peaks within half a pitch of truth; recall, true crossings of a
stripe's middle on lit surface that have a right peak or name (stripes that an edge cuts or print breaks up have a name
and no row; counted by `peaks` instead of `stripes` recall is the same to .001); z med,
median depth error of right peaks, mm; 1 mm, share of right inside peaks within 1 mm; >20, share of peaks on lit surface
beyond 20 mm; unlit, peaks outside what is lit; rms, depth of right inside peaks; then for dense rows: cover of lit
pixels, z med, right, unlit. Inside: 7 px from edges of depth or shadow. The worst of all seeds is shown.

    python bench/mcp_accuracy.py [--scenes board,bust] [--seeds 3] [--patterns own,published] [--options ambient=0.48]
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

import cv2
import numpy as np

from drivers.registry import open_camera, open_projector
from scanner.clock import VirtualClock
from scanner.decode import decoder_for
from scanner.devices import CameraSettings, TriggerMode
from scanner.errors import DecodeError
from scanner.patterns import CameraFormat, McpPattern, PatternSequence, ProjectorSize
from scanner.patterns.sequence import Precorrection

SCENES = "board,tilt_x30,tilt_y45,sphere_board,sphere_dark,blocks,bust,textured"
OWN = McpPattern()
PUBLISHED = McpPattern(carriers=(90.0, 106.0, 120.0, 132.0), codes=tuple(range(16)), levels="composite")
PATTERNS = {"own": OWN, "published": PUBLISHED}
EDGE_MM = 4.0
"""Depth between neighbouring pixels that makes an edge: a surface seen at 84 degrees on casey2011."""
DARK = 0.045
"""Share of the white frame's 99th percentile below which a surface is no part of the object (sphere_dark's background:
ambient light and all, .03 of it)."""
HEADINGS = [
    "right",
    "recall",
    "zmed",
    "1mm",
    ">20",
    "unlit",
    "rms",
    "|",
    "cover",
    "dzmed",
    "dright",
    "d>20",
    "dunlit",
    "|",
    "ms",
]


def take(device, pattern, precorrection=2.3):
    """One frame of a simulated world, and what there is to know about it."""
    frames, sequence, *known = take_white(device, pattern, precorrection)
    return frames[0], replace(sequence, white=None), *known


def take_white(device, pattern, precorrection=2.3):
    """The same with a frame under full light behind the pattern's: frames, sequence, camera, truth, calibration."""
    clock = VirtualClock()
    camera = open_camera("simulated", device, {}, clock)
    projector = open_projector("simulated", device, {}, clock)
    size = ProjectorSize(projector.capabilities.width, projector.capabilities.height)
    sequence = PatternSequence(size, pattern, white=1, precorrection=Precorrection(gamma=precorrection))
    camera.apply(CameraSettings(exposure_ns=33_333_333))
    projector.load([sequence.image(0)])
    projector.show(0)
    clock.sleep_until(clock.now_ns() + 200_000_000)
    camera.start(TriggerMode.SOFTWARE)
    camera.trigger()
    frame = camera.pop(1_000_000_000).pixels.copy()
    projector.load([np.full((size.height, size.width), 255, np.uint8)])
    projector.show(0)
    clock.sleep_until(clock.now_ns() + 200_000_000)
    camera.trigger()
    white = camera.pop(1_000_000_000).pixels.copy()
    truth, calibration = camera.truth(), camera.true_calibration()
    bright = white > max(DARK * np.percentile(white, 99), 1)
    truth = replace(truth, lit=truth.lit & bright)
    cap = camera.capabilities
    camera.close()
    projector.close()
    return [frame, white], sequence, CameraFormat(cap.width, cap.height, cap.bits), truth, calibration


def depth_per_step(truth, calibration, axis):
    """(H, W): mm of depth for one projector row (column) along each camera ray, numerically."""
    xyz = np.where(np.isfinite(truth.xyz), truth.xyz, 1.0).astype(np.float64)
    k = 0 if axis == "x" else 1
    near, far = (calibration.projector.project(calibration.to_projector(xyz * s))[..., k] for s in (0.9995, 1.0005))
    return 0.001 * xyz[..., 2] / (far - near)


def inside_of(truth):
    """7 px from edges of depth or shadow."""
    z = np.nan_to_num(truth.xyz[..., 2], nan=1e6)
    kernel = np.ones((3, 3), np.uint8)
    edge = (cv2.dilate(z, kernel) - cv2.erode(z, kernel) > 2 * EDGE_MM) | ~truth.lit
    return cv2.dilate(edge.astype(np.uint8), np.ones((15, 15), np.uint8)) == 0


def recall(marked, true, lit, pitch, levels):
    """Share of true crossings of a stripe's middle that have the right stripe within half a pitch along the column."""
    index = (true + 0.5) / pitch - 0.5
    with np.errstate(invalid="ignore"):
        whole = np.floor(index)
        step = index[1:] - index[:-1]
        crossing = (whole[1:] != whole[:-1]) & lit[1:] & lit[:-1] & (np.abs(step) < 0.4)
        want = np.maximum(whole[1:], whole[:-1])
    y, x = np.nonzero(crossing)
    stripe = want[y, x].astype(int)
    possible = (stripe >= 0) & (stripe < len(levels))
    y, x, stripe = y[possible], x[possible], stripe[possible]
    bright = levels[stripe] > 0
    y, x, stripe = y[bright], x[bright], stripe[bright]
    found = np.zeros(len(y), bool)
    for offset in range(-12, 14):
        at = np.clip(y + offset, 0, len(marked) - 1)
        found |= (marked[at, x] == stripe) & (np.abs(index[at, x] - stripe) < 0.5)
    return found.mean() if len(found) else np.nan


def figures_of(values):
    """Figures by their heading."""
    return dict(zip((h for h in HEADINGS if h != "|"), values, strict=True))


def measure(frame, sequence, camera, truth, calibration, *, calibrated=False):
    """What was decoded of one frame (or of a list of them), and figures in the order of HEADINGS.

    calibrated: the decoder, too, knows the calibration, and the carriers' phases by it.

    Raises:
        DecodeError: decoding is refused.
    """
    pattern = sequence.pattern
    begin = time.perf_counter()
    decoder = decoder_for(sequence, camera, calibration=calibration if calibrated else None)
    for position, each in enumerate(frame if isinstance(frame, list) else [frame]):
        decoder.add(position, each)
    decoded = decoder.finish()
    spent = 1e3 * (time.perf_counter() - begin)
    flip = pattern.axis == "x"
    true = truth.columns if flip else truth.rows
    rows = decoded.columns if flip else decoded.rows
    pitch = pattern.pitch_px(sequence.projector)
    per_step = np.abs(depth_per_step(truth, calibration, pattern.axis))
    inside = inside_of(truth)
    x, y = decoded.peaks[:, 0], decoded.peaks[:, 1]
    at = np.rint(y).astype(int), np.rint(x).astype(int)
    lit = truth.lit[at]
    error = np.abs(decoded.peaks[:, 2] - true[at])
    right = lit & (error < pitch / 2)
    smooth = cv2.remap(np.nan_to_num(true, nan=-1e4), x[:, None], y[:, None], cv2.INTER_LINEAR)[:, 0]
    z = np.abs(decoded.peaks[:, 2] - smooth) * per_step[at]
    good = right & inside[at]
    levels = np.array(
        [1.0 if pattern.code_of(s) != 0 or pattern.levels == "equal" else 0.0 for s in range(pattern.stripe_count)]
    )
    maps = [decoded.stripes, true, truth.lit]
    found = recall(*(m.T if flip else m for m in maps), pitch, levels)
    finite = np.isfinite(rows)
    both = finite & truth.lit
    dense = np.abs(rows - true)[both]
    dense_z = dense * per_step[both]
    return decoded, [
        right.mean(),
        found,
        np.median(z[right]),
        (z[good] < 1).mean(),
        (z[lit] > 20).mean(),
        (~lit).mean(),
        np.sqrt((z[good] ** 2).mean()),
        both.sum() / truth.lit.sum(),
        np.median(dense_z),
        (dense < pitch / 2).mean(),
        (dense_z > 20).mean(),
        (finite & ~truth.lit).sum() / max(finite.sum(), 1),
        spent,
    ]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", default=SCENES)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--patterns", default="own,published")
    parser.add_argument("--rig", default="casey2011")
    parser.add_argument("--axis", choices=("x", "y"))
    parser.add_argument("--options", default="", help="of the simulated world, key=value&key=value")
    parser.add_argument("--precorrection", type=float, default=2.3)
    parser.add_argument("--calibrated", action="store_true", help="the decoder knows the rig's calibration, too")
    chosen = parser.parse_args()
    low = {0, 1, 3, 7, 9}  # columns where less is worse
    print(f"{'scene':14s} {'pattern':9s} " + " ".join(f"{h:>6s}" for h in HEADINGS))
    for scene in chosen.scenes.split(","):
        for name in chosen.patterns.split(","):
            pattern = PATTERNS[name]
            pattern = replace(pattern, axis=chosen.axis) if chosen.axis else pattern
            runs = []
            for seed in range(chosen.seeds):
                device = f"{chosen.rig}/{scene}?seed={seed}" + (f"&{chosen.options}" if chosen.options else "")
                try:
                    taken = take(device, pattern, chosen.precorrection)
                    runs.append(measure(*taken, calibrated=chosen.calibrated)[1])
                except DecodeError as error:
                    print(f"{scene:14s} {name:9s} refused: {error}")
            if runs:
                table = np.array(runs)
                worst = [table[:, k].min() if k in low else table[:, k].max() for k in range(table.shape[1])]
                cells = [f"{v:6.4f}" for v in worst[:-1]] + [f"{worst[-1]:5.0f}"]
                cells.insert(7, "     |")
                cells.insert(13, "     |")
                print(f"{scene:14s} {name:9s} " + " ".join(cells), flush=True)


if __name__ == "__main__":
    main()
