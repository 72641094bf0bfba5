"""The picture of a scan: a rendered view of the cloud, and the maps of depth, albedo and confidence beside it.

Without a calibration the projector rows (or columns) stand where the view would be, in pixels.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from scanner.colours import (
    ACCENT,
    BACKGROUND,
    DIM,
    LINE,
    PANEL,
    Picture,
    Scale,
    colour_bar,
    fit,
    grouped,
    scale_of,
    text,
    text_width,
)
from scanner.digits import alone
from scanner.render import View, render

if TYPE_CHECKING:
    from scanner.scan import Scan

Box = tuple[int, int, int, int]
"""x, y, width, height, px"""

WIDTH, HEIGHT = 1920, 1200
_MARGIN, _GAP, _TITLE = 28, 18, 84
_SIDE = 600
"""width of the column of maps"""

STATED = "mm for 95 % of points"
"""Caption of the stated uncertainty"""


def preview_picture(scan: Scan) -> Picture:
    """(1200, 1920, 3) uint8 BGR."""
    picture = np.empty((HEIGHT, WIDTH, 3), np.uint8)
    picture[:] = BACKGROUND
    _title(picture, scan)
    top, bottom = _TITLE, HEIGHT - _MARGIN
    main = (_MARGIN, top, WIDTH - 2 * _MARGIN - _GAP - _SIDE, bottom - top)
    panels = _side_boxes(WIDTH - _MARGIN - _SIDE, top, bottom)
    measured, name, unit = _measured(scan)
    confidence = np.where(scan.decoded, scan.confidence, np.nan)
    if scan.xyz is None:
        _map_panel(picture, main, name, measured, scale_of(measured, "viridis", unit))
        _map_panel(picture, panels[0], "Modulation", scan.modulation, _grey(scan.modulation))
    else:
        _view_panel(picture, main, scan)
        depth = scan.xyz[..., 2]
        _map_panel(picture, panels[0], "Depth", depth, scale_of(depth, "viridis", "mm", reverse=True))
    _map_panel(picture, panels[1], "Albedo", scan.albedo, _grey(scan.albedo))
    _map_panel(picture, panels[2], "Confidence", confidence, Scale(0.0, 1.0, "trust"))
    return picture


def _measured(scan: Scan) -> tuple[NDArray[Any], str, str]:
    if scan.rows is not None:
        return scan.rows, "Projector row", "px"
    assert scan.columns is not None  # noqa: S101  a scan has one of them
    return scan.columns, "Projector column", "px"


def _grey(values: NDArray[Any]) -> Scale:
    there = _sample(values)
    high = float(np.percentile(there, 99.5)) if there.size else 1.0
    return Scale(0.0, max(high, 1e-6), "grey", "grey levels")


def _title(picture: Picture, scan: Scan) -> None:
    width = text(picture, "fringed", (_MARGIN, 54), size=34, weight=600, colour=ACCENT)
    x = _MARGIN + width + 28
    cv2.line(picture, (x, 28), (x, 60), LINE, 1)
    x += 28
    for words, caption in figures(scan):
        if caption == STATED:
            text(picture, left_out(scan), (x, 72), size=14, colour=DIM)
        end = text(picture, words, (x, 48), size=24, weight=500)
        x += end + 9
        x += text(picture, caption, (x, 48), size=17, colour=DIM) + 32


def figures(scan: Scan) -> list[tuple[str, str]]:
    """Number and what it is, for the title."""
    count = int(np.count_nonzero(scan.valid))
    told = [(grouped(count), "points" if scan.xyz is not None else "pixels decoded")]
    if (lit := int(np.count_nonzero(scan.lit))) > 0:
        share = count / lit if scan.xyz is not None else scan.coverage
        told.append((f"{100 * share:.1f} %", "of where the pattern shows"))
    if scan.xyz is not None and (depth := _sample(scan.xyz[..., 2])).size:
        low, high = np.percentile(depth, (1, 99))
        told.append((f"{grouped(low)} … {grouped(high)}", "mm depth (1st to 99th percentile)"))
    return [*told, *_uncertainty(scan)]


def left_out(scan: Scan) -> str:
    """What the stated uncertainty has no part of, as the terminal says it; empty where it has all."""
    unknown = (scan.report.get("uncertainty") or {}).get("unknown") or ()
    return f"unknown, and not in it: {', '.join(unknown)}" if unknown else ""


def _uncertainty(scan: Scan) -> list[tuple[str, str]]:
    """What the terminal says, where the scan has a budget; and the random part of it, k = 2 too."""
    told = []
    budget = scan.report.get("uncertainty") or {}
    if (within := budget.get("within_mm")) is not None:
        least = "at least " if "method" in budget.get("unknown", ()) else ""
        told.append((f"{least}± {alone(within)}", STATED))
    # Of codes the cells' width is no chance: their budget has no random part.
    if budget.get("random_mm") != 0 and scan.sigma_z is not None and (sigma := _sample(scan.sigma_z)).size:
        told.append((f"± {alone(2 * float(np.median(sigma)))}", "mm random (k = 2)"))
    return told


def _sample(values: NDArray[Any]) -> NDArray[Any]:
    """(N,) up to a quarter of a million of the values that are there."""
    there = values[np.isfinite(values)]
    thinned: NDArray[Any] = there[:: max(1, there.size // 250_000)]
    return thinned


def _side_boxes(x: int, top: int, bottom: int) -> list[Box]:
    height = (bottom - top - 2 * _GAP) // 3
    return [(x, top + i * (height + _GAP), _SIDE, height) for i in range(3)]


def _panel(picture: Picture, box: Box, title: str) -> None:
    x, y, width, height = box
    picture[y : y + height, x : x + width] = PANEL
    text(picture, title, (x + 18, y + 30), size=18, weight=500)


def _map_panel(picture: Picture, box: Box, title: str, values: NDArray[Any], scale: Scale) -> None:
    _panel(picture, box, title)
    x, y, width, height = box
    room = (width - 36 - 110, height - 46 - 16)
    small = scale.apply(fit(values, *room), missing=(44, 37, 32))
    h, w = small.shape[:2]
    left, top = x + 18 + (room[0] - w) // 2, y + 46 + (room[1] - h) // 2
    picture[top : top + h, left : left + w] = small
    bar = (x + width - 100, y + 66, 14, height - 66 - 20)
    colour_bar(picture, scale, bar)


def _view_panel(picture: Picture, box: Box, scan: Scan) -> None:
    assert scan.xyz is not None  # noqa: S101  only called with points
    x, y, width, height = box
    view = _view(scan)
    picture[y : y + height, x : x + width] = render(scan.xyz, scan.albedo, (width, height), view)
    side = "right" if view.azimuth_deg > 0 else "left"
    words = f"seen from {abs(view.azimuth_deg):.0f}° to the {side} of the camera, {view.elevation_deg:.0f}° above"
    plate = text_width(words, size=15) + 28
    corner = picture[y + height - 44 : y + height - 12, x + width - plate - 12 : x + width - 12]
    corner[:] = cv2.addWeighted(corner, 0.25, np.full_like(corner, PANEL), 0.75, 0)
    text(picture, words, (x + width - plate + 2, y + height - 22), size=15, colour=DIM)


def _view(scan: Scan) -> View:
    """From the projector's side, where its shadows are not seen."""
    rig = scan.report.get("rig") or {}
    centre = rig.get("projector_centre_mm") or (0.0, 0.0, 0.0)
    return View(azimuth_deg=35.0 if centre[0] >= 0 else -35.0)
