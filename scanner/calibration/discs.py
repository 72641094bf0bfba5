"""Discs in pictures: grids of circles found by OpenCV, and every disc's centre from its rim.

A rim point is where the grey level, followed outwards from the disc's middle, has spent half of its change; an
ellipse is fitted to some sixty of them. Its centre is not where the disc's own centre is seen (perspective shortens
the far half): `eccentricity` says by how much, once pose and lens are known.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import permutations, product
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from scanner.calibration.targets import FEWEST_DISCS, Target

Array = NDArray[np.float64]
Found = tuple[NDArray[np.int64], Array, Array]
"""ids (N,), points (N, 2) px, spacing (N,) px"""

RAYS = 64
INSIDE, OUTSIDE = 0.6, 1.5
"""Radii, in units of the rim's, between which a ray is followed: beyond them there is one level each."""
PLAIN_INSIDE, PLAIN_OUTSIDE = 0.8, 1.2
"""Radii up to which only the disc is seen, and from which only its ground."""
PASSES = 3
MOST_MISFIT = 0.15
"""Of rim points from their ellipse, as a share of its radius (median): beyond, it is no disc."""
LEAST_RADIUS_PX = 2.5
MOST_OTHER_SIZE = 1.15
"""By which discs may be larger or smaller than stated (median): a twentieth is what blur, light and a rough shape make;
the correction for perspective goes with the square of it."""
MOST_BLOBS = 45
"""Of a picture in which discs in space are looked for: all threes of more take seconds."""
NEAR_SHARE = 0.35
"""Of the discs' distance: how near a blob must lie to where an affine picture has it. A wedge of a fifth of its width
in depth is off by a tenth."""
LEAST_BREADTH = 0.01
"""Of a target in space, seen from its discs' front, to its length: less is a line, which no affine picture explains."""
LEAST_DISC_SHARE = 0.6


def detect_circles(picture: NDArray[np.float32], grey: NDArray[np.uint8], target: Target) -> Found | str:
    """The grid of circles in a picture, or why not."""
    size = (target.columns, target.rows)
    flags = cv2.CALIB_CB_ASYMMETRIC_GRID if target.kind == "acircles" else cv2.CALIB_CB_SYMMETRIC_GRID
    for shown, clustering in product((grey, 255 - grey), (0, cv2.CALIB_CB_CLUSTERING)):
        found, centres = cv2.findCirclesGrid(shown, size, flags=flags | clustering, blobDetector=_blobs(grey.shape))
        if found:
            break
    else:
        return f"no grid of {target.columns} x {target.rows} circles in the picture"
    points = np.asarray(centres, dtype=np.float64).reshape(-1, 2)
    homography = np.asarray(cv2.findHomography(target.points[:, :2], points)[0], dtype=np.float64)
    if homography.shape != (3, 3):
        return "the circles found lie on a line"
    affine = _local_affine(homography, target.points[:, :2])
    shapes = affine * (target.diameter_mm / 2)
    spacing = np.linalg.norm(affine[:, :, 0], axis=1) * target.spacing_mm
    measured, radii = measured_discs(picture, points, shapes)
    kept = np.isfinite(measured).all(axis=1)
    if kept.sum() < 0.7 * len(points):
        return f"{int(kept.sum())} of {len(points)} circles are sharp enough to be measured"
    if (other := _of_other_size(radii[kept], shapes[kept], target)) is not None:
        return other
    return np.flatnonzero(kept).astype(np.int64), measured[kept], spacing[kept]


