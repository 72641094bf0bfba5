"""Targets in pictures: which of a target's points are seen, and where, to sub-pixels.

OpenCV finds chessboards, ChArUco boards and grids of circles; the points are then measured again by `corners` and
`disc_centres`, which are several times as sharp. A target that is not there is an answer with a reason, not an error:
one bad pose of twelve must not stop a calibration.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from scanner.calibration.bends import line_bends
from scanner.calibration.corners import refine_corners
from scanner.calibration.targets import Target

Array = NDArray[np.float64]

CHESSBOARD_WINDOW = 0.3
"""Radius of a corner's window over the distance to the next: the neighbours' edges stay outside at any usable tilt."""
BLUR_PX = 2.0
"""What a window keeps away from the next feature: lens and pixel blur reach so far."""
FEWEST_SHARE = 0.3
"""Of a ChArUco board's corners; a chessboard or grid is seen whole or not at all."""
FEWEST_POINTS = 8
"""Of one view: a homography takes four, twice as many leave something to judge by."""
OTHER_SHARE = 0.6
"""Of the points stated, that a board of other counts must have: less is part of one, or of something else"""

LEAST_SIDE_PX = 24
"""Of a picture: four squares a side with room for a corner's window."""


@dataclass(frozen=True, eq=False)
class Detection:
    """ids: (N,) numbers of the target's points seen; points: (N, 2) px; spacing: (N,) px to the next point."""

    ids: NDArray[np.int64]
    points: Array
    spacing: Array


@dataclass(frozen=True)
class NotFound:
    """Why a target was not found."""

    reason: str


def detect(image: NDArray[Any], target: Target) -> Detection | NotFound:
    """Find a target.

    Args:
        image: (H, W) grey levels of any range; NaN counts as black.
        target: what to look for.
    """
    height, width = image.shape
    if min(height, width) < LEAST_SIDE_PX:
        return NotFound(f"a picture of {width} x {height} px is too small for a target")
    picture = np.nan_to_num(np.asarray(image, dtype=np.float32))
    top = float(np.percentile(picture, 99.5))
    if top <= 0:
        return NotFound("the picture is black")
    grey = np.clip(picture * (235.0 / top), 0, 255).astype(np.uint8)
    if target.kind == "chessboard":
        return _chessboard(picture, grey, target)
    if target.kind == "charuco":
        return _charuco(picture, grey, target)
    from scanner.calibration.discs import detect_circles, detect_discs  # noqa: PLC0415

    found = detect_discs(picture, grey, target) if target.kind == "wedge" else detect_circles(picture, grey, target)
    return NotFound(found) if isinstance(found, str) else Detection(*found)


def _chessboard(picture: NDArray[np.float32], grey: NDArray[np.uint8], target: Target) -> Detection | NotFound:
    size = (target.columns, target.rows)
    # Normalised, or searched exhaustively, a clear board is sometimes found shifted by a row, or not at all.
    for flags in (0, cv2.CALIB_CB_NORMALIZE_IMAGE, cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE):
        found, corners = cv2.findChessboardCornersSB(grey, size, flags=flags)
        if found:
            break
    else:
        found, corners = cv2.findChessboardCorners(grey, size, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
    if not found:
        said = f"no chessboard of {target.columns} x {target.rows} inner corners in the picture"
        return NotFound(said + _other_counts(grey, target))
    ids = np.arange(target.columns * target.rows)
    grid = corners.reshape(target.rows, target.columns, 2).astype(np.float64)
    return _measured(picture, target, ids, grid)


def _other_counts(grey: NDArray[np.uint8], target: Target) -> str:
    """What counts the board has that is there, in words; nothing where none of that size is. People count squares."""
    found = [
        cv2.findChessboardCornersSBWithMeta(grey, (3, 3), cv2.CALIB_CB_LARGER | more)
        for more in (0, cv2.CALIB_CB_NORMALIZE_IMAGE)
    ]
    counts = [sorted(meta.shape) for seen, _, meta in found if seen]
    rows, columns = max(counts, key=lambda sides: sides[0] * sides[1], default=(0, 0))
    as_stated = {rows, columns} == {target.rows, target.columns}
    if as_stated or rows * columns < OTHER_SHARE * target.columns * target.rows:
        return ""
    return f"; one of {columns} x {rows} is there (inner corners count, not squares)"


def _charuco(picture: NDArray[np.float32], grey: NDArray[np.uint8], target: Target) -> Detection | NotFound:
    best, best_ids = np.empty((0, 2)), np.empty(0, np.int64)
    # Boards with an even number of rows printed before OpenCV 4.6 begin with the other colour.
    for legacy in (False, True) if target.rows % 2 == 0 else (False,):
        board = charuco_board(target)
        board.setLegacyPattern(legacy)
        corners, ids, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(grey)
        if ids is not None and len(ids) > len(best_ids):
            best, best_ids = corners.reshape(-1, 2).astype(np.float64), ids.ravel().astype(np.int64)
    whole = len(target.points)
    if len(best_ids) < max(FEWEST_POINTS, FEWEST_SHARE * whole):
        if _is_mirrored(grey, target):
            return NotFound("the board is seen in a mirror: switch the mirroring of the camera's picture off")
        return NotFound(
            f"{len(best_ids)} of {whole} corners of the ChArUco board in the picture; {_markers(grey, target)}"
        )
    grid = np.full((whole, 2), np.nan)
    grid[best_ids] = best
    return _measured(picture, target, best_ids, grid.reshape(target.rows - 1, target.columns - 1, 2))


def charuco_board(target: Target) -> Any:
    """OpenCV's own description of a ChArUco target."""
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, target.dictionary))
    size = (target.columns, target.rows)
    return cv2.aruco.CharucoBoard(size, float(target.spacing_mm), float(target.marker_mm), dictionary)


