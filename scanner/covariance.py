"""A calibration's covariance as its file has it: named parameters and a matrix, or why it is none that can be used."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

LENS_MEMBERS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")

PARAMETERS = frozenset(
    {f"{part}.{member}" for part in ("camera", "projector") for member in LENS_MEMBERS}
    | {f"{part}.{member}" for part in ("rotation", "translation") for member in "xyz"}
)
"""Names that a covariance may have"""

MOST_SIGMA = {"f": 1e4, "c": 1e4, "k": 1e2, "p": 1e2, "rotation": 3.0, "translation": 1e5}
"""1-sigma, px, 1, rad, mm, beyond which a parameter is not known at all, by the first letter of a lens's or the part"""

ASYMMETRY = 1e-4
"""Of two sigmas' product: what numbers written with five digits differ by"""

NEGATIVE = 1e-4
"""The same of the correlations' least eigenvalue, for each parameter"""


@dataclass(frozen=True, eq=False)
class Covariance:
    """Of the named parameters; px, 1, rad (rotation vector), mm."""

    names: tuple[str, ...]
    matrix: NDArray[np.float64]


def read_covariance(content: Any) -> Covariance | None:
    """A calibration file's member "covariance"; None where it has none.

    Raises:
        ValueError: it cannot be used; the message says why.
    """
    if content is None:
        return None
    if not isinstance(content, Mapping):
        raise ValueError(f"it must be null or an object, got {content!r:.40}")  # noqa: TRY004  (one class for all)
    names = content.get("parameters")
    if not isinstance(names, list) or not names or not all(isinstance(name, str) for name in names):
        raise ValueError('"parameters" must be a list of names')
    if unknown := [name for name in names if name not in PARAMETERS]:
        raise ValueError(f'"parameters" names {unknown[0]!r:.40}, which no rig has')
    if len(set(names)) != len(names):
        raise ValueError('"parameters" names one twice')
    try:
        matrix = np.asarray(content.get("matrix"), dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError('"matrix" is no array of numbers') from error
    if matrix.shape != (len(names), len(names)):
        raise ValueError(f'"matrix" has shape {matrix.shape}, {len(names)} parameters are named')
    _require_covariance(matrix)
    for name, sigma in zip(names, np.sqrt(np.diag(matrix)), strict=True):
        part, member = name.split(".")
        if sigma > MOST_SIGMA[part if part in MOST_SIGMA else member[0]]:
            raise ValueError(f'"matrix" has a 1-sigma of {sigma:.2g} for {name}: nothing is known of it')
    return Covariance(tuple(names), matrix)


def taken_as_exact(found: Covariance) -> list[str]:
    """What a covariance does not name of what every rig has: focal lengths, principal points, the projector's place."""
    needed = [f"{part}.{member}" for part in ("camera", "projector") for member in LENS_MEMBERS[:4]]
    needed += [f"{part}.{member}" for part in ("rotation", "translation") for member in "xyz"]
    return [name for name in needed if name not in found.names]


def _require_covariance(matrix: NDArray[np.float64]) -> None:
    if not np.isfinite(matrix).all():
        raise ValueError('"matrix" contains NaN or infinity')
    variances = np.diag(matrix)
    if (variances < 0).any():
        raise ValueError('"matrix" has a variance below zero')
    sigmas = np.sqrt(variances)
    free = sigmas > 0
    scale = np.outer(sigmas, sigmas)
    if (np.abs(matrix - matrix.T) > ASYMMETRY * scale).any():
        raise ValueError('"matrix" is not symmetric')
    correlation = (matrix + matrix.T)[np.ix_(free, free)] / 2 / scale[np.ix_(free, free)]
    if free.any() and np.linalg.eigvalsh(correlation)[0] < -NEGATIVE * len(correlation):
        raise ValueError('"matrix" is not positive semi-definite: it gives some lengths a variance below zero')
    if matrix[~free].any():
        raise ValueError('"matrix" correlates a parameter of no variance')