def detect_discs(picture: NDArray[np.float32], grey: NDArray[np.uint8], target: Target) -> Found | str:
    """The discs of a target in space, or why not: blobs that an affine picture of the target explains.

    Of several such pictures (a target that looks the same upside down) the most upright one is taken.
    """
    flat = _seen_from_the_front(target)
    spread = np.linalg.svd(flat, compute_uv=False)
    if spread[1] < LEAST_BREADTH * spread[0]:
        return "the target's discs lie on one line, as seen from their front: put them right in its file"
    best: tuple[int, float, Array] = (0, 0.0, np.zeros((2, 3)))
    for shown in (grey, 255 - grey):
        blobs = np.array([k.pt for k in _blobs(grey.shape).detect(shown)], dtype=np.float64).reshape(-1, 2)
        if 3 <= len(blobs) <= MOST_BLOBS:
            best = max(best, _affine_of(flat, blobs), key=lambda fit: fit[:2])
    count, _, affine = best
    if count < max(FEWEST_DISCS, LEAST_DISC_SHARE * len(flat)):
        return f"{count} of the target's {len(flat)} discs in the picture"
    guess = flat @ affine[:, :2].T + affine[:, 2]
    blobs = np.concatenate(
        [np.array([k.pt for k in _blobs(grey.shape).detect(s)]).reshape(-1, 2) for s in (grey, 255 - grey)]
    )
    scale = float(np.sqrt(abs(np.linalg.det(affine[:, :2]))))
    spacing = scale * target.spacing_mm
    off = np.linalg.norm(guess[:, None] - blobs[None], axis=-1)
    near = off.min(axis=1) < NEAR_SHARE * spacing
    ids = np.flatnonzero(near).astype(np.int64)
    shapes = np.tile(affine[:, :2] * (target.diameter_mm / 2), (len(ids), 1, 1))
    measured, radii = measured_discs(picture, blobs[off.argmin(axis=1)[near]], shapes)
    kept = np.isfinite(measured).all(axis=1)
    if kept.sum() < FEWEST_DISCS:
        return f"{int(kept.sum())} of the target's {len(flat)} discs are sharp enough to be measured"
    if (other := _of_other_size(radii[kept], shapes[kept], target)) is not None:
        return other
    return ids[kept], measured[kept], np.full(int(kept.sum()), spacing)


def _of_other_size(radii: Array, shapes: Array, target: Target) -> str | None:
    """In words, where discs are not as large as stated. radii: (N,) px; shapes: see `measured_discs`."""
    ratio = float(np.median(radii / np.sqrt(np.abs(np.linalg.det(shapes)))))
    if 1 / MOST_OTHER_SIZE < ratio < MOST_OTHER_SIZE:
        return None
    return (
        f"the target's discs are {ratio * target.diameter_mm:.3g} mm across in the picture, measured by their "
        f"distances, and {target.diameter_mm:g} mm by its description"
    )


def disc_centres(picture: NDArray[np.float32], points: Array, shapes: Array) -> Array:
    """(N, 2) px, centres of the ellipses that discs are seen as; arguments as of `measured_discs`."""
    return measured_discs(picture, points, shapes)[0]


def measured_discs(picture: NDArray[np.float32], points: Array, shapes: Array) -> tuple[Array, Array]:
    """Centres and sizes of the ellipses that discs are seen as.

    Args:
        picture: (H, W) grey levels.
        points: (N, 2) px, good to a quarter of the radius.
        shapes: (N, 2, 2) px: the unit circle's image, as a rough ellipse.

    Returns:
        (N, 2) px, centres; (N,) px, radii of circles of the same area; NaN where no ellipse fits.
    """
    angles = 2 * np.pi * np.arange(RAYS) / RAYS
    circle = np.column_stack((np.cos(angles), np.sin(angles)))
    found, radii = np.full((len(points), 2), np.nan), np.full(len(points), np.nan)
    for i, (point, shape) in enumerate(zip(points, shapes, strict=True)):
        centre, axes = point, shape
        for _ in range(PASSES):
            rim = _rim(picture, centre, circle @ axes.T)
            fitted = None if rim is None else fit_ellipse(rim)
            if fitted is None:
                break
            centre, axes = fitted
        if rim is None or fitted is None or np.sqrt(abs(np.linalg.det(axes))) < LEAST_RADIUS_PX:
            continue
        radius = np.linalg.norm(np.linalg.solve(axes, (rim - centre).T), axis=0)
        if np.median(np.abs(radius - 1)) < MOST_MISFIT:
            found[i], radii[i] = centre, np.sqrt(abs(np.linalg.det(axes)))
    return found, radii


