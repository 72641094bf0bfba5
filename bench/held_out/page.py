"""What was found, as a page of the documentation: a row for each scene, refusals in their own words."""

from __future__ import annotations

from pathlib import Path

from tables.page import FOLDER, Grid

SAID = Path(__file__).with_name("said.md")

STRIPES = {
    "right": "Right",
    "recall": "Recall",
    "pzmed": "Z median (mm)",
    "pbeyond": "Beyond 20 mm",
    "cover": "Dense cover",
    "wrong_pt": "Wrong points",
    "k1": "k = 1",
    "k2": "k = 2",
}
PIXELS = {
    "cover": "Cover",
    "wrong_pt": "Wrong points",
    "beyond": "Beyond 20 mm",
    "unlit": "Unlit",
    "zmed": "Z median (mm)",
    "bias": "Bias (mm)",
    "k1": "k = 1",
    "k2": "k = 2",
}

WORDS = """# Scenes and rigs that nobody tuned for

Made by `cd bench && python -m held_out --page`; one seed. The renderer shares nothing with the simulated devices of
the other tables: signed distances and sphere tracing, lenses with tangential distortion, cos^4 and mechanical
vignetting of projector and camera, the projector's depth of focus, GGX gloss, light that surfaces throw at one another
(radiosity on patches), light that spreads under a surface, shot noise, black level, clipping, ambient light. Captures
are folders, and decoded as `fringed decode` does, with the true calibration.

- *roll*: projector above the camera, rolled by 14 degrees, 1280 x 800; camera 1392 x 1040.
- *diamond*: projector beside it, rolled by -12 degrees, 912 x 1140 mirrors on their corners: columns twice as wide as
  rows are high; camera 1600 x 1200.
- *diagonal*: projector up and to the right, rolled by 19 degrees, pixels a quarter wider than high, 1280 x 720; camera
  1224 x 1024 behind a lens of 56 degrees.

*Right*, *recall*, *beyond 20 mm* as in [requirements](requirements.md). *Wrong points*: of all points on lit surface,
those half a stripe or fringe and more off. *Unlit*: points where nothing is lit. *k = 1, 2*: share of the points 7 px
from edges whose error is within one and two of their stated sigmas; an honest sigma has .68 and .95.
"""

DIFFERS = """## What it shows

{said}

[All tables](index.md)
"""


def page(found):
    """Markdown of (rig, scene, method, Found) rows, ended by what SAID says of them."""
    parts = [WORDS]
    for caption, names, chosen in (
        (
            "MCP, the pattern that `fringed patterns mcp --for RIG` chooses (*mcp*) and the published one:",
            STRIPES,
            True,
        ),
        ("Methods of several frames, camera at half of its pixels:", PIXELS, False),
    ):
        rows = [
            [rig, scene, method, *(told.figures.get(name) for name in names)]
            if told.refused is None
            else [rig, scene, method, told.refused.partition(":")[2].strip()[:90], *[None] * (len(names) - 1)]
            for rig, scene, method, told in sorted(found, key=lambda row: row[:3])
            if (method in {"mcp", "published"}) == chosen
        ]
        if rows:
            head = ["Rig", "Scene", "Method", *names.values()]
            parts.append(Grid(head, rows, caption, places=3).markdown())
    return "\n".join([*parts, DIFFERS.format(said=SAID.read_text(encoding="utf-8").strip())])


def write(found):
    """Into the documentation; its path."""
    path = FOLDER / "held-out.md"
    path.write_text(page(found), encoding="utf-8")
    return path
