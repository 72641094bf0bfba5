"""The pictures of the page on MCP, made by the program itself on the simulated rig: pattern, stages, bands, cloud.

python -m tables.pictures     (in bench/; writes docs/images/mcp)
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from scanner.colours import BACKGROUND, text
from scanner.decode import decoder_for
from scanner.decode.stages import Stage
from scanner.filter_settings import FilterSettings
from scanner.patterns import McpPattern, ProjectorSize
from scanner.render import View, render
from scanner.scan import build_scan
from scanner.stage_pictures import stage_picture
from tables.rig import PUBLISHED, decode, shoot

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "images" / "mcp"
PROJECTOR = ProjectorSize(1152, 864)
SCENE = "bust"
PANEL = (380, 290)
"""Width and height of one panel, px"""

CORNER = (540, 330)
"""Of the part of the camera's image that the stages show at full size, px"""

SHOWN = {
    "input": "as captured",
    "regions": "stripe regions",
    "bits-1": "carrier 106, above two sigma",
    "code": "code words on the peaks",
    "grown": "after model, blobs and growth",
    "2x-4x": "all stripes, minima, mid-levels",
}
LEVELS = 8
"""Grey levels are rounded to multiples of this: half the bytes, and no eye sees it in a picture of this size."""


def main() -> int:
    """Write all pictures."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    pictures = {"pattern": pattern_picture(), **stage_pictures(), "cloud": cloud_picture()}
    for name, picture in pictures.items():
        path = FOLDER / f"{name}.png"
        cv2.imwrite(str(path), picture, [cv2.IMWRITE_PNG_COMPRESSION, 9])
        print(f"{path.relative_to(FOLDER.parents[2])}: {path.stat().st_size / 1000:.0f} kB", file=sys.stderr)
    return 0


def pattern_picture() -> Any:
    """A corner of the published pattern beside one of the default pattern, as projected before pre-correction."""
    panels = []
    for pattern, words in ((PUBLISHED, "published"), (McpPattern(), "default")):
        light = pattern.fringe(0, PROJECTOR)[200 : 200 + PANEL[1], : PANEL[0]]
        # Gamma for the screen that shows the picture, so that its light is that of the pattern.
        grey = np.rint(255 * light ** (1 / 2.2)).astype(np.uint8)
        panels.append(_panel(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR), words))
    return _joined([panels])


def stage_pictures() -> dict[str, Any]:
    """Six stages of the reference decoder on one part of the image, and its carrier search."""
    shot = shoot(SCENE, 0, PUBLISHED)
    pictures: dict[str, Any] = {}

    def keep(stage: Stage) -> None:
        name = stage.name.removesuffix("-negligible")
        if name in SHOWN or name == "bands":
            pictures.setdefault(name, stage_picture(stage))

    decoder = decoder_for(shot.sequence, shot.camera, "casey2011", keep)
    decoder.add(0, shot.frame)
    decoder.finish()
    x, y = CORNER
    width, height = PANEL
    panels = [_panel(pictures[name][y : y + height, x : x + width], words) for name, words in SHOWN.items()]
    bands = cv2.resize(pictures["bands"], None, fx=0.65, fy=0.65, interpolation=cv2.INTER_AREA)
    return {"stages": _joined([panels[:3], panels[3:]]), "bands": _rounded(bands)}


def cloud_picture() -> Any:
    """The default decoder's cloud of the same scene, default pattern, from the side."""
    shot = shoot(SCENE, 0, McpPattern())
    # The object alone: the wall behind it would fill the picture.
    scan = build_scan(decode(shot), shot.calibration, FilterSettings(depth=(0.0, 1450.0)))
    assert scan.xyz is not None
    return render(scan.xyz, scan.albedo, (560, 520), View(30.0, 12.0))


def _panel(picture: Any, words: str) -> Any:
    out = np.full((picture.shape[0] + 28, picture.shape[1], 3), BACKGROUND, np.uint8)
    out[28:] = _rounded(picture)
    text(out, words, (6, 20), size=15)
    return out


def _joined(rows: Any) -> Any:
    gap = np.full((rows[0][0].shape[0], 8, 3), BACKGROUND, np.uint8)
    lines = [np.hstack([part for panel in row for part in (panel, gap)][:-1]) for row in rows]
    return np.vstack(lines)


def _rounded(picture: Any) -> Any:
    return np.minimum(np.rint(picture / LEVELS) * LEVELS, 255).astype(np.uint8)


if __name__ == "__main__":
    sys.exit(main())