def fit_ellipse(points: Array) -> tuple[Array, Array] | None:
    """Centre (2,) and axes (2, 2), the unit circle's image, of the ellipse through points (N, 2); None where none is.

    Linear least squares on the conic in normalised coordinates, points far from it left out once.
    """
    middle = points.mean(axis=0)
    spread = max(float(np.abs(points - middle).max()), 1e-9)
    q = (points - middle) / spread
    keep = np.ones(len(q), dtype=bool)
    for _ in range(2):
        if keep.sum() < 6:
            return None
        x, y = q[keep].T
        terms = np.column_stack((x * x, x * y, y * y, x, y))
        a, b, c, d, e = np.linalg.lstsq(terms, np.ones(len(x)), rcond=None)[0]
        form = np.array([[a, b / 2], [b / 2, c]])
        if not np.linalg.det(form) > 1e-6 * (a + c) ** 2 or a <= 0:  # a parabola or worse
            return None
        centre = -0.5 * np.linalg.solve(form, np.array([d, e]))
        level = 1.0 + centre @ form @ centre
        axes = np.linalg.inv(np.linalg.cholesky(form / level)).T
        off = np.abs(np.linalg.norm(np.linalg.solve(axes, (q - centre).T), axis=0) - 1)
        keep = off <= max(4 * float(np.median(off)), 1e-6)
    return middle + spread * centre, spread * axes


def eccentricity(centres: Array, normals: Array, radius_mm: float, project: Callable[[Array], Array]) -> Array:
    """(N, 2) px from where a disc's centre is seen to the centre of the ellipse it is seen as.

    Args:
        centres: (N, 3) mm.
        normals: (N, 3) unit vectors.
        radius_mm: of the discs.
        project: (M, 3) mm to (M, 2) px.
    """
    angles = 2 * np.pi * np.arange(RAYS) / RAYS
    moved = np.zeros((len(centres), 2))
    for i, (centre, normal) in enumerate(zip(centres, normals, strict=True)):
        u = np.cross(normal, (0.0, 1.0, 0.0) if abs(normal[1]) < 0.9 else (1.0, 0.0, 0.0))
        u = u / np.linalg.norm(u)
        v = np.cross(normal, u)
        rim = centre + radius_mm * (np.cos(angles)[:, None] * u + np.sin(angles)[:, None] * v)
        fitted = fit_ellipse(project(rim))
        if fitted is not None:
            moved[i] = fitted[0] - project(centre[None])[0]
    return moved


def _seen_from_the_front(target: Target) -> Array:
    """(N, 2) mm: the target's points seen along its discs' mean normal, x right and y down for who looks at them."""
    points = target.points - target.points.mean(axis=0)
    facing = np.array([0.0, 0.0, -1.0]) if target.normals is None else target.normals.mean(axis=0)
    away = -facing / max(float(np.linalg.norm(facing)), 1e-9)
    right = np.cross((0.0, 1.0, 0.0) if abs(away[1]) < 0.9 else (0.0, 0.0, 1.0), away)
    right /= np.linalg.norm(right)
    return np.asarray(points @ np.column_stack((right, np.cross(away, right))), dtype=np.float64)


