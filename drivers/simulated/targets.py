"""Printed and measured targets of the simulated scenes: their points, their poses, their albedo.

What a calibration needs to know of them stands here as plain functions; the scenes themselves are in `scenes`.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.simulated import textures
from drivers.simulated.rigs import REFERENCE_AIM_MM, Rig, reference

Array = NDArray[np.float64]

SQUARE_MM = 30.0
CELLS_PER_SQUARE = 8
"""Of the print: a ChArUco marker's module is an eighth of a square"""
MARGIN_SQUARES = 0.5
"""White paper around the squares"""


@dataclass(frozen=True, eq=False)
class Pose:
    """Where a target stands: X_camera = rotation @ X_target + translation, mm. The target's origin is its centre."""

    rotation: Array
    translation: Array


@dataclass(frozen=True)
class PrintedTarget:
    """A board of `columns` x `rows` squares. Its frame: x right, y down, z away from the viewer, origin its centre."""

    columns: int
    rows: int
    charuco: bool
    dark: float
    white: float

    @property
    def half_extent_squares(self) -> tuple[float, float]:
        """Half width and height of the paper, squares."""
        return self.columns / 2 + MARGIN_SQUARES, self.rows / 2 + MARGIN_SQUARES

    def points(self, square_mm: float) -> Array:
        """((columns - 1) (rows - 1), 3) mm: the inner corners, row by row from the top left."""
        x, y = np.meshgrid(np.arange(1, self.columns), np.arange(1, self.rows))
        corners = np.stack((x - self.columns / 2, y - self.rows / 2, np.zeros_like(x)), axis=-1)
        return np.asarray(corners.reshape(-1, 3) * square_mm, dtype=np.float64)

    def texture(self, square_mm: float) -> textures.Picture:
        """Albedo over the paper; square_mm: side of a square in the texture's own coordinates."""
        size = (self.columns * CELLS_PER_SQUARE, self.rows * CELLS_PER_SQUARE)
        if self.charuco:
            # Drawn larger, and read at the cells' middles: how OpenCV rounds small drawings is of no concern.
            fine = charuco_board().generateImage((size[0] * 15, size[1] * 15))
            black = fine[7::15, 7::15] < 128
        else:
            y, x = np.indices((size[1], size[0])) // CELLS_PER_SQUARE
            black = (x + y) % 2 == 0
        picture = np.where(black, np.float32(self.dark), np.float32(self.white))
        return textures.Picture(picture, square_mm / CELLS_PER_SQUARE, around=self.white)


@dataclass(frozen=True)
class DiscTarget:
    """A grid of dark discs, in a frame as `PrintedTarget` has it. Lengths in squares of those, on paper as large.

    staggered: discs of a row are two spacings apart, and odd rows one to the right (OpenCV's asymmetric grid).
    """

    columns: int
    rows: int
    spacing: float
    diameter: float
    staggered: bool
    paper: tuple[int, int]
    dark: float
    white: float

    @property
    def half_extent_squares(self) -> tuple[float, float]:
        """Half width and height of the paper, squares."""
        return self.paper[0] / 2 + MARGIN_SQUARES, self.paper[1] / 2 + MARGIN_SQUARES

    def points(self, square_mm: float) -> Array:
        """(columns rows, 3) mm: the discs' centres, row by row from the top left."""
        y, x = np.mgrid[: self.rows, : self.columns].astype(np.float64)
        if self.staggered:
            x = 2 * x + y % 2
        x, y = (each - each.max() / 2 for each in (x, y))
        centres = np.stack((x, y, np.zeros_like(x)), axis=-1).reshape(-1, 3)
        return np.asarray(centres * self.spacing * square_mm, dtype=np.float64)

    def texture(self, square_mm: float) -> textures.Discs:
        """Albedo over the paper; square_mm: side of a square in the texture's own coordinates."""
        centres = np.ascontiguousarray(self.points(square_mm)[:, :2])
        return textures.Discs(centres, self.diameter * square_mm / 2, self.dark, self.white)


@dataclass(frozen=True, eq=False)
class WedgePlane:
    """One side of the wedge, coordinates of scenes.json: centre, unit axes, half extents, discs in (u, v) mm."""

    centre: Array
    u: Array
    v: Array
    half: tuple[float, float]
    disc_centres: Array
    """(9, 2)"""


POSED: dict[str, PrintedTarget | DiscTarget] = {
    "charuco_poses": PrintedTarget(10, 7, charuco=True, dark=0.05, white=0.85),
    "chessboard_poses": PrintedTarget(10, 7, charuco=False, dark=0.35, white=0.85),
    "circles_poses": DiscTarget(8, 5, 1.0, 0.5, False, (10, 7), dark=0.05, white=0.85),
    "acircles_poses": DiscTarget(5, 7, 0.75, 0.6, True, (10, 7), dark=0.05, white=0.85),
}
"""Scenes that show a printed target in one of twelve poses"""
DISC_POSES = tuple(name for name, target in POSED.items() if isinstance(target, DiscTarget))
"""Those that scenes.json has not: their poses are drawn as those of a chessboard are"""


