"""The picture of a calibration: residual vectors, coverage, epipolar errors, depths, histograms, figures of each view.

One PNG of nine panels under a line that says what was calibrated. What to look for: vectors without a common direction,
points to the edges of both pictures, bars that overlap over the whole working depth, and bell curves about zero.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from scanner.calibration.calibration_file import residuals_of
from scanner.calibration.lens_slopes import rotation_of
from scanner.calibration.panel import DIM, FAINT, INK, SIZE, Axis, Canvas, Colour, Panel, panel
from scanner.calibration.solve import Solution

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

CAMERA_INK, PROJECTOR_INK, HELD_OUT_INK = (180, 90, 20), (30, 90, 200), (60, 150, 60)
LONGEST_SHARE = 0.06
"""Of the panel's width: the length at which the 95th percentile of residuals is drawn."""
OUTER = (0.25, 0.75)
"""Of the picture's width and height: the fields that poses should reach into, as guided calibration counts them"""
HEAD_PX = 44


def draw(solution: Solution) -> bytes:
    """The picture as PNG."""
    problem, adjusted = solution.problem, solution.adjusted
    camera = [v.camera for v in problem.views]
    projector = [v.projector for v in problem.views]
    seen, thrown = problem.camera_size, problem.projector_size
    panels = [
        _vectors("Camera: seen minus predicted", seen, camera, adjusted.camera_residuals, adjusted.kept),
        _vectors("Projector: seen minus predicted", thrown, projector, adjusted.projector_residuals, adjusted.kept),
        _epipolar(solution, camera),
        _coverage("Camera: where the target was", seen, camera),
        _coverage("Projector: where the target was", thrown, projector),
        _depth(solution),
        _histogram("Camera: residuals", adjusted.camera_residuals, adjusted.kept, CAMERA_INK),
        _histogram("Projector: residuals", adjusted.projector_residuals, adjusted.kept, PROJECTOR_INK),
        _by_view(solution),
    ]
    rows = [np.hstack([p.canvas for p in panels[k : k + 3]]) for k in (0, 3, 6)]
    whole, encoded = cv2.imencode(".png", np.vstack([_head(solution), *rows]))
    if not whole:
        raise ValueError("the picture could not be encoded")
    return encoded.tobytes()


def _head(solution: Solution) -> Canvas:
    figures = residuals_of(solution)
    left_out = f", {len(solution.left_out)} captures left out" if solution.left_out else ""
    words = (
        f"Calibration from {len(solution.problem.views)} views{left_out}.  rms without {figures['outliers']} outliers: "
        f"camera {figures['camera_px']:.4f} px, projector {figures['projector_px']:.4f} px, "
        f"distance from epipolar lines {figures['epipolar_px']:.4f} px"
    )
    canvas = np.full((HEAD_PX, 3 * SIZE[0], 3), 255, dtype=np.uint8)
    cv2.putText(canvas, words, (20, 28), cv2.FONT_HERSHEY_SIMPLEX, 0.62, INK, 1, cv2.LINE_AA)
    return canvas


def _colour(k: int) -> Colour:
    """Of view k: hues that differ for neighbours."""
    hue = np.array([[[(k * 67) % 180, 190, 190]]], dtype=np.uint8)
    b, g, r = cv2.cvtColor(hue, cv2.COLOR_HSV2BGR)[0, 0]
    return int(b), int(g), int(r)


def _field(title: str, size: tuple[int, int]) -> Panel:
    """A picture of `size`, its pixels as axes."""
    return panel(title, Axis(0, size[0], "x, px"), Axis(0, size[1], "y, px"), square=True)


