"""A response's ripple in decoded coordinates: what overtones that pass for the fringe have put into them.

With three to five shifts a response that is no line moves the finest phase N times a period. By how much, the scan's
own frequencies say (`scanner.decode.ripples`). Where it is asked for, it is taken off as a function of the phase, so
that captures that were projected with a wrong gamma need not be taken again; else sigmas are widened by it, as an error
that is known to be there and was not corrected enlarges what is stated (GUM, JCGM 100:2008, F.2.4.5). Blur weakens
overtones: what is taken off, or stated, is what this scan shows, not what a response would make of a sharp image.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.decode import Decoded, Map
from scanner.decode.ripples import FEWEST_SHIFTS_UNHARMED
from scanner.errors import DecodeError
from scanner.kernel import kernel
from scanner.patterns import Axis, PatternSequence, PmpPattern
from scanner.scan import Scan
from scanner.scan_report import spread

CERTAIN_SIGMAS = 4.0
"""A ripple lower than this times its own sigma is left alone: taking noise off adds it."""

_TABLE = 1024


def without_ripple(decoded: Decoded, sequence: PatternSequence) -> Decoded:
    """The same maps without the finest set's ripple, where it is told and certain; PMP only.

    In `details`, the set's `ripple_px` becomes what may be left, and `corrected` is true. Where nothing is taken off, a
    warning says why.

    Raises:
        DecodeError: another method.
    """
    pattern = sequence.pattern
    light: Mapping[str, Any] = decoded.details.get("light") or {}
    if not isinstance(pattern, PmpPattern):
        raise DecodeError(
            f"ripple is corrected in PMP scans, and this one is {pattern.method}", hint="leave --correct-ripple out"
        )
    if not light:
        return decoded
    maps: dict[Axis, Map | None] = {"y": decoded.rows, "x": decoded.columns}
    told, said, before = dict(light), list[str](), decoded.warnings
    for axis in pattern.axes:
        harmonics = [dict(h) for h in light[axis]["harmonics"]]
        finest = max(range(len(harmonics)), key=lambda k: harmonics[k]["frequency"])
        found, values = harmonics[finest].get("ripple"), maps[axis]
        if (idle := _nothing_to_correct(harmonics[finest])) is not None or found is None or values is None:
            said.append(f"--correct-ripple took nothing off along {axis}: {idle}")
            continue
        straight = values.copy()
        per_px = harmonics[finest]["frequency"] / sequence.projector.along(axis)
        _take_off(straight.reshape(-1), _table(harmonics[finest]), pattern.origin, per_px)
        maps[axis] = straight
        before = tuple(_as_found(warning, axis, found["sigma_px"]) for warning in before)
        harmonics[finest] |= {"ripple_px": found["sigma_px"], "corrected": True}
        told[axis] = {**light[axis], "harmonics": harmonics}
    details = {**decoded.details, "light": told}
    return replace(
        decoded, rows=maps["y"], columns=maps["x"], details=details, warnings=(*before, *said)
    )  # fmt: skip


def _as_found(warning: str, axis: Axis, sigma_px: float) -> str:
    """A warning of the ripple, which is taken off now: what it says was before that."""
    if not warning.startswith(f"ripple along {axis}: "):
        return warning
    seen = warning.rsplit(": ", 1)[0]
    return f"{seen}: taken off (--correct-ripple), as far as these frames tell it (1 sigma {sigma_px:.3f} px)"


def _nothing_to_correct(finest: Mapping[str, Any]) -> str | None:
    """Why; None where there is something."""
    found = finest.get("ripple")
    if finest["shifts"] >= FEWEST_SHIFTS_UNHARMED:
        return f"with {finest['shifts']} shifts no overtone of a response passes for the fringe"
    if found is None:
        return "no other frequency, or too few pixels, to tell a ripple by"
    height = float(np.hypot(found["cosine_px"], found["sine_px"]))
    if height < CERTAIN_SIGMAS * found["sigma_px"]:
        return f"its ripple of {height:.3f} projector px is not certain (1 sigma {found['sigma_px']:.3f} px)"
    return None


def widen_by_ripple(scan: Scan, sequence: PatternSequence, phase_axis: str) -> Scan:
    """The same scan with sigmas, in its maps and its report, that cover the finest set's ripple; PMP only.

    A pixel's sigma grows by the ripple at its phase, and by how uncertain that is; by the latter alone where the ripple
    was taken off. After the budget was made, in which the ripple is a cause of its own.

    Args:
        phase_axis: the axis that depth comes from, where both were projected.
    """
    pattern, wider = sequence.pattern, dict[str, Map]()
    if not isinstance(pattern, PmpPattern):
        return scan
    light: Mapping[str, Any] = (scan.report.get("decoder") or {}).get("light") or {}
    for axis in pattern.axes:
        name = "rows" if axis == "y" else "columns"
        values, sigma = getattr(scan, name), getattr(scan, f"sigma_{name}")
        harmonics: list[Mapping[str, Any]] = (light.get(axis) or {}).get("harmonics") or []
        finest = max(harmonics, key=lambda h: float(h["frequency"]), default={})
        if values is None or sigma is None or not finest.get("ripple"):
            continue
        table = np.zeros(_TABLE, np.float32) if finest.get("corrected") else _table(finest)
        variance = table**2 + np.float32(finest["ripple"]["sigma_px"] ** 2)
        depth = scan.sigma_z if axis == phase_axis or len(pattern.axes) == 1 else None
        scaled = np.empty(0, np.float32) if depth is None else depth.copy()
        wide = wider[f"sigma_{name}"] = sigma.copy()
        per_px = finest["frequency"] / sequence.projector.along(axis)
        _widen(values.reshape(-1), variance, pattern.origin, per_px, wide.reshape(-1), scaled.reshape(-1))
        wider |= {} if depth is None else {"sigma_z": scaled}
    if not wider:
        return scan
    told = {f"{name}_{'mm' if name == 'sigma_z' else 'px'}": spread(v[::2, ::2]) for name, v in wider.items()}
    return replace(
        scan,
        report={**scan.report, **told},
        sigma_rows=wider.get("sigma_rows", scan.sigma_rows),
        sigma_columns=wider.get("sigma_columns", scan.sigma_columns),
        sigma_z=wider.get("sigma_z", scan.sigma_z),
    )


def _table(harmonics: Mapping[str, Any]) -> NDArray[np.float32]:
    """(_TABLE,) px by which the ripple moves a coordinate, over one period of the set."""
    turns = 2 * np.pi * harmonics["shifts"] * np.arange(_TABLE) / _TABLE
    ripple = harmonics["ripple"]
    return np.asarray(ripple["cosine_px"] * np.cos(turns) + ripple["sine_px"] * np.sin(turns), np.float32)


def warm_up() -> None:
    """Compile the kernels."""
    two, table = np.zeros(2, np.float32), np.zeros(_TABLE, np.float32)
    _take_off(two, table, 0.5, 0.1)
    _widen(two, table, 0.5, 0.1, two.copy(), two.copy())


@kernel
def _take_off(values: NDArray[np.float32], table: NDArray[np.float32], origin: float, per_px: float) -> None:
    for i in range(values.size):
        if not np.isnan(values[i]):
            cycles = (values[i] + origin) * per_px
            values[i] -= table[int((cycles - np.floor(cycles)) * table.size) % table.size]


@kernel
def _widen(
    values: NDArray[np.float32],
    variance: NDArray[np.float32],
    origin: float,
    per_px: float,
    sigma: NDArray[np.float32],
    depth: NDArray[np.float32],
) -> None:
    # By the variance at each value's phase; depth's sigma grows by the same factor, and may be empty.
    for i in range(values.size):
        if not np.isnan(values[i]):
            cycles = (values[i] + origin) * per_px
            more = variance[int((cycles - np.floor(cycles)) * variance.size) % variance.size]
            before = sigma[i]
            sigma[i] = np.sqrt(before * before + more)
            if depth.size > 0:
                depth[i] *= sigma[i] / before
