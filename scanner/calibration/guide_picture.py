"""The picture beside a guided calibration: what the camera sees, the target in it, and what the poses cover so far.

Drawn about twice a second, for a viewer that reloads its file.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from scanner.calibration.guide import OUTER, Guide
from scanner.calibration.sight import Sight
from scanner.colours import ACCENT, BACKGROUND, DIM, LINE, PANEL, TEXT, Picture, text

Array = NDArray[np.float64]

WIDTH, HEIGHT = 1280, 720
_SIDE, _MARGIN, _FOOT = 300, 16, 84
_GOOD, _BAD = (90, 200, 90), (70, 90, 230)
"""BGR"""
_COVERED = (70, 90, 60)
_EDGES = (0.0, OUTER, 1 - OUTER, 1.0)


def guide_picture(picture: NDArray[Any], sight: Sight | str, guide: Guide, line: str, advice: str) -> Picture:
    """(720, 1280, 3) uint8 BGR: the live picture with the target over it, coverage of the picture and of depth at its
    side, and two lines of words below."""
    canvas = np.empty((HEIGHT, WIDTH, 3), np.uint8)
    canvas[:] = BACKGROUND
    _live(canvas, picture, sight, guide)
    left = WIDTH - _SIDE - _MARGIN
    height = round(_SIDE * guide.size[1] / guide.size[0])
    text(canvas, f"{len(guide.poses)} poses in the picture", (left, 34), size=17, colour=TEXT)
    _coverage(canvas, guide, (left, 46), _SIDE / guide.size[0])
    _depths(canvas, guide, sight, (left, 46 + height + 44, _SIDE, HEIGHT - _FOOT - height - 110))
    text(canvas, line, (_MARGIN, HEIGHT - _FOOT + 34), size=20, colour=_colour(sight), weight=600)
    text(canvas, f"next: {advice}", (_MARGIN, HEIGHT - 20), size=20, colour=ACCENT)
    return canvas


def _colour(sight: Sight | str) -> tuple[int, int, int]:
    return _GOOD if isinstance(sight, Sight) and sight.trouble is None else _BAD


def _live(canvas: Picture, picture: NDArray[Any], sight: Sight | str, guide: Guide) -> None:
    room = (WIDTH - _SIDE - 3 * _MARGIN, HEIGHT - _FOOT - _MARGIN)
    scale = min(room[0] / guide.size[0], room[1] / guide.size[1])
    size = (round(scale * guide.size[0]), round(scale * guide.size[1]))
    eight = picture if picture.dtype == np.uint8 else (picture / (np.iinfo(picture.dtype).max / 255)).astype(np.uint8)
    grey = cv2.resize(eight, size, interpolation=cv2.INTER_AREA)
    part = canvas[_MARGIN : _MARGIN + size[1], _MARGIN : _MARGIN + size[0]]
    part[:] = grey[..., None]
    for pose in guide.poses:
        cv2.polylines(part, [_hull(pose.points, scale)], True, DIM, 1, cv2.LINE_AA)
    if isinstance(sight, Sight):
        cv2.polylines(part, [_hull(sight.points, scale)], True, _colour(sight), 2, cv2.LINE_AA)
        for x, y in (scale * (sight.points + 0.5)).round().astype(int):
            cv2.circle(part, (int(x), int(y)), 3, _colour(sight), 1, cv2.LINE_AA)


def _coverage(canvas: Picture, guide: Guide, corner: tuple[int, int], scale: float) -> None:
    width, height = (round(scale * side) for side in guide.size)
    part = canvas[corner[1] : corner[1] + height, corner[0] : corner[0] + width]
    part[:] = PANEL
    for k, covered in enumerate(guide.fields()):
        if covered:
            row, column = divmod(k, 3)
            top, below = (round(height * edge) for edge in _EDGES[row : row + 2])
            left, right = (round(width * edge) for edge in _EDGES[column : column + 2])
            part[top + 1 : below, left + 1 : right] = _COVERED
    for pose in guide.poses:
        for x, y in (scale * (pose.points + 0.5)).round().astype(int):
            cv2.circle(part, (int(x), int(y)), 1, ACCENT, -1)
    cv2.rectangle(part, (0, 0), (width - 1, height - 1), LINE, 1)


def _depths(canvas: Picture, guide: Guide, sight: Sight | str, box: tuple[int, int, int, int]) -> None:
    """A mark for each pose: depth against the first to the right, tilt upwards; the target seen now as a ring."""
    x, y, width, height = box
    text(canvas, "tilt (up) over depth, to the first pose", (x, y - 10), size=17, colour=TEXT)
    cv2.rectangle(canvas, (x, y), (x + width, y + height), LINE, 1)
    standings = guide.standings
    now = sight.standing if isinstance(sight, Sight) else None
    if not standings:
        return
    first = standings[0].depth
    shares = [s.depth / first - 1 for s in standings] + ([now.depth / first - 1] if now else [])
    reach = max(0.15, *(abs(share) for share in shares)) * 1.1

    def place(share: float, tilt_deg: float) -> tuple[int, int]:
        return round(x + width * (share / reach + 1) / 2), round(y + height * (1 - min(tilt_deg, 50.0) / 50))

    for share in (-0.075, 0.075):
        cv2.line(canvas, place(share, 0), place(share, 50), LINE, 1)
    for tilt in (20, 30):  # what the advice asks for
        cv2.line(canvas, place(-reach, tilt), place(reach, tilt), LINE, 1)
        text(canvas, f"{tilt}°", (x + 4, place(0, tilt)[1] - 4), size=13, colour=DIM)
    for standing in standings:
        cv2.circle(canvas, place(standing.depth / first - 1, standing.tilt_deg), 4, ACCENT, -1, cv2.LINE_AA)
    if now is not None:
        cv2.circle(canvas, place(now.depth / first - 1, now.tilt_deg), 7, _colour(sight), 2, cv2.LINE_AA)
    text(canvas, f"{-reach:.0%}", (x, y + height + 20), size=15, colour=DIM)
    text(canvas, f"{reach:+.0%}", (x + width, y + height + 20), size=15, colour=DIM, align="right")


def _hull(points: Array, scale: float) -> NDArray[np.int32]:
    return cv2.convexHull((scale * (points + 0.5)).astype(np.float32)).round().astype(np.int32)
