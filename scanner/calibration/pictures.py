"""The picture of a calibration: residual vectors, coverage of image and depth, epipolar errors, histograms.

One PNG of six panels, drawn with OpenCV. What to look for: vectors without a common direction, points to the edges of
both pictures, bars that overlap over the whole working depth, and bell curves.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from scanner.calibration.lens_slopes import rotation_of
from scanner.calibration.solve import Solution

Array = NDArray[np.float64]
Canvas = NDArray[np.uint8]

PANEL = (620, 470)
MARGIN = 46
INK, FAINT, PAPER = (40, 40, 40), (190, 190, 190), (255, 255, 255)
CAMERA_INK, PROJECTOR_INK = (180, 90, 20), (30, 90, 200)
LONGEST_SHARE = 0.06
"""Of the panel's width: the length at which the 95th percentile of residuals is drawn."""


def draw(solution: Solution) -> bytes:
    """The picture as PNG."""
    problem, adjusted = solution.problem, solution.adjusted
    camera = [v.camera for v in problem.views]
    projector = [v.projector for v in problem.views]
    panels = [
        _vectors("camera: residuals", problem.camera_size, camera, adjusted.camera_residuals),
        _vectors("projector: residuals", problem.projector_size, projector, adjusted.projector_residuals),
        _epipolar(solution, camera),
        _coverage("camera: coverage", problem.camera_size, camera),
        _depth(solution),
        _histogram(adjusted.camera_residuals, adjusted.projector_residuals),
    ]
    rows = [np.hstack(panels[:3]), np.hstack(panels[3:])]
    whole, encoded = cv2.imencode(".png", np.vstack(rows))
    if not whole:
        raise ValueError("the picture could not be encoded")
    return encoded.tobytes()


def _panel(title: str) -> Canvas:
    canvas = np.full((PANEL[1], PANEL[0], 3), 255, dtype=np.uint8)
    _text(canvas, title, (MARGIN, 26), INK, 0.55)
    return canvas


def _text(
    canvas: Canvas, text: str, at: tuple[int, int], colour: tuple[int, int, int] = INK, size: float = 0.42
) -> None:
    cv2.putText(canvas, text, at, cv2.FONT_HERSHEY_SIMPLEX, size, colour, 1, cv2.LINE_AA)


def _field(canvas: Canvas, size: tuple[int, int]) -> Callable[[Array], Array]:
    """Draws the frame of a picture of `size` and returns what takes its px to the panel's."""
    room = np.array(PANEL) - 2 * MARGIN
    scale = float(min(room[0] / size[0], room[1] / size[1]))
    corner = np.array([MARGIN, MARGIN])
    far = corner + scale * np.array(size)
    cv2.rectangle(canvas, (MARGIN, MARGIN), (int(far[0]), int(far[1])), FAINT, 1, cv2.LINE_AA)
    return lambda points: corner + scale * (points + 0.5)


def _colour(k: int) -> tuple[int, int, int]:
    """Of view k: hues that differ for neighbours."""
    hue = np.array([[[(k * 67) % 180, 190, 190]]], dtype=np.uint8)
    b, g, r = cv2.cvtColor(hue, cv2.COLOR_HSV2BGR)[0, 0]
    return int(b), int(g), int(r)


def _vectors(title: str, size: tuple[int, int], points: Sequence[Array], residuals: Sequence[Array]) -> Canvas:
    canvas = _panel(title)
    place = _field(canvas, size)
    long = max(float(np.percentile(np.linalg.norm(np.concatenate(residuals), axis=1), 95)), 1e-9)
    factor = LONGEST_SHARE * PANEL[0] / long
    for k, (at, off) in enumerate(zip(points, residuals, strict=True)):
        tails = place(at)
        # Outliers are drawn cut, so that they do not cross the panel.
        length = np.linalg.norm(off, axis=1, keepdims=True)
        heads = tails + factor * off * np.minimum(1.0, 3 * long / np.maximum(length, 1e-12))
        for tail, head in zip(tails, heads, strict=True):
            cv2.line(canvas, _at(tail), _at(head), _colour(k), 1, cv2.LINE_AA)
            cv2.circle(canvas, _at(tail), 1, _colour(k), -1, cv2.LINE_AA)
    bar = int(LONGEST_SHARE * PANEL[0])
    cv2.line(canvas, (MARGIN, PANEL[1] - 18), (MARGIN + bar, PANEL[1] - 18), INK, 2)
    _text(canvas, f"{long:.3f} px (95 of 100 are shorter)", (MARGIN + bar + 10, PANEL[1] - 14))
    return canvas