def _vectors(
    title: str, size: tuple[int, int], points: Sequence[Array], residuals: Sequence[Array], kept: Sequence[Flags]
) -> Panel:
    drawn = _field(title, size)
    good = np.concatenate([off[keep] for off, keep in zip(residuals, kept, strict=True)])
    long = max(float(np.percentile(np.linalg.norm(good, axis=1), 95)), 1e-9)
    factor = LONGEST_SHARE * SIZE[0] / long
    for k, (at, off, keep) in enumerate(zip(points, residuals, kept, strict=True)):
        tails = drawn.place(at)
        # Outliers are drawn grey and cut, so that they neither cross the panel nor set its scale.
        length = np.linalg.norm(off, axis=1, keepdims=True)
        heads = tails + factor * off * np.minimum(1.0, 3 * long / np.maximum(length, 1e-12))
        for tail, head, good_one in zip(tails, heads, keep, strict=True):
            colour = _colour(k) if good_one else DIM
            drawn.line(np.array([tail, head]), colour)
            drawn.dot(tail, 1, colour)
    left, _, _, bottom = drawn.area
    drawn.line(np.array([[left, bottom + 34], [left + factor * long, bottom + 34]]), INK, 2)
    drawn.text(f"= {long:.3f} px", (left + factor * long + 8, bottom + 38))
    out = sum(int((~keep).sum()) for keep in kept)
    drawn.note(f"a colour a view; 95 of 100 are shorter than the bar; {out} outliers in grey")
    return drawn


def _epipolar(solution: Solution, points: Sequence[Array]) -> Panel:
    drawn = _field("Distance from epipolar lines, over the camera's picture", solution.problem.camera_size)
    top = max(float(np.percentile(np.abs(np.concatenate(solution.epipolar)), 95)), 1e-9)
    for at, off in zip(points, solution.epipolar, strict=True):
        for point, value in zip(drawn.place(at), off, strict=True):
            share = float(np.clip(value / top, -1, 1))
            drawn.dot(point, round(2 + 3 * abs(share)), _signed(share))
    left, _, _, bottom = drawn.area
    shares = np.linspace(-1, 1, 41)
    for k, share in enumerate(shares):
        drawn.bar(
            np.array([left + 60 + 4 * k, bottom + 28]), np.array([left + 63 + 4 * k, bottom + 40]), _signed(share)
        )
    drawn.text(f"{-top:.3f}", (left, bottom + 38))
    drawn.text(f"{top:+.3f} px", (left + 66 + 4 * len(shares), bottom + 38))
    drawn.note("projector px, one side of the line and the other; 5 of 100 are larger")
    return drawn


def _signed(share: float) -> Colour:
    """Blue at -1, red at 1, grey between."""
    grey = round(200 * (1 - abs(share)))
    return (grey, grey, round(grey + 230 * share)) if share > 0 else (round(grey - 230 * share), grey, grey)


def _coverage(title: str, size: tuple[int, int], points: Sequence[Array]) -> Panel:
    drawn = _field(title, size)
    for share in OUTER:
        drawn.line(drawn.place(np.array([[share * size[0], 0.0], [share * size[0], size[1]]])), FAINT)
        drawn.line(drawn.place(np.array([[0.0, share * size[1]], [size[0], share * size[1]]])), FAINT)
    for k, at in enumerate(points):
        outline = cv2.convexHull(drawn.place(at).astype(np.float32))[:, 0].astype(np.float64)
        drawn.line(np.concatenate((outline, outline[:1])), _colour(k))
        for point in drawn.place(at):
            drawn.dot(point, 1, _colour(k))
    every = np.concatenate(points)
    span = (every.max(axis=0) - every.min(axis=0)) / size
    inner = [np.searchsorted(OUTER, every[:, k] / size[k]) for k in (0, 1)]
    fields = len(np.unique(3 * inner[1] + inner[0]))
    drawn.note(f"{len(points)} views over {span[0]:.0%} x {span[1]:.0%} of the picture, in {fields} of 9 fields")
    return drawn


