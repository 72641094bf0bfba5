"""Are decoded rows or columns as large as the rig's geometry lets them be? A check on whole maps, not on pixels.

A description that names one code bit too many, or frequencies half as high as those projected, decodes without a
residual, and every coordinate is twice what it should be (or half). Codes then name cells beyond the projector. And
on a calibrated rig the coordinates run over the camera's image at twice the pace: they are those of some surface all
the same, but of one that leans away by seventy or eighty degrees wherever the camera looks, or that lies beyond
infinity. Which way lines run is another check: `scanner.orientation`.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace

import numpy as np
from numpy.typing import NDArray

from scanner.decode import Decoded, Reason
from scanner.errors import DecodeError
from scanner.geometry import Array, Calibration
from scanner.lit_check import require_lit
from scanner.orientation import require_orientation
from scanner.patterns import GrayPattern, GrayPmpPattern, PatternSequence, PmpPattern
from scanner.patterns.description import Axis

STEPS = (8, 16, 32, 64)
"""Camera pixels between samples: the first over which a coordinate changes by CLEAR_SIGMAS times its own error, and
that gives no more than MOST_SAMPLES"""

CLEAR_SIGMAS = 8.0
MOST_SAMPLES = 10_000

MIN_SAMPLES = 100
"""Fewer say nothing of the whole."""

FACTORS = (0.5, 2.0)
"""What a wrong number of bits, or frequencies of another octave, make of a coordinate"""

MOST_LEANING_DEG = 65.0
"""Median direction of a scan's surfaces, from the line of sight: a board seen more obliquely shows 42 % of its width.
Half or twice the pace means 62 to 85 degrees on rigs whose rays meet at 5 to 15 degrees."""

PLAIN_LEANING_DEG = 50.0
"""The same scan read at half or twice the pace is a plain one: that is what was projected. On rigs whose rays meet at
20 degrees and more, a coordinate halved leans by 50 degrees or less, as boards do: nothing is said there."""

MOST_IMPOSSIBLE = 0.35
"""Share of samples that have no depth at all. Sound scans have none; noise alone gives half."""

HALF_IMPOSSIBLE = 0.6
"""Of frequencies named an octave too low, half of the image is a period further on, and not plain by any factor."""

MOST_BEYOND = 0.1
"""Share of the read codes that name no projector pixel: light that surfaces throw at one another stays at a
hundredth."""


@dataclass(frozen=True)
class Reading:
    """What a map's coordinates, times a factor, mean on this rig."""

    factor: float
    leaning_deg: float
    """median direction of the surfaces, degrees from the line of sight"""
    impossible: float
    """share of the samples that lie behind the camera or beyond infinity"""

    @property
    def contradicts(self) -> bool:
        """No scan looks like this."""
        return self.impossible > MOST_IMPOSSIBLE or self.leaning_deg > MOST_LEANING_DEG

    @property
    def plain(self) -> bool:
        """Most scans look like this."""
        return self.impossible < HALF_IMPOSSIBLE and self.leaning_deg < PLAIN_LEANING_DEG

    def as_dict(self) -> dict[str, float]:
        """For report.json."""
        return asdict(self)


def require_geometry(decoded: Decoded, calibration: Calibration, sequence: PatternSequence) -> Decoded:
    """Check decoded maps against the rig: which way coordinates run (`scanner.orientation`), at what pace, and whether
    points lie where the projector can light (`scanner.lit_check`).

    Returns:
        The same maps; warnings where a part contradicts, and in `details` what the coordinates mean by "geometry".

    Raises:
        DecodeError: most of a map contradicts the rig.
    """
    warnings: list[str] = []
    readings: dict[str, dict[str, float] | None] = {}
    axes: tuple[Axis, ...] = ("y", "x")
    maps = (decoded.rows, decoded.sigma_rows), (decoded.columns, decoded.sigma_columns)
    for axis, (values, sigma) in zip(axes, maps, strict=True):
        if values is None:
            continue
        if (said := require_orientation(calibration, values, axis)) is not None:
            warnings.append(said)
        if calibration.phase_axis == axis:
            typical = 0.0 if sigma is None else _median(sigma)
            reading = require_scale(calibration, sequence, values, typical, axis)
            lit, unlit = require_lit(calibration, values, sigma, axis)
            readings[axis] = None if reading is None else {**reading.as_dict(), "outside": lit.share}
            warnings += [] if unlit is None else [unlit]
    details = {**decoded.details, "geometry": readings}
    return replace(decoded, details=details, warnings=(*decoded.warnings, *warnings))


def _median(sigma: NDArray[np.float32]) -> float:
    known = sigma[:: STEPS[0], :: STEPS[0]]
    known = known[np.isfinite(known)]
    return float(np.median(known)) if known.size else 0.0


def require_codes_within(decoded: Decoded, sequence: PatternSequence) -> None:
    """Check that codes name pixels that the projector has.

    Raises:
        DecodeError: a tenth of those that could be read do not.
    """
    pattern = sequence.pattern.gray if isinstance(sequence.pattern, GrayPmpPattern) else sequence.pattern
    if not isinstance(pattern, GrayPattern):
        return
    beyond = int(np.count_nonzero(decoded.reason == Reason.BORDER))
    read = beyond + int(np.count_nonzero(decoded.reason == Reason.VALUE))
    if beyond <= MOST_BEYOND * read:
        return
    size = sequence.projector
    raise DecodeError(
        f"{beyond / read:.0%} of the codes that could be read name pixels beyond the projector's "
        f"{size.width} x {size.height}: the pattern description contradicts the frames",
        hint=f"check the description's code_bits ({pattern.code_bits}; bits is {pattern.bits}), its code "
        f"({pattern.code}) and the projector's size",
    )