def _markers(grey: NDArray[np.uint8], target: Target) -> str:
    """Why a board that is there may not have been found, by its markers."""
    dictionary = charuco_board(target).getDictionary()
    corners, _, _ = cv2.aruco.ArucoDetector(dictionary).detectMarkers(grey)
    if not corners:
        return (
            "no marker of its dictionary was read: none is there, it is another dictionary, or they are too small, "
            "blurred or dark"
        )
    counts = f"{target.columns} x {target.rows}"
    return f"{len(corners)} markers were read: the board is partly seen, or has other counts than {counts}"


def _is_mirrored(grey: NDArray[np.uint8], target: Target) -> bool:
    _, ids, _, _ = cv2.aruco.CharucoDetector(charuco_board(target)).detectBoard(np.ascontiguousarray(grey[:, ::-1]))
    return ids is not None and len(ids) >= FEWEST_POINTS


def _measured(
    picture: NDArray[np.float32], target: Target, ids: NDArray[np.int64], grid: Array
) -> Detection | NotFound:
    """The corners of a grid (rows, columns, 2), NaN where not seen, measured again: twice, since only the corners of
    the whole view tell how its edges are bent."""
    along, down = (neighbour_steps(grid, axis).reshape(-1, 2)[ids] for axis in (1, 0))
    points = grid.reshape(-1, 2)[ids]
    spacing = np.minimum(np.linalg.norm(along, axis=1), np.linalg.norm(down, axis=1))
    alone = ~np.isfinite(spacing)
    along, down = np.where(alone[:, None], (1.0, 0.0), along), np.where(alone[:, None], (0.0, 1.0), down)
    radius = window_radius(target, np.where(alone, 0.0, spacing))
    straight = refine_corners(picture, points, along, down, radius).points
    sharp = np.isfinite(straight).all(axis=1) & ~alone
    bends = np.zeros((len(ids), 2))
    bends[sharp] = line_bends(target.points[ids[sharp], :2], straight[sharp], np.stack((along, down), axis=1)[sharp])
    refined = refine_corners(picture, np.where(sharp[:, None], straight, points), along, down, radius, bends).points
    kept = np.isfinite(refined).all(axis=1) & sharp
    if kept.sum() < FEWEST_POINTS:
        return NotFound(f"{int(kept.sum())} of {len(target.points)} corners are sharp enough to be measured")
    return Detection(ids[kept], refined[kept], spacing[kept])


def window_radius(target: Target, spacing: Array) -> Array:
    """(N,) px: how far around a corner nothing but its two edges is seen."""
    radius = CHESSBOARD_WINDOW * spacing
    if target.kind == "charuco":
        # The marker's corner is the nearest feature: half of what its square leaves, along the diagonal.
        gap = np.sqrt(2.0) / 2 * (1 - target.marker_mm / target.spacing_mm) * spacing
        radius = np.minimum(radius, gap - BLUR_PX)
    return np.asarray(np.maximum(radius, 0.0), dtype=np.float64)


def neighbour_steps(grid: Array, axis: int) -> Array:
    """(rows, columns, 2) px: from each point to its next along an axis, the mean of both sides where both are seen."""
    forward = np.full_like(grid, np.nan)
    backward = np.full_like(grid, np.nan)
    step = np.diff(grid, axis=axis)
    first, last = [slice(None)] * 3, [slice(None)] * 3
    first[axis], last[axis] = slice(None, -1), slice(1, None)
    forward[tuple(first)], backward[tuple(last)] = step, step
    both = np.where(np.isfinite(forward) & np.isfinite(backward), (forward + backward) / 2, np.nan)
    one = np.where(np.isfinite(forward), forward, backward)
    return np.where(np.isfinite(both), both, one)
