"""Albedo over a flat body, as printed pictures: samplers, chequers, discs, targets.

A camera pixel sees the mean over its footprint, by exact areas (`coverage`); what the lens's blur makes of it, see
`print_blur`.
"""

# Kernels: numba types their arguments.
# mypy: disable-error-code="no-untyped-def,no-untyped-call"

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.simulated.coverage import disc_share, raster_mean
from scanner.kernel import kernel

Array = NDArray[np.float64]

DARK, BRIGHT = 0.05, 0.9
PX_PER_MM = 4


@dataclass(frozen=True, eq=False)
class Picture:
    """Albedos printed on a rectangle, centred on it. values: (H, W) float32 0..1.

    tiled: repeats beyond its edges; else `around` is the albedo there.
    """

    values: NDArray[np.float32]
    mm_per_px: float
    tiled: bool = False
    around: float = 0.0


@dataclass(frozen=True, eq=False)
class Discs:
    """Discs on a plain ground. centres: (N, 2) float64 mm from the middle of the rectangle; no two overlap."""

    centres: Array
    radius_mm: float
    inside: float
    around: float


Print = Picture | Discs


def sampler() -> Picture:
    """The `textured` scene: six fields of 185 x 205 mm, repeated beyond the reference field.

    Chequers of 12 mm and of 4 mm, stripes of 6 mm; smooth noise, print, a dark patch with a bright rim.
    """
    y, x = np.indices((205 * PX_PER_MM, 185 * PX_PER_MM)) / PX_PER_MM
    stripes = np.floor((x + y) / (6.0 * np.sqrt(2.0))).astype(np.int64) % 2 == 0
    patch = (np.abs(x - 92.5) < 62.5) & (np.abs(y - 102.5) < 72.5)
    upper = (_two(_squares(x, y, 12.0)), _two(_squares(x, y, 4.0)), _two(stripes))
    lower = (_smooth_noise(), _print(), np.where(patch, np.float32(DARK), np.float32(0.6)))
    values = np.vstack((np.hstack(upper), np.hstack(lower))).astype(np.float32)
    return Picture(values, 1 / PX_PER_MM, tiled=True)


def chequer(dark: float, bright: float, side_mm: float = 100.0) -> Picture:
    """Squares of two albedos with edges along both axes, four of them meeting at the centre."""
    return Picture(np.array([[dark, bright], [bright, dark]], dtype=np.float32), side_mm, tiled=True)


@dataclass(frozen=True, eq=False)
class Footprints:
    """What the camera's pixels cover of a printed body.

    picture: what is printed. rectangle: the body, as `cast.rectangle` makes it. directions: (N, 3) of the pixels, row
    by row. origin: (3,) of the rays. width: pixels in a row.
    """

    picture: Print
    rectangle: Array
    directions: Array
    origin: Array
    width: int

    def means(self, pixels: NDArray[np.int64], parts: int = 1) -> NDArray[np.float32]:
        """(M, parts, parts) mean albedo over the parts of some pixels' footprints, rows first.

        Args:
            pixels: (M,) which ones, by number.
            parts: of a footprint, along each of its sides.
        """
        means = np.empty((len(pixels), parts, parts), dtype=np.float32)
        rays = (self.rectangle, pixels, self.directions, self.origin, self.width, means)
        picture = self.picture
        if isinstance(picture, Discs):
            centres = np.ascontiguousarray(picture.centres, dtype=np.float64)
            _means_of_discs(centres, picture.radius_mm, picture.inside, picture.around, *rays)
        else:
            _means_of_raster(picture.values, picture.mm_per_px, picture.tiled, np.float32(picture.around), *rays)
        return means


def _squares(u: Array, v: Array, side: float) -> NDArray[np.bool_]:
    even: NDArray[np.bool_] = (np.floor(u / side).astype(np.int64) + np.floor(v / side).astype(np.int64)) % 2 == 0
    return even


def _two(dark: NDArray[np.bool_]) -> NDArray[np.float32]:
    return np.where(dark, np.float32(DARK), np.float32(BRIGHT))


def _smooth_noise() -> NDArray[np.float32]:
    generator = np.random.default_rng(4)
    coarse = sum(
        cv2.resize(
            generator.standard_normal((rows, rows)).astype(np.float32), (740, 820), interpolation=cv2.INTER_CUBIC
        )
        * weight
        for rows, weight in ((6, 1.0), (12, 0.6), (25, 0.35))
    )
    low, high = float(np.min(coarse)), float(np.max(coarse))
    return np.asarray(DARK + (BRIGHT - DARK) * (coarse - low) / (high - low), dtype=np.float32)