def require_scale(
    calibration: Calibration, sequence: PatternSequence, values: NDArray[np.float32], sigma_px: float, axis: Axis
) -> Reading | None:
    """Check the pace of one decoded map.

    Args:
        values: (H, W) float32 projector rows (axis "y") or columns (axis "x"), px, NaN where there is none.
        sigma_px: error of a typical one.

    Returns:
        What the map means as it stands; None: too little to say.

    Raises:
        DecodeError: nothing that can be scanned, while half or twice the coordinates are a plain scan.
    """
    here = read_at(calibration, values, sigma_px, axis, 1.0)
    if here is None or not here.contradicts:
        return here
    others = [read_at(calibration, values, sigma_px, axis, factor) for factor in FACTORS]
    plain = [reading for reading in others if reading is not None and reading.plain]
    if not plain:
        return here
    best = min(plain, key=lambda reading: (reading.impossible, reading.leaning_deg))
    name = "rows" if axis == "y" else "columns"
    seen = (
        f"surfaces that lean {here.leaning_deg:.0f} degrees from the line of sight"
        if here.impossible <= MOST_IMPOSSIBLE
        else f"places behind the camera or beyond infinity ({here.impossible:.0%} of them)"
    )
    raise DecodeError(
        f"the decoded {name} mean {seen} on rig {calibration.id or '(no id)'}, and times {best.factor:g} an ordinary "
        f"scan ({best.leaning_deg:.0f} degrees): the pattern description contradicts the frames",
        hint=f"check the description's {_members(sequence)} and the projector's size "
        f"({sequence.projector.width} x {sequence.projector.height})",
    )


def _members(sequence: PatternSequence) -> str:
    pattern = sequence.pattern
    if isinstance(pattern, GrayPattern):
        return f"code_bits ({pattern.code_bits}; bits is {pattern.bits})"
    if isinstance(pattern, GrayPmpPattern):
        return f"frequencies ({pattern.pmp.frequencies[0]:g}) and code_bits ({pattern.gray.code_bits})"
    if isinstance(pattern, PmpPattern):
        return f"frequencies ({', '.join(f'{f:g}' for f in pattern.frequencies)})"
    return "bits"


def read_at(
    calibration: Calibration, values: NDArray[np.float32], sigma_px: float, axis: Axis, factor: float
) -> Reading | None:
    """What coordinates, counted from the projector's edge, times `factor` mean; see `require_scale`."""
    scale = calibration.camera_scale[1 if axis == "y" else 0]
    least = max(CLEAR_SIGMAS * sigma_px * scale, math.sqrt(values.size / MOST_SAMPLES))
    step = next((s for s in STEPS if s >= least), STEPS[-1])
    sampled = (values[::step, ::step].astype(np.float64) + 0.5) * factor - 0.5
    rays = _rays(calibration, sampled.shape, step)
    depth = _depths(calibration, rays, sampled, axis)
    known = np.isfinite(sampled[:-1, :-1]) & np.isfinite(sampled[:-1, 1:]) & np.isfinite(sampled[1:, :-1])
    if np.count_nonzero(known) < MIN_SAMPLES:
        return None
    possible = known & (depth[:-1, :-1] > 0) & (depth[:-1, 1:] > 0) & (depth[1:, :-1] > 0)
    impossible = 1 - np.count_nonzero(possible) / np.count_nonzero(known)
    if np.count_nonzero(possible) < MIN_SAMPLES:
        return Reading(factor, 90.0, impossible)
    points = rays * depth[..., None]
    start = points[:-1, :-1][possible]
    normal = np.cross(points[:-1, 1:][possible] - start, points[1:, :-1][possible] - start)
    sight = rays[:-1, :-1][possible]
    sight /= np.linalg.norm(sight, axis=-1, keepdims=True)
    # The normal per unit of it along the line of sight: what is left across is the tangent of the angle between them.
    towards = np.einsum("ni,ni->n", normal, sight)
    leaning = normal / np.where(towards == 0, np.nan, towards)[:, None] - sight
    across = np.nanmedian(leaning, axis=0)
    return Reading(factor, math.degrees(math.atan(float(np.linalg.norm(across)))), float(impossible))


def _rays(calibration: Calibration, shape: tuple[int, ...], step: int) -> Array:
    """(h, w, 3) x / z, y / z, 1 of every step-th pixel."""
    y, x = np.mgrid[: shape[0], : shape[1]] * float(step)
    directions = calibration.camera.normalised(np.stack((x, y), -1))
    return np.concatenate((directions, np.ones_like(directions[..., :1])), -1)


def _depths(calibration: Calibration, rays: Array, coordinates: Array, axis: Axis) -> Array:
    """Depth along each ray at which it meets the plane of a projector row or column; its lens taken for straight."""
    member = 1 if axis == "y" else 0
    m = calibration.projector.matrix
    across = np.zeros((*coordinates.shape, 3))
    across[..., member] = 1
    across[..., 2] = -(coordinates - m[member, 2]) / m[member, member]
    normal = across @ calibration.rotation
    with np.errstate(divide="ignore", invalid="ignore"):
        found: Array = (normal @ calibration.projector_centre) / np.einsum("hwi,hwi->hw", normal, rays)
    return found