def _depth(solution: Solution) -> Panel:
    problem, state = solution.problem, solution.state
    ranges, tilts, middles = [], [], []
    for view, pose in zip(problem.views, state.poses, strict=True):
        rotation = rotation_of(pose[:3])
        z = (problem.target.points[view.ids] @ rotation.T + pose[3:])[:, 2]
        ranges.append((float(z.min()), float(z.max())))
        middles.append(float(z.mean()))
        tilts.append(float(np.degrees(np.arccos(np.clip(abs(rotation[2, 2]), 0, 1)))))
    low, high = min(r[0] for r in ranges), max(r[1] for r in ranges)
    room = max(high - low, 1e-6)
    # Room at the right for each view's name and tilt.
    x = Axis(low - 0.03 * room, high + 0.35 * room, "distance from the camera, mm")
    drawn = panel("Depth of each view's points, and its tilt", x, Axis(0, len(ranges), "views", ticks=False))
    for k, ((near, far), tilt) in enumerate(zip(ranges, tilts, strict=True)):
        first, last = drawn.place(np.array([[near, k + 0.25], [far, k + 0.75]]))
        drawn.bar(first, np.maximum(last, first + 2), _colour(k))
        words = f"{problem.views[k].name[-12:]}: {tilt:.0f} deg"
        drawn.text(words, (drawn.area[2] - 124, (first[1] + last[1]) / 2 + 4), INK, 0.36)
    span = float(np.ptp(middles)) / middles[0]  # as the guide has it
    drawn.note(f"points: {low:.0f} to {high:.0f} mm; the target's middle: over {span:.1%} of the first view's distance")
    return drawn


def _histogram(title: str, residuals: Sequence[Array], kept: Sequence[Flags], colour: Colour) -> Panel:
    good = np.concatenate([off[keep] for off, keep in zip(residuals, kept, strict=True)])
    reach = max(float(np.percentile(np.abs(good), 99.5)), 1e-9)
    edges = np.linspace(-reach, reach, 42)
    counts = [np.histogram(np.clip(values, -reach, reach), edges)[0] for values in good.T]
    top = 1.1 * max(int(count.max()) for count in counts)
    drawn = panel(f"{title}, along x and along y", Axis(-reach, reach, "px"), Axis(max(top, 1.0), 0, "points"))
    along_y = (150, 150, 150)
    for count, ink in zip(counts, (colour, along_y), strict=True):
        steps = np.column_stack((np.repeat(edges, 2)[1:-1], np.repeat(count, 2).astype(np.float64)))
        drawn.line(drawn.place(steps), ink, 2)
    drawn.line(drawn.place(np.array([[0.0, 0.0], [0.0, drawn.y.first]])), FAINT)
    drawn.legend((("x", colour), ("y", along_y)))
    spread, mean = good.std(axis=0), good.mean(axis=0)
    drawn.note(
        f"x: mean {mean[0]:+.4f}, sigma {spread[0]:.4f} px; y: mean {mean[1]:+.4f}, sigma {spread[1]:.4f} px; "
        f"{len(good)} points"
    )
    return drawn


def _by_view(solution: Solution) -> Panel:
    views = residuals_of(solution)["views"]
    kinds = (
        ("camera", "camera_px", CAMERA_INK),
        ("projector", "projector_px", PROJECTOR_INK),
        ("projector, held out", "held_out_px", HELD_OUT_INK),
    )
    top = max(view[name] or 0.0 for view in views for _, name, _ in kinds)
    drawn = panel("Rms of each view", Axis(0, len(views), "views, in order"), Axis(max(1.35 * top, 1e-6), 0, "px"))
    for k, view in enumerate(views):
        for n, (_, name, ink) in enumerate(kinds):
            if view[name] is not None:
                corners = np.array([[k + 0.15 + 0.24 * n, view[name]], [k + 0.36 + 0.24 * n, 0.0]])
                corner, opposite = drawn.place(corners)
                drawn.bar(corner, opposite, ink)
    drawn.legend([(words, ink) for words, _, ink in kinds])
    drawn.note("held out: predicted by a calibration without this view")
    return drawn
