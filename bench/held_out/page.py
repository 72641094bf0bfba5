"""What was found, as a page of the documentation: a row for each scene, refusals in their own words."""

from __future__ import annotations

import textwrap
from pathlib import Path

from tables.page import FOLDER, Grid

SAID = Path(__file__).with_name("said.md")

WIDEST = 90
"""Characters of a cell that holds a refusal"""

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

One scan each, of one seed: a row tells of that scan, and not how far scans scatter. Figures are rounded: 0.000 is less
than .0005 (of *Bias*: either way). A row that is not there was not measured: *diamond* with *mcp*, *diamond* with
methods of several frames, and *both* and *gray* on *carton* and *milky*. Where decoding refused a scan its words stand
in the row, cut after a word. *What it shows* tells of some scans besides that have no row.

Methods; but for *both* along one axis, the one that the rig measures depth with; sets of fringes by their frequencies
(cycles over the projector), each shown with so many phase shifts. Frames counted are those of the code; black, white
and order frames stand round them:

- *mcp*: Modified Composite Pattern, one frame, chosen for the rig as `fringed patterns mcp --for RIG` does;
- *published*: the same with the dissertation's stripes, carriers and codes, on any rig;
- *pmp*: phase measuring profilometry, frequencies 1, 8, 64 with 8 shifts each: 24 frames;
- *pmp3*: the same with frequencies 1, 6, 36 and 3 shifts: 9 frames;
- *both*: PMP on both axes, frequencies 1, 8, 48 with 4 shifts: 24 frames;
- *heterodyne*: PMP without a low frequency, 59, 64, 70 with 4 shifts: 12 frames; coordinates follow from their beats;
- *gray*: Gray code of 10 bits, black and white frames and no inverse ones.

Columns; all are shares, from 0 to 1, but for the millimetres:

- *Right* (MCP): of the decoded stripe peaks, those within half a stripe of truth;
- *Recall* (MCP): of the true crossings of a stripe's middle on lit surface, those that have a right peak;
- *Cover*, *Dense cover*: of the lit pixels, those with a coordinate, right or wrong; of MCP, whose peaks are sparse,
  in the dense map made of them. Lit is what the projector's light reaches with more than a twenty-fifth of the
  strongest (97th percentile);
- *Wrong points*: of the points on lit surface, those half a stripe or fringe and more off;
- *Beyond 20 mm*: of the points (of MCP: the peaks) on lit surface, those more than 20 mm off in depth;
- *Unlit*: of all points, those where nothing is lit;
- *Z median*: median of the absolute depth error, without sign, of the points on lit surface (of MCP: of the right
  peaks);
- *Bias*: median of the signed depth error, measured less true, of the points 7 px and more from edges of depth and
  shadow: positive is too far from the camera, negative too near;
- *k = 1*, *k = 2*: of the points 7 px and more from edges, those whose depth error is within one and two of their
  stated sigmas; an honest sigma has .68 and .95.
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
            else [rig, scene, method, _cut(told.refused.partition(":")[2]), *[None] * (len(names) - 1)]
            for rig, scene, method, told in sorted(found, key=lambda row: row[:3])
            if (method in {"mcp", "published"}) == chosen
        ]
        if rows:
            head = ["Rig", "Scene", "Method", *names.values()]
            parts.append(Grid(head, rows, caption, places=3).markdown())
    return "\n".join([*parts, DIFFERS.format(said=SAID.read_text(encoding="utf-8").strip())])


def _cut(said):
    """A refusal's words as far as a cell has room, whole ones."""
    return textwrap.shorten(said, WIDEST, placeholder=" ...")


def write(found):
    """Into the documentation; its path."""
    path = FOLDER / "held-out.md"
    path.write_text(page(found), encoding="utf-8")
    return path