def charuco_board() -> cv2.aruco.CharucoBoard:
    """The ChArUco board of `charuco_poses`: 10 x 7 squares of 30 mm, markers of 22.5 mm from DICT_4X4_50.

    A marker's module is then an eighth of a square.
    """
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    return cv2.aruco.CharucoBoard((10, 7), SQUARE_MM, SQUARE_MM * 0.75, dictionary)


def square_mm(rig: Rig) -> float:
    """Side of a printed square on this rig: 30 mm, whole millimetres less where the field is too small for it."""
    return SQUARE_MM if rig.scale > 0.9 else float(np.floor(SQUARE_MM * rig.scale))


def target_points(scene: str, rig: Rig) -> Array:
    """(N, 3) mm, target frame: inner corners of a board's squares, or centres of discs."""
    return POSED[scene].points(square_mm(rig))


def target_poses(scene: str, rig: Rig, seed: int) -> tuple[Pose, ...]:
    """The poses of a scene's target, drawn from `seed`; both devices see the whole paper in each.

    Tilts up to the scene's `tilt_deg` about any axis in the board, turns up to 15 degrees, depths over its range.
    """
    scenes = reference()["scenes"]
    description = scenes.get(scene, scenes["chessboard_poses"])
    generator = np.random.default_rng([seed, len(scene)])
    near, far = description["depth_mm"]
    count = int(description["poses"])
    poses: list[Pose] = []
    while len(poses) < count:
        # Depths are spread evenly, a third of the tilts is nearly full: calibration needs both.
        depth = near + (far - near) * (len(poses) + generator.uniform()) / count
        tilt = np.radians(description["tilt_deg"]) * np.sqrt(generator.uniform(0.05, 1.0))
        pose = _drawn_pose(generator, rig, depth, tilt)
        if _in_view(pose, POSED[scene], rig):
            poses.append(pose)
    return tuple(poses)


def wedge_planes() -> tuple[WedgePlane, WedgePlane]:
    """The two sides of the wedge: a vertical ridge towards the camera, nine discs on each."""
    description = reference()["scenes"]["wedge"]
    half_width, height, depth = description["width_mm"] / 2, description["height_mm"], description["depth_mm"]
    length = float(np.hypot(half_width, depth))
    per_side = description["discs"]["count"] // 2
    lattice = np.array([((i % 3 - 1) * length / 3.2, (i // 3 - 1) * height / 3.2) for i in range(per_side)])
    planes = []
    for side in (-1.0, 1.0):
        # From left to right: rises to the ridge on the left side, falls from it on the right.
        u = np.array([half_width, 0.0, side * depth]) / length
        centre = np.array([side * half_width / 2, 0.0, REFERENCE_AIM_MM])
        planes.append(WedgePlane(centre, u, np.array([0.0, 1.0, 0.0]), (length / 2, height / 2), lattice))
    return planes[0], planes[1]


def wedge_points(rig: Rig) -> Array:
    """(18, 3) mm, camera frame: centres of the wedge's discs."""
    points = [p.centre + p.disc_centres[:, :1] * p.u + p.disc_centres[:, 1:] * p.v for p in wedge_planes()]
    return rig.from_scene(np.concatenate(points))


def _drawn_pose(generator: np.random.Generator, rig: Rig, depth: float, tilt: float) -> Pose:
    about = generator.uniform(0, 2 * np.pi)
    turn = np.radians(generator.uniform(-15, 15))
    tilted, _ = cv2.Rodrigues(np.array([np.cos(about), np.sin(about), 0.0]) * tilt)
    turned, _ = cv2.Rodrigues(np.array([0.0, 0.0, turn]))
    where = np.array([*generator.uniform((-150.0, -110.0), (150.0, 110.0)), depth])
    return Pose(np.asarray(tilted @ turned, dtype=np.float64), rig.from_scene(where))


def _in_view(pose: Pose, target: PrintedTarget | DiscTarget, rig: Rig) -> bool:
    """Whether the paper's corners lie in both devices' pictures, 1 % off their edges."""
    half = np.asarray(target.half_extent_squares) * square_mm(rig)
    signs = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    corners = np.column_stack((signs * half, np.zeros(4))) @ pose.rotation.T + pose.translation
    calibration = rig.calibration
    for lens, points in (
        (calibration.camera, corners),
        (calibration.projector, calibration.to_projector(corners)),
    ):
        size = np.asarray(lens.size)
        pixels = lens.project(points)
        if (pixels < 0.01 * size).any() or (pixels > 0.99 * size).any():
            return False
    return True