def _epipolar(solution: Solution, points: Sequence[Array]) -> Canvas:
    canvas = _panel("distance from epipolar lines, in the camera's picture")
    place = _field(canvas, solution.problem.camera_size)
    top = max(float(np.percentile(np.abs(np.concatenate(solution.epipolar)), 95)), 1e-9)
    for at, off in zip(points, solution.epipolar, strict=True):
        for point, value in zip(place(at), off, strict=True):
            share = float(np.clip(value / top, -1, 1))
            colour = (60, 60, int(90 + 165 * share)) if share > 0 else (int(90 - 165 * share), 60, 60)
            cv2.circle(canvas, _at(point), round(2 + 4 * abs(share)), colour, -1, cv2.LINE_AA)
    _text(canvas, f"largest dots {top:.3f} px; red one side, blue the other", (MARGIN, PANEL[1] - 14))
    return canvas


def _coverage(title: str, size: tuple[int, int], points: Sequence[Array]) -> Canvas:
    canvas = _panel(title)
    place = _field(canvas, size)
    for k, at in enumerate(points):
        outline = cv2.convexHull(place(at).astype(np.float32)).astype(np.int32)
        cv2.polylines(canvas, [outline], True, _colour(k), 1, cv2.LINE_AA)
        for point in place(at):
            cv2.circle(canvas, _at(point), 1, _colour(k), -1, cv2.LINE_AA)
    every = np.concatenate(points)
    span = (every.max(axis=0) - every.min(axis=0)) / size
    _text(canvas, f"{len(points)} views over {span[0]:.0%} x {span[1]:.0%} of the picture", (MARGIN, PANEL[1] - 14))
    return canvas


def _depth(solution: Solution) -> Canvas:
    canvas = _panel("depth of each view's points, and its tilt")
    problem, state = solution.problem, solution.state
    ranges, tilts = [], []
    for view, pose in zip(problem.views, state.poses, strict=True):
        rotation = rotation_of(pose[:3])
        z = (problem.target.points[view.ids] @ rotation.T + pose[3:])[:, 2]
        ranges.append((float(z.min()), float(z.max())))
        tilts.append(float(np.degrees(np.arccos(np.clip(abs(rotation[2, 2]), 0, 1)))))
    low, high = min(r[0] for r in ranges), max(r[1] for r in ranges)
    span = max(high - low, 1e-9)
    room = PANEL[0] - 2 * MARGIN - 90
    step = (PANEL[1] - 2 * MARGIN - 20) / max(len(ranges), 1)
    for k, ((near, far), tilt) in enumerate(zip(ranges, tilts, strict=True)):
        y = int(MARGIN + (k + 0.5) * step)
        left, right = (int(MARGIN + room * (z - low) / span) for z in (near, far))
        half = max(int(step * 0.25), 1)
        cv2.rectangle(canvas, (left, y - half), (max(right, left + 1), y + half), _colour(k), -1)
        _text(canvas, f"{problem.views[k].name[-12:]} {tilt:.0f} deg", (PANEL[0] - MARGIN - 84, y + 4), INK, 0.34)
    _text(canvas, f"{low:.0f} mm", (MARGIN, PANEL[1] - 14))
    _text(canvas, f"{high:.0f} mm", (MARGIN + room - 50, PANEL[1] - 14))
    return canvas


def _histogram(camera: Sequence[Array], projector: Sequence[Array]) -> Canvas:
    canvas = _panel("residuals: camera (blue), projector (red)")
    values = [np.concatenate(part).ravel() for part in (camera, projector)]
    reach = max(float(np.percentile(np.abs(np.concatenate(values)), 99)), 1e-9)
    edges = np.linspace(-reach, reach, 62)
    counts = [np.histogram(v, edges)[0] / max(len(v), 1) for v in values]
    top = max(float(c.max()) for c in counts) or 1.0
    width, height = PANEL[0] - 2 * MARGIN, PANEL[1] - 2 * MARGIN - 20
    for count, colour in zip(counts, (CAMERA_INK, PROJECTOR_INK), strict=True):
        x = MARGIN + width * (np.arange(len(count)) + 0.5) / len(count)
        y = MARGIN + height * (1 - count / top)
        line = np.column_stack((x, y)).round().astype(np.int32)
        cv2.polylines(canvas, [line], False, colour, 2, cv2.LINE_AA)
    base = MARGIN + height
    cv2.line(canvas, (MARGIN, base), (MARGIN + width, base), FAINT, 1)
    _text(canvas, f"{-reach:.3f} px", (MARGIN, PANEL[1] - 30))
    _text(canvas, f"{reach:+.3f} px", (MARGIN + width - 70, PANEL[1] - 30))
    return canvas


def _at(point: Array) -> tuple[int, int]:
    return round(float(point[0])), round(float(point[1]))
