"""The targets of the default MCP decoder, row by row: what is reached, what must be and what it aims at.

    python bench/mcp_targets.py [--seeds 3] [--only texture,blocks] [--short] [--calibrated]

Every figure is the worst of all seeds on casey2011 with the true calibration (the decoder itself knows it with
--calibrated alone); `how right` is said in mcp_accuracy.py.
A line ends in `ok` (the aim is reached), `must` (what must be is) or `SHORT`; exit status 1 if one does. Time is not
measured here but in mcp.py.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass, replace

import numpy as np
from mcp_accuracy import OWN, PUBLISHED, figures_of, measure, take, take_white

from scanner.decode import decoder_for
from scanner.errors import DecodeError

BOARDS = ("board", "tilt_x15", "tilt_x30", "tilt_x45", "tilt_y15", "tilt_y30", "tilt_y45")
STRIPS = (301, 201, 101, 75, 51, 35, 25, 17, 11, 7, 5, 3)
"""Widths of isolated strips, px"""
ROBUST = {
    "dark x0.2": ("exposure_scale=0.2", 2.3),
    "ambient 12x": ("ambient=0.48", 2.3),
    "defocus 1.5 px": ("projector_blur_sigma_px=1.655&camera_blur_sigma_px=0.7", 2.3),
    "exposure x2.5": ("exposure_scale=2.5", 2.3),
    "gamma off by -.3": ("", 2.0),
    "gamma off by +.3": ("", 2.6),
}
"""Options of the simulated world, and the gamma that the pattern is corrected for. Defocus adds in squares."""


@dataclass(frozen=True)
class Row:
    """One figure asked for. more: whether more is better."""

    group: str
    name: str
    pattern: str
    scenes: tuple[str, ...]
    figure: str
    must: float
    aim: float
    more: bool = True


def _rows(group, pattern, figure, more, **targets):
    return [
        Row(group, figure, pattern, BOARDS if scene == "boards" else (scene,), figure, must, aim, more)
        for scene, (must, aim) in targets.items()
    ]


ROWS = [
    *_rows(
        "published",
        "published",
        "right",
        True,
        board=(0.999, 1),
        bust=(0.985, 0.998),
        sphere_board=(0.985, 0.995),
        sphere_dark=(0.985, 0.996),
        blocks=(0.985, 0.997),
    ),
    *_rows(
        "published",
        "published",
        "recall",
        True,
        board=(0.995, 0.999),
        bust=(0.88, 0.94),
        sphere_board=(0.965, 0.985),
        sphere_dark=(0.93, 0.975),
        blocks=(0.91, 0.95),
    ),
    *_rows(
        "own",
        "own",
        "right",
        True,
        boards=(0.9995, 1),
        bust=(0.993, 0.9998),
        sphere_board=(0.99, 0.998),
        blocks=(0.985, 0.997),
        textured=(0.985, 0.998),
    ),
    *_rows(
        "own",
        "own",
        "recall",
        True,
        boards=(0.998, 1),
        bust=(0.93, 0.965),
        sphere_board=(0.975, 0.99),
        blocks=(0.945, 0.975),
        textured=(0.86, 0.93),
    ),
    *_rows(
        "own",
        "own",
        "zmed",
        False,
        boards=(0.07, 0.04),
        bust=(0.22, 0.12),
        sphere_board=(0.09, 0.05),
        blocks=(0.11, 0.065),
        textured=(1.1, 0.75),
    ),
    *_rows(
        "own",
        "own",
        "1mm",
        True,
        boards=(0.995, 1),
        bust=(0.86, 0.93),
        sphere_board=(0.97, 0.99),
        blocks=(0.90, 0.945),
    ),
    *_rows(
        "own",
        "own",
        ">20",
        False,
        boards=(0.003, 0.0005),
        bust=(0.02, 0.005),
        sphere_board=(0.02, 0.005),
        sphere_dark=(0.02, 0.005),
        blocks=(0.02, 0.005),
        textured=(0.02, 0.005),
    ),
    *_rows(
        "own",
        "own",
        "unlit",
        False,
        boards=(0.03, 0.005),
        bust=(0.03, 0.005),
        sphere_board=(0.03, 0.005),
        sphere_dark=(0.03, 0.005),
        blocks=(0.03, 0.005),
    ),
    *_rows("own", "own", "rms", False, boards=(0.12, 0.05)),
    *_rows("dense", "own", "cover", True, boards=(0.96, 0.995), bust=(0.78, 0.95)),
    *_rows("dense", "own", "dzmed", False, boards=(0.08, 0.03), bust=(0.55, 0.2)),
    *_rows("dense", "own", "dright", True, boards=(0.99, 0.999), bust=(0.99, 0.999)),
]


def scene_figures(scene, pattern, seeds, options="", gamma=2.3, *, calibrated=False):
    """Figures by name, one dictionary a seed."""
    found = []
    for seed in range(seeds):
        device = f"casey2011/{scene}?seed={seed}" + (f"&{options}" if options else "")
        try:
            found.append(figures_of(measure(*take(device, pattern, gamma), calibrated=calibrated)[1]))
        except DecodeError as error:
            print(f"{scene} seed {seed} refused: {error}")
            found.append({})
    return found


def worst(found, figure, more):
    """Of all dictionaries; a refusal is NaN."""
    values = [f.get(figure, np.nan) for f in found]
    return min(values, key=lambda v: (not np.isnan(v), v)) if more else max(values, key=lambda v: (np.isnan(v), v))


def strips(seeds, *, calibrated=False):
    """Right share of what is decided, and decided share of true crossings, at each width of an isolated strip.

    A board seen through a slit: all else is dark (the board's frame with the projector off). Strips stand every 60 px.
    """
    result = {}
    runs = [take(f"casey2011/board?seed={seed}", OWN) for seed in range(seeds)]
    for width in STRIPS:
        right = decided = crossings = 0
        refused = 0
        for seed, (frame, sequence, camera, truth, calibration) in enumerate(runs):
            random = np.random.default_rng(seed)
            dark = np.clip(random.normal(3, 1, frame.shape), 0, 255).astype(frame.dtype)
            for left in np.linspace(60, frame.shape[1] - 60 - width, 4).astype(int):
                inside = np.zeros(frame.shape, bool)
                inside[:, left : left + width] = True
                decoder = decoder_for(sequence, camera, calibration=calibration if calibrated else None)
                decoder.add(0, np.where(inside, frame, dark))
                try:
                    peaks = decoder.finish().peaks
                except DecodeError:
                    refused += 1
                    continue
                at = np.rint(peaks[:, 1]).astype(int), np.rint(peaks[:, 0]).astype(int)
                pitch = sequence.pattern.pitch_px(sequence.projector)
                good = inside[at] & (np.abs(peaks[:, 2] - truth.rows[at]) < pitch / 2)
                right, decided = right + good.sum(), decided + len(peaks)
                crossings += len(np.unique(np.floor((truth.rows[:, left] + 0.5) / pitch))) * (width / 4)
        result[width] = (right / decided if decided else np.nan, decided / max(crossings, 1), refused)
    return result


def verdict(value, must, aim, more):
    """`ok`, `must` or `SHORT`."""
    if np.isnan(value):
        return "SHORT"
    reaches = (lambda limit: value >= limit) if more else (lambda limit: value <= limit)
    return "ok" if reaches(aim) else "must" if reaches(must) else "SHORT"


def line(group, what, figure, value, must, aim, more, short):
    """Print one row; whether it falls short."""
    said = verdict(value, must, aim, more)
    if not short or said == "SHORT":
        print(f"{group:10s} {what:16s} {figure:8s} {value:9.4f}   must {must:7.4f}  aim {aim:7.4f}  {said}", flush=True)
    return said == "SHORT"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--only", default="", help="scenes or groups (published, own, dense, robust, strips, white)")
    parser.add_argument("--short", action="store_true", help="print only what falls short")
    parser.add_argument("--calibrated", action="store_true", help="the decoder knows the rig's calibration, too")
    chosen = parser.parse_args()
    only = set(filter(None, chosen.only.split(",")))
    patterns = {"own": OWN, "published": PUBLISHED}
    known, missed = {}, 0
    for row in ROWS:
        for scene in row.scenes:
            if only and not only & {row.group, scene}:
                continue
            if (row.pattern, scene) not in known:
                known[row.pattern, scene] = scene_figures(
                    scene, patterns[row.pattern], chosen.seeds, calibrated=chosen.calibrated
                )
            value = worst(known[row.pattern, scene], row.figure, row.more)
            missed += line(row.group, scene, row.name, value, row.must, row.aim, row.more, chosen.short)
    if not only or "robust" in only:
        missed += robust(chosen.seeds, chosen.short, calibrated=chosen.calibrated)
    if not only or "strips" in only:
        for width, (right, share, refused) in strips(chosen.seeds, calibrated=chosen.calibrated).items():
            told = f"strips     {width:3d} px           right {right:9.4f}   decided {share:6.3f}  refused {refused}"
            wide = "SHORT" if (width >= 51 and not (right >= 0.99 and share >= 0.9)) else ""
            wrong = "SHORT" if width < 51 and right < 0.99 else ""
            missed += bool(wide or wrong)
            print(told, wide or wrong or ("ok" if width >= 25 and right >= 0.99 else ""), flush=True)
    if not only or "white" in only:
        found = []
        for seed in range(chosen.seeds):
            found.append(figures_of(measure(*take_white(f"casey2011/textured?seed={seed}", OWN))[1]))
        missed += line("white", "textured", "zmed", worst(found, "zmed", False), 0.08, 0.05, False, chosen.short)
        missed += line("white", "textured", "recall", worst(found, "recall", True), 0.86, 0.93, True, chosen.short)
    return 1 if missed else 0


def robust(seeds, short, *, calibrated=False):
    """Boards, sphere and bust under bad conditions; how many figures fall short."""
    missed = 0
    targets = {"board": (0.999, 1), "sphere_board": (0.985, 0.995), "bust": (0.95, 0.99)}
    for what, (options, gamma) in ROBUST.items():
        for scene, (must, aim) in targets.items():
            found = scene_figures(scene, replace(OWN), seeds, options, gamma, calibrated=calibrated)
            missed += line(what[:10], scene, "right", worst(found, "right", True), must, aim, True, short)
            if scene == "board":
                missed += line(what[:10], scene, "zmed", worst(found, "zmed", False), 0.3, 0.1, False, short)
            missed += line(what[:10], scene, "recall", worst(found, "recall", True), 0.5, 0.9, True, short)
    return missed


if __name__ == "__main__":
    sys.exit(main())
