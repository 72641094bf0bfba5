"""Targets as SVG, to print: lengths in millimetres, and a ruler that shows whether the printer kept them."""

from __future__ import annotations

from dataclasses import dataclass
from xml.sax.saxutils import escape

import numpy as np
from numpy.typing import NDArray

from scanner.calibration.targets import Target
from scanner.errors import ConfigError

Array = NDArray[np.float64]

RULER_ROOM_MM = 22.0
"""Below the target: ruler, numbers and name."""

LEAST_WIDTH_MM = 110.0
"""Of the sheet: the line below the ruler has room, and a ruler longer than a small target"""


@dataclass(frozen=True)
class Drawing:
    """text: the SVG; sizes of the paper and of the ruler, mm."""

    text: str
    width_mm: float
    height_mm: float
    ruler_mm: float

    @property
    def page(self) -> str | None:
        """The smallest page (ISO 216, either way round) that holds it; None beyond A0."""
        short, long = sorted((self.width_mm, self.height_mm))
        return next((name for name, (a, b) in PAGES_MM.items() if short <= a and long <= b), None)


PAGES_MM = {"A4": (210, 297), "A3": (297, 420), "A2": (420, 594), "A1": (594, 841), "A0": (841, 1189)}


def target_svg(target: Target, grey: float = 0.0) -> Drawing:
    """Draw a flat target.

    Args:
        target: what to draw.
        grey: lightness of its dark parts, 0 (black) .. 1.

    Raises:
        ConfigError: a target in space cannot be printed on one sheet.
    """
    if not target.flat:
        raise ConfigError(f"target {target.spec} stands in space: it cannot be printed on a sheet")
    ink = f"rgb({', '.join([str(round(255 * grey))] * 3)})"
    shapes, width, height = _circles(target) if target.discs else _squares(target)
    margin = 0.5 * target.spacing_mm
    side = max(margin, (LEAST_WIDTH_MM - width) / 2)
    paper_width, target_height = width + 2 * side, height + 2 * margin
    paper_height = target_height + RULER_ROOM_MM
    ruler = float(max(10, int(width // 10) * 10))
    parts = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{paper_width:g}mm" height="{paper_height:g}mm" '
        f'viewBox="0 0 {paper_width:g} {paper_height:g}">',
        f"<title>{escape(target.spec)}</title>",
        f'<rect width="{paper_width:g}" height="{paper_height:g}" fill="white"/>',
        f'<g fill="{ink}" transform="translate({side:g} {margin:g})">',
        *shapes,
        "</g>",
        *_ruler(side if side == margin else 5.0, target_height, ruler, target.spec),
        "</svg>",
    ]
    return Drawing("\n".join(parts) + "\n", paper_width, paper_height, ruler)


def _squares(target: Target) -> tuple[list[str], float, float]:
    """Chessboard or ChArUco: dark squares, and markers in the white ones."""
    side = target.spacing_mm
    charuco = target.kind == "charuco"
    columns, rows = (target.columns, target.rows) if charuco else (target.columns + 1, target.rows + 1)
    shapes = [
        f'<rect x="{c * side:g}" y="{r * side:g}" width="{side:g}" height="{side:g}"/>'
        for r in range(rows)
        for c in range(columns)
        if (r + c) % 2 == 0
    ]
    if charuco:
        shapes += _markers(target, columns, rows)
    return shapes, columns * side, rows * side


def _markers(target: Target, columns: int, rows: int) -> list[str]:
    import cv2  # noqa: PLC0415

    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, target.dictionary))
    modules = int(dictionary.markerSize) + 2
    size = target.marker_mm / modules
    gap = (target.spacing_mm - target.marker_mm) / 2
    shapes, number = [], 0
    for r in range(rows):
        for c in range(columns):
            if (r + c) % 2 == 0:
                continue
            bits: NDArray[np.uint8] = np.asarray(cv2.aruco.generateImageMarker(dictionary, number, modules), np.uint8)
            number += 1
            x0, y0 = c * target.spacing_mm + gap, r * target.spacing_mm + gap
            for y, x in np.argwhere(bits == 0):
                # A hair wider than a module, so that no printer draws white lines between two of them.
                shapes.append(
                    f'<rect x="{x0 + x * size:.5g}" y="{y0 + y * size:.5g}" '
                    f'width="{size * _reach(bits, y, x, 0):.5g}" height="{size * _reach(bits, y, x, 1):.5g}"/>'
                )
    return shapes


def _reach(bits: NDArray[np.uint8], y: int, x: int, axis: int) -> float:
    """1, or a little more where the next module along an axis (0: x, 1: y) is dark too."""
    ny, nx = (y, x + 1) if axis == 0 else (y + 1, x)
    inside = ny < bits.shape[0] and nx < bits.shape[1]
    return 1.02 if inside and bits[ny, nx] == 0 else 1.0


def _circles(target: Target) -> tuple[list[str], float, float]:
    reach = target.diameter_mm / 2
    low = target.points[:, :2].min(axis=0) - reach
    high = target.points[:, :2].max(axis=0) + reach
    shapes = [f'<circle cx="{x - low[0]:.6g}" cy="{y - low[1]:.6g}" r="{reach:g}"/>' for x, y, _ in target.points]
    width, height = high - low
    return shapes, float(width), float(height)


def _ruler(left: float, top: float, length: float, name: str) -> list[str]:
    marks = []
    for mm in range(int(length) + 1):
        long = 5.0 if mm % 10 == 0 else 3.5 if mm % 5 == 0 else 2.0
        marks.append(f"M{left + mm:g} {top + 3:g}v{long:g}")
    numbers = [
        f'<text x="{left + mm:g}" y="{top + 12:g}" text-anchor="middle">{mm}</text>'
        for mm in range(0, int(length) + 1, 10 if length <= 100 else 50)
    ]
    return [
        f'<path d="{"".join(marks)}M{left:g} {top + 3:g}h{length:g}" stroke="black" stroke-width="0.15" fill="none"/>',
        '<g font-family="sans-serif" font-size="3" fill="black">',
        *numbers,
        f'<text x="{left:g}" y="{top + 18:g}">{escape(name)}: printed at 100 % this ruler is {length:g} mm long</text>',
        "</g>",
    ]