def _affine_of(flat: Array, blobs: Array) -> tuple[int, float, Array]:
    """How many points an affine picture of the target explains, how upright it is (cosine), and the picture (2, 3)."""
    # Three points far apart: their triangle has the largest area of some hundred drawn ones.
    drawn = np.random.default_rng(0).permuted(np.tile(np.arange(len(flat)), (400, 1)), axis=1)[:, :3]
    areas = np.abs(_area(flat[drawn]))
    corners = flat[drawn[np.argmax(areas)]]
    three = np.array(list(permutations(range(len(blobs)), 3)))
    three = three[_area(blobs[three]) * _area(corners[None]) > 0]  # the front is seen, not its mirror image
    source = np.linalg.inv(np.column_stack((corners, np.ones(3))))
    affine = np.swapaxes(source @ np.concatenate((blobs[three],), axis=0), 1, 2)
    best: tuple[int, float, Array] = (0, 0.0, np.zeros((2, 3)))
    spacing = float(np.median(np.sort(np.linalg.norm(flat[:, None] - flat[None], axis=-1), axis=1)[:, 1]))
    for part in np.array_split(affine, max(1, len(affine) // 2000)):
        guess = flat @ np.swapaxes(part[:, :, :2], 1, 2) + part[:, None, :, 2]
        off = np.linalg.norm(guess[:, :, None] - blobs[None, None], axis=-1).min(axis=2)
        scale = np.sqrt(np.abs(np.linalg.det(part[:, :, :2])))
        count = (off < NEAR_SHARE * spacing * scale[:, None]).sum(axis=1)
        upright = part[:, 0, 0] / np.maximum(np.linalg.norm(part[:, :, 0], axis=1), 1e-12)
        k = int(np.lexsort((upright, count))[-1])
        best = max(best, (int(count[k]), float(upright[k]), part[k]), key=lambda fit: fit[:2])
    return best


def _area(triangles: Array) -> Array:
    """(...,) twice the signed area of triangles (..., 3, 2)."""
    a, b = triangles[..., 1, :] - triangles[..., 0, :], triangles[..., 2, :] - triangles[..., 0, :]
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


def _rim(picture: NDArray[np.float32], centre: Array, rays: Array) -> Array | None:
    """Points of the rim along rays (RAYS, 2), each to a rough rim point; None where they leave the picture."""
    longest = float(np.linalg.norm(rays, axis=1).max())
    count = int(np.clip(np.ceil(4 * (OUTSIDE - INSIDE) * longest), 12, 200))
    at = INSIDE + (OUTSIDE - INSIDE) * (np.arange(count) + 0.5) / count
    where = centre + at[:, None, None] * rays
    height, width = picture.shape
    if where.min() < 0 or where[..., 0].max() > width - 1 or where[..., 1].max() > height - 1:
        return None
    levels = map_coordinates(picture, [where[..., 1].ravel(), where[..., 0].ravel()], order=1)
    shaded: Array = levels.astype(np.float64).reshape(count, len(rays))
    profile = _evenly_lit(shaded, at, where - centre, longest)
    ends = max(count // 8, 1)
    inside, outside = profile[:ends].mean(axis=0), profile[-ends:].mean(axis=0)
    change = inside - outside
    typical = float(np.median(change))
    if typical == 0 or not np.isfinite(typical):
        return None
    # The share of the way that is still inside: where the step would be were it sharp.
    share = ((profile - outside) / np.where(change == 0, np.inf, change)).mean(axis=0)
    good = (change / typical > 0.5) & (share > 0) & (share < 1)
    if good.sum() < RAYS // 2:
        return None
    radius = INSIDE + (OUTSIDE - INSIDE) * share[good]
    return np.asarray(centre + radius[:, None] * rays[good], dtype=np.float64)


def _evenly_lit(profile: Array, at: Array, where: Array, longest: float) -> Array:
    """Grey levels along rays with the light's slope over the disc taken out.

    Light that falls off to one side makes every rim point drift to the same side: 1 % over a radius is a tenth of a
    pixel. The slope is common to the disc and to its ground (their levels' logarithms on two parallel planes).
    """
    inner, outer = at < PLAIN_INSIDE, at > PLAIN_OUTSIDE
    samples = inner | outer
    levels = profile[samples]
    if not (levels > 0).all():
        return profile
    x, y = where[samples, :, 0].ravel() / longest, where[samples, :, 1].ravel() / longest
    is_inner = np.repeat(inner[samples], profile.shape[1]).astype(np.float64)
    terms = np.column_stack((is_inner, 1 - is_inner, x, y))
    slope = np.linalg.lstsq(terms, np.log(levels).ravel(), rcond=None)[0][2:]
    return np.asarray(profile / np.exp(where @ slope / longest), dtype=np.float64)


def _local_affine(homography: Array, points: Array) -> Array:
    """(N, 2, 2): how a homography moves (N, 2) points that are moved a little."""
    h = homography
    w = points @ h[2, :2] + h[2, 2]
    image = (points @ h[:2, :2].T + h[:2, 2]) / w[:, None]
    return np.asarray((h[:2, :2][None] - image[:, :, None] * h[2, :2][None, None]) / w[:, None, None], dtype=np.float64)


def _blobs(shape: tuple[int, ...]) -> Any:
    """A detector of dark blobs from 2.5 px of radius to an eighth of the picture's height."""
    opencv: Any = cv2  # its annotations leave the blob detector out
    parameters = opencv.SimpleBlobDetector_Params()
    parameters.filterByArea = True
    parameters.minArea = float(np.pi * LEAST_RADIUS_PX**2)
    parameters.maxArea = float(np.pi * (shape[0] / 8) ** 2)
    parameters.filterByCircularity = False
    parameters.filterByInertia = False
    parameters.filterByConvexity = True
    parameters.minConvexity = 0.8
    parameters.minDistBetweenBlobs = 2 * LEAST_RADIUS_PX
    return opencv.SimpleBlobDetector_create(parameters)
