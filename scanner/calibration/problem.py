"""What an adjustment is given and what it seeks: views, priors, and the rig's parameters in one vector.

The order of the vector: camera, projector (nine numbers each, see `lens_slopes`), rotation vector and translation
from camera to projector, the target's sheet (scale x, scale y, bow, saddle, twist), then six numbers for each pose.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from scanner.calibration.lens_slopes import lens_numbers, lens_of, rotation_of, vector_of
from scanner.calibration.targets import Target
from scanner.geometry import Lens

Array = NDArray[np.float64]

CAMERA = slice(0, 9)
PROJECTOR = slice(9, 18)
TURN = slice(18, 21)
SHIFT = slice(21, 24)
SHEET = slice(24, 29)
POSES = 29

NAMES = (
    *(
        f"{side}.{name}"
        for side in ("camera", "projector")
        for name in ["fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3"]
    ),
    *(f"rotation.{axis}" for axis in "xyz"),
    *(f"translation.{axis}" for axis in "xyz"),
    "sheet.scale_x",
    "sheet.scale_y",
    "sheet.bow_mm",
    "sheet.saddle_mm",
    "sheet.twist_mm",
)
"""Of the parameters that are no pose, in order."""


@dataclass(frozen=True, eq=False)
class View:
    """What one pose gave: numbers of the target's points, and their pixels in camera and projector, (N, 2).

    sigma: (N, 2) 1-sigma of the projector's pixels before any common factor. slope: (N, 2, 2) projector px per camera
    px around each; zeros where the projector's pixels were measured independently of the camera's.
    """

    name: str
    ids: NDArray[np.int64]
    camera: Array
    projector: Array
    sigma: Array
    slope: Array

    def only(self, kept: NDArray[np.bool_]) -> View:
        """The view with some of its points."""
        return View(
            self.name,
            self.ids[kept],
            self.camera[kept],
            self.projector[kept],
            self.sigma[kept],
            self.slope[kept],
        )


@dataclass(frozen=True)
class Priors:
    """How far things go that pictures may leave open, 1-sigma. Each is wide against what good pictures say."""

    aspect: float = 0.02
    """fx / fy about 1: sensors and panels with pixels that are not square are off by a per cent or two"""
    centre: float = 0.5
    """principal point about the middle, share of the picture's size: a projector with full offset is 1 sigma away"""
    radial: tuple[float, float, float] = (0.1, 0.01, 0.001)
    """share of its radius by which k1, k2, k3 move the picture's corner: each about a tenth of the one before"""
    tangential: float = 0.001
    """the same for p1 and p2: a lens of 1000 px half diagonal decentred by one px"""
    sheet_scale: float = 0.001
    """stretch of a printed sheet along x and y: printers feed paper to about 0.1 %"""
    sheet_bend: float = 0.001
    """bow, saddle and twist of the sheet, each as a share of its half diagonal: 0.2 mm for A4 on a board"""


@dataclass(frozen=True, eq=False)
class Length:
    """A stated length: distance of two of the target's points, mm, with its 1-sigma."""

    first: int
    last: int
    mm: float
    sigma_mm: float


@dataclass(frozen=True, eq=False)
class Problem:
    """All that an adjustment is given. `fixed`: parameters (indices below POSES) that are held at their start."""

    target: Target
    camera_size: tuple[int, int]
    projector_size: tuple[int, int]
    views: tuple[View, ...]
    priors: Priors = field(default_factory=Priors)
    length: Length | None = None
    fixed: tuple[int, ...] = ()

    @cached_property
    def typical_sigma(self) -> float:
        """The median of the views' sigmas, px."""
        return float(np.median(np.concatenate([view.sigma.ravel() for view in self.views])))

    def typical_rms(self, view: View, off: Array) -> float:
        """px rms of distances in the projector, (N, 2), weighed by their sigmas: what they would be if all points of
        all views were as sharp as the median one."""
        return float(np.sqrt(np.square(off * (self.typical_sigma / view.sigma)).sum(axis=1).mean()))


@dataclass(frozen=True, eq=False)
class State:
    """camera, projector: lenses; rotation, translation: camera to projector; sheet: (5,) of `sheet_points`;
    poses: (V, 6) rotation vector and translation, mm, target to camera."""

    camera: Lens
    projector: Lens
    rotation: Array
    translation: Array
    sheet: Array
    poses: Array

    def vector(self) -> Array:
        """All parameters in order."""
        lenses = lens_numbers(self.camera), lens_numbers(self.projector)
        return np.concatenate((*lenses, vector_of(self.rotation), self.translation, self.sheet, self.poses.ravel()))

    @classmethod
    def from_vector(cls, x: Array, problem: Problem) -> State:
        """The inverse of `vector`."""
        return cls(
            lens_of(x[CAMERA], problem.camera_size),
            lens_of(x[PROJECTOR], problem.projector_size),
            rotation_of(x[TURN]),
            x[SHIFT].copy(),
            x[SHEET].copy(),
            x[POSES:].reshape(-1, 6).copy(),
        )


def sheet_points(target: Target, sheet: Array) -> tuple[Array, Array]:
    """The target's points on a sheet that is stretched and bent.

    A bend is any surface of second order: a bowl, a roll about any axis (paper that was on one), a saddle. Three
    quantities make it up, which have nothing to do with one another over a square: bow (x^2 + y^2) / h^2, saddle
    (x^2 - y^2) / h^2, and twist 2 x y / h^2, with h the half diagonal.

    Args:
        sheet: (5,) scale x, scale y, bow, saddle and twist, mm.

    Returns:
        (N, 3) mm, and (N, 3, 5) slopes by the five.
    """
    points = target.points
    half = max(float(np.hypot(*target.half_extent)), 1e-9)
    x, y = points[:, 0] / half, points[:, 1] / half
    shapes = np.column_stack((x * x + y * y, x * x - y * y, 2 * x * y))
    moved = points * (sheet[0], sheet[1], 1.0)
    moved[:, 2] += shapes @ sheet[2:]
    slopes = np.zeros((len(points), 3, 5))
    slopes[:, 0, 0], slopes[:, 1, 1], slopes[:, 2, 2:] = points[:, 0], points[:, 1], shapes
    return moved, slopes


FLAT = np.array([1.0, 1.0, 0.0, 0.0, 0.0])
"""The sheet as it was meant to be. Not to be written into."""
