"""What stands in the scenes, in numbers: sizes and distances as they are on a rig, to verify measurements by.

Scenes are drawn in the coordinates of scenes.json and scaled to each rig's field, so that a ball of 160 mm on one rig
is one of 161.44 mm on another. Nothing here is measured: these are the figures that the scenes are built from.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from drivers.simulated import targets
from drivers.simulated.rigs import REFERENCE_AIM_MM, Rig, reference

Nominals = Mapping[str, Mapping[str, Any]]


def nominals(rig: Rig) -> Nominals:
    """Sizes, mm, of what stands in each scene on this rig, by scene; places in the camera's frame.

    The first figure of a scene is the one to verify by. A printed target's is its name for `--target`.
    """
    scenes = reference()["scenes"]
    found: dict[str, dict[str, Any]] = {"board": _wall(rig, REFERENCE_AIM_MM), "tilt": _wall(rig, REFERENCE_AIM_MM)}
    for name in ("sphere_board", "sphere_dark"):
        ball = scenes[name]
        found[name] = {"diameter_mm": _mm(rig, 2 * ball["radius_mm"]), "centre_mm": _place(rig, ball["centre_mm"])}
        found[name] |= _wall(rig, ball["background"]["plane_z_mm"])
    found["blocks"] = {"heights_mm": [_mm(rig, height) for height in scenes["blocks"]["heights_mm"]]}
    found["blocks"] |= _wall(rig, scenes["blocks"]["on"]["plane_z_mm"])
    bust = scenes["bust"]
    found["bust"] = {name: _mm(rig, bust[name]) for name in ("height_mm", "width_mm", "depth_mm")}
    found["bust"] |= _wall(rig, bust["background"]["plane_z_mm"])
    found["wedge"] = _wedge(rig)
    for name in targets.POSED:
        found[name] = _target(rig, name)
    return found


def _mm(rig: Rig, length: float) -> float:
    return round(float(length) * rig.scale, 4)


def _place(rig: Rig, point: Any) -> list[float]:
    return [round(float(v), 4) + 0.0 for v in rig.from_scene(np.asarray(point))]


def _wall(rig: Rig, z_mm: float) -> dict[str, Any]:
    """Where the board or the wall behind the bodies meets the camera's axis."""
    return {"wall_mm": _place(rig, (0.0, 0.0, z_mm))[2]}


def _wedge(rig: Rig) -> dict[str, Any]:
    wedge = reference()["scenes"]["wedge"]
    sizes = {name: _mm(rig, wedge[name]) for name in ("width_mm", "height_mm", "depth_mm")}
    discs = [[round(float(v), 4) + 0.0 for v in point] for point in targets.wedge_points(rig)]
    return {"disc_diameter_mm": _mm(rig, 2 * wedge["discs"]["radius_mm"]), **sizes, "disc_centres_mm": discs}


def _target(rig: Rig, name: str) -> dict[str, Any]:
    """Its name, its squares or discs, and the longest row: from the first to the last corner or centre."""
    board, square = targets.POSED[name], targets.square_mm(rig)
    if isinstance(board, targets.DiscTarget):
        spacing, diameter = board.spacing * square, board.diameter * square
        kind = "acircles" if board.staggered else "circles"
        longest = (board.columns - 1) * (2 if board.staggered else 1) * spacing
        spec = f"{kind}:{board.columns}x{board.rows}:{spacing:g}:{diameter:g}"
        return {"target": spec, "spacing_mm": spacing, "diameter_mm": diameter, "longest_row_mm": longest}
    kind = "charuco" if board.charuco else "chessboard"
    columns, rows = (board.columns, board.rows) if board.charuco else (board.columns - 1, board.rows - 1)
    marker = {"marker_mm": 0.75 * square} if board.charuco else {}
    longest = (board.columns - 2) * square
    return {"target": f"{kind}:{columns}x{rows}:{square:g}", "square_mm": square, **marker, "longest_row_mm": longest}
