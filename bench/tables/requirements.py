"""What the default decoder must reach on the reference scenes, what it aims at, and what it reaches.

The figures and targets are those of bench/mcp_targets.py; this file only asks for them and sets them out.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from tables.page import Grid, Page
from tables.rig import SEEDS

TITLE = "Requirements of the default MCP decoder"
FIGURES = {
    "right": "right stripes",
    "recall": "recall",
    "zmed": "Z median (mm)",
    "1mm": "right inside peaks within 1 mm",
    ">20": "beyond 20 mm",
    "unlit": "outside what is lit",
    "rms": "depth rms, inside (mm)",
    "cover": "dense rows: coverage of lit pixels",
    "dzmed": "dense rows: Z median (mm)",
    "dright": "dense rows: right",
}
NAMES = {
    "published": "The published pattern:",
    "own": "The default pattern:",
    "dense": "The default pattern, dense rows:",
}
HEAD = ["Scene", "Figure", "Reached", "Must", "Aim", "Verdict"]
VERDICTS = {"ok": "aim", "must": "must", "SHORT": "short"}
ROBUST_TARGETS = {"board": (0.999, 1.0), "sphere_board": (0.985, 0.995), "bust": (0.95, 0.99)}
"""Share of right stripes under bad conditions: must, aim."""

ROBUST_BOARD_MM = (0.3, 0.1)
"""Z median of the board under bad conditions."""

TWO_FRAMES = {"zmed": (0.08, 0.05, False), "recall": (0.86, 0.93, True)}
"""The textured board with a second frame under full light: must, aim, whether more is better."""

STRIP_RIGHT = 0.99


def make() -> Page:
    """The page."""
    import mcp_targets as targets  # noqa: PLC0415  (only this page needs its decoders and scenes)

    grids = [Grid(HEAD, rows, NAMES[group]) for group, rows in _scenes(targets).items()]
    grids += [_two_frames(targets), _robust(targets), _strips(targets)]
    return Page(
        "requirements",
        TITLE,
        """
The default decoder on casey2011, true calibration. *Right*: decoded peaks within half a stripe of truth. *Recall*:
true crossings of a stripe's middle on lit surface that have a right peak (one that an edge cuts, or print breaks up, is
named, and counted, though it gives no row). *Inside*: 7 px from edges of depth or
shadow. Verdict: *aim* reached, *must* reached, or *short*. Times are measured by `python bench/mcp.py`.
""",
        grids,
        f"These are requirements of this project, not published figures. Short of what must be: {_short(grids)}.",
    )


def _short(grids: list[Grid]) -> str:
    """What falls short, grid by grid, in words."""
    said = []
    for grid in grids:
        if rows := [f"{row[1]} of {row[0]}" for row in grid.rows if row[-1] == "short"]:
            name = grid.caption.partition(" (")[0].rstrip(":")
            said.append(f"{name[:1].lower()}{name[1:]}: {', '.join(rows)}")
    return "; ".join(said) or "nothing"


def _scenes(targets: Any) -> dict[str, list[Any]]:
    known: dict[Any, Any] = {}
    grids: dict[str, list[Any]] = {}
    patterns = {"own": targets.OWN, "published": targets.PUBLISHED}
    for row in targets.ROWS:
        for scene in row.scenes:
            key = row.pattern, scene
            if key not in known:
                known[key] = targets.scene_figures(scene, patterns[row.pattern], len(SEEDS))
            value = float(targets.worst(known[key], row.figure, row.more))
            grids.setdefault(row.group, []).append(_row(targets, scene, row.figure, value, row.must, row.aim, row.more))
    return grids


def _row(targets: Any, what: str, figure: str, value: float, must: float, aim: float, more: bool) -> list[Any]:
    verdict = VERDICTS[targets.verdict(value, must, aim, more)]
    return [what, FIGURES[figure], value, float(must), float(aim), verdict]


def _two_frames(targets: Any) -> Grid:
    worlds = [targets.take_white(f"casey2011/textured?seed={seed}", targets.OWN) for seed in SEEDS]
    found = [targets.figures_of(targets.measure(*world)[1]) for world in worlds]
    rows = [
        _row(targets, "textured", figure, float(targets.worst(found, figure, more)), must, aim, more)
        for figure, (must, aim, more) in TWO_FRAMES.items()
    ]
    return Grid(HEAD, rows, "Two frames, the second under full light, default pattern:")


def _robust(targets: Any) -> Grid:
    rows = []
    for what, (options, gamma) in targets.ROBUST.items():
        for scene, (must, aim) in ROBUST_TARGETS.items():
            found = targets.scene_figures(scene, targets.OWN, len(SEEDS), options, gamma)
            right = float(targets.worst(found, "right", True))
            rows.append(_row(targets, f"{what}: {scene}", "right", right, must, aim, True))
            if scene == "board":
                median = float(targets.worst(found, "zmed", False))
                rows.append(_row(targets, f"{what}: {scene}", "zmed", median, *ROBUST_BOARD_MM, False))
    return Grid(HEAD, rows, "The default pattern under bad conditions:")


def _strips(targets: Any) -> Grid:
    """Isolated strips: right down to the width that must be, and below either right or undecided."""
    rows = []
    for width, (right, decided, refused) in targets.strips(len(SEEDS)).items():
        wrong = not np.isnan(right) and right < STRIP_RIGHT
        missed = np.isnan(right) or wrong
        verdict = "short" if wrong or (width >= 51 and missed) else "must" if width < 25 or missed else "aim"
        rows.append([f"{width} px", "right stripes", float(right), float(decided), refused, verdict])
    head = ["Strip", "Figure", "Reached", "decided share of crossings", "refused", "Verdict"]
    words = "Isolated strips of a board, default pattern (right at 51 px, aim 25 px; below, undecided and not wrong):"
    return Grid(head, rows, words)
