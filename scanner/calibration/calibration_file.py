"""A solution as a calibration file (formats.md, Calibration): human-readable, with an id that is its content's hash."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.calibration.problem import NAMES, SHEET
from scanner.calibration.sheet import is_exact
from scanner.calibration.solve import Solution, sigmas
from scanner.calibration_id import content_id
from scanner.geometry import calibration_from_dict

RIG_PARAMETERS = 24
"""Of NAMES: both lenses, rotation and translation. The sheet's are the target's business."""
SHEET_KEYS = tuple(name.removeprefix("sheet.") for name in NAMES[SHEET])


def calibration_dict(solution: Solution, created: str | None = None) -> dict[str, Any]:
    """The file's content, checked as a reader would.

    Raises:
        CalibrationError: what was found is no geometry that scans can use (a lens that folds its picture).
    """
    content: dict[str, Any] = {
        "created": created or datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
        **solution.geometry.as_dict(),
        "world": None,
        "hall": None,
        "mcp_phase": None,
        "response": None if solution.response is None else {"projector": solution.response, "camera": None},
        **solution.extra,
        "covariance": _covariance(solution),
        "scale": _scale(solution),
        "residuals": residuals_of(solution),
        "warnings": list(solution.warnings),
        "target": {
            "spec": solution.target.spec,
            **dict(zip(SHEET_KEYS, solution.state.sheet.tolist(), strict=True)),
            "sigma": _sheet_sigma(solution),
        },
        "warm_up": {
            "minutes": solution.options.warm_up_minutes,
            "first_capture": solution.created[0] or None,
            "last_capture": solution.created[1] or None,
            **solution.warm_up,
        },
    }
    content["id"] = content_id(content)
    order = ("format", "version", "id", "created", "units")
    content = {key: content[key] for key in (*order, *(key for key in content if key not in order))}
    calibration_from_dict(content, name="the calibration found")
    return content


def as_text(content: dict[str, Any]) -> str:
    """JSON that a person can read: one line a matrix row."""
    text = json.dumps(content, indent=1)
    # The innermost lists are rows of numbers: each on one line.
    return (
        re.sub(r"\[[^\[\]{}]*\]", lambda m: re.sub(r"\s+", " ", m.group()).replace("[ ", "[").replace(" ]", "]"), text)
        + "\n"
    )


def rms(residuals: NDArray[Any]) -> float:
    """Of points: the root of their mean squared distance."""
    return float(np.sqrt((np.asarray(residuals) ** 2).sum(axis=-1).mean()))


def _covariance(solution: Solution) -> dict[str, Any] | None:
    part = solution.adjusted.covariance[:RIG_PARAMETERS, :RIG_PARAMETERS]
    if not np.isfinite(part).all():
        return None
    return {
        "parameters": list(NAMES[:RIG_PARAMETERS]),
        "units": "px, 1, rad (rotation vector), mm",
        "sigma": np.sqrt(np.clip(np.diag(part), 0, None)).tolist(),
        "matrix": part.tolist(),
    }


def _sheet_sigma(solution: Solution) -> dict[str, float] | None:
    """Of the sheet's scales and bends, 1 sigma; None where none were fitted, or no covariance is known."""
    sigma = sigmas(solution.adjusted)["sheet"]
    if is_exact(solution.problem.priors) or not np.isfinite(sigma).all():
        return None
    return dict(zip(SHEET_KEYS, sigma.tolist(), strict=True))


def _scale(solution: Solution) -> Any:
    length = solution.problem.length
    return "unverified" if length is None else {"reference_mm": length.mm, "sigma_mm": length.sigma_mm}


def residuals_of(solution: Solution) -> dict[str, Any]:
    """How well a calibration fits, px: root mean squares of points' distances, outliers left out, over all views and
    in each. `held_out_px` of a view: predicted by the others."""
    adjusted = solution.adjusted
    views = []
    for k, view in enumerate(solution.problem.views):
        kept = adjusted.kept[k]
        held_out = float(solution.held_out.errors[k])
        views.append(
            {
                "name": view.name,
                "points": int(kept.sum()),
                "outliers": int((~kept).sum()),
                **_fit(solution, [k]),
                "held_out_px": held_out if np.isfinite(held_out) else None,
            }
        )
    every = range(len(views))
    return {**_fit(solution, every), "outliers": sum(view["outliers"] for view in views), "views": views}


def _fit(solution: Solution, views: Iterable[int]) -> dict[str, float | None]:
    """Rms of the kept points of some views; None where they have none."""
    adjusted, chosen = solution.adjusted, list(views)

    def of(residuals: Sequence[NDArray[Any]]) -> float | None:
        kept = np.concatenate([residuals[k][adjusted.kept[k]] for k in chosen])
        return rms(kept) if len(kept) else None

    return {
        "camera_px": of(adjusted.camera_residuals),
        "projector_px": of(adjusted.projector_residuals),
        "epipolar_px": of([off[:, None] for off in solution.epipolar]),
    }