def _print() -> NDArray[np.float32]:
    page = np.full((820, 740), 217, dtype=np.uint8)
    lines = (
        "STRUCTURED LIGHT",
        "rows and columns",
        "one pixel each",
        "phase is a ruler",
        "0123456789 %&?",
        "fringe fringe",
    )
    for i, line in enumerate(lines):
        cv2.putText(page, line, (30, 110 + 120 * i), cv2.FONT_HERSHEY_SIMPLEX, 1.9 - 0.05 * len(line), 18, 7 - i)
    return page.astype(np.float32) / np.float32(255)


@kernel
def _means_of_raster(values, mm_per_px, tiled, around, rectangle, pixels, directions, origin, width, means):
    height_px, width_px = values.shape
    for i in range(pixels.shape[0]):
        whole = _footprint(rectangle, directions, origin, width, pixels[i])
        for r in range(means.shape[1]):
            for c in range(means.shape[2]):
                u, v, ax, ay, bx, by = _part(whole, means.shape[1], r, c)
                means[i, r, c] = raster_mean(
                    values,
                    tiled,
                    around,
                    u / mm_per_px + 0.5 * width_px,
                    v / mm_per_px + 0.5 * height_px,
                    ax / mm_per_px,
                    ay / mm_per_px,
                    bx / mm_per_px,
                    by / mm_per_px,
                )


@kernel
def _means_of_discs(centres, radius, inside, around, rectangle, pixels, directions, origin, width, means):
    for i in range(pixels.shape[0]):
        whole = _footprint(rectangle, directions, origin, width, pixels[i])
        for r in range(means.shape[1]):
            for c in range(means.shape[2]):
                u, v, ax, ay, bx, by = _part(whole, means.shape[1], r, c)
                share = 0.0
                for n in range(centres.shape[0]):
                    share += disc_share(u - centres[n, 0], v - centres[n, 1], ax, ay, bx, by, radius)
                means[i, r, c] = around + (inside - around) * share


@kernel
def _part(footprint, parts, row, column):
    """Middle and sides of one of parts x parts of a footprint."""
    u, v, ax, ay, bx, by = footprint
    along, down = (column + 0.5) / parts - 0.5, (row + 0.5) / parts - 0.5
    middle = u + along * ax + down * bx, v + along * ay + down * by
    return middle[0], middle[1], ax / parts, ay / parts, bx / parts, by / parts


@kernel
def _footprint(rectangle, directions, origin, width, i):
    """Middle and sides, mm, of what pixel i covers of the rectangle's plane: as far as to its neighbours' middles."""
    count = directions.shape[0]
    u, v = _on_rectangle(rectangle, directions[i], origin)
    beside = i + 1 if (i + 1) % width else i - 1
    below = i + width if i + width < count else i - width
    u1, v1 = _on_rectangle(rectangle, directions[beside], origin)
    u2, v2 = _on_rectangle(rectangle, directions[below], origin)
    return u, v, u1 - u, v1 - v, u2 - u, v2 - v


@kernel
def _on_rectangle(rectangle, direction, origin):
    """(u, v) mm where a ray meets the rectangle's plane."""
    px, py, pz = rectangle[1] - origin[0], rectangle[2] - origin[1], rectangle[3] - origin[2]
    dx, dy, dz = direction[0], direction[1], direction[2]
    nx, ny, nz = rectangle[10], rectangle[11], rectangle[12]
    t = (nx * px + ny * py + nz * pz) / (nx * dx + ny * dy + nz * dz)
    rx, ry, rz = t * dx - px, t * dy - py, t * dz - pz
    u = rx * rectangle[4] + ry * rectangle[5] + rz * rectangle[6]
    return u, rx * rectangle[7] + ry * rectangle[8] + rz * rectangle[9]


def warm_up() -> None:
    """Compile the kernel (or load it from its cache)."""
    square = np.array([0.0, 0, 0, 9, 1, 0, 0, 0, 1, 0, 0, 0, 1, 5, 5, 0])
    rays = np.array([[0.0, 0.0, 1.0]] * 4)
    for picture in (chequer(0.1, 0.9), Discs(np.zeros((1, 2)), 1.0, 0.1, 0.9)):
        Footprints(picture, square, rays, np.zeros(3), 2).means(np.arange(4))
