"""`fringed calibrate solve`: captures of a target in several poses to a calibration file. Needs no device."""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from scanner.digits import rounded, with_uncertainty
from scanner.stated_length import dominates, stated_length_of
from service.commands.options import AsJson, output_path, require_free
from service.terminal import print_error, print_facts, print_json, print_table, progress_lines

if TYPE_CHECKING:
    from scanner.calibration.solve import Solution

TARGET_HELP = (
    "chessboard:9x6:30 (inner corners, mm), charuco:10x7:30[:MARKER[:DICT]] (squares), circles:COLSxROWS:MM[:DIAM], "
    "acircles:COLSxROWS:MM[:DIAM], wedge:FILE."
)

DISTORTION = ("k1", "k2", "p1", "p2", "k3")
"""As they stand in a lens"""

SUREST = 1e-7
"""1-sigma of a length, as a share of it, that nothing betters: gauge blocks are calibrated to that by interferometry"""
NOTABLE_WIDENING = 1.05
"""From where on uncertainties are said to be wider: one more digit than they are printed with"""


class Model(StrEnum):
    """What is fitted."""

    PINHOLE = "pinhole"
    HALL = "hall"


Replace = Annotated[bool, typer.Option("--force", help="Replace files that exist.")]
Length = Annotated[
    str | None,
    typer.Option(
        metavar="MM[:SIGMA]",
        help="Measured length of the target's longest row of points, from the first to the last, mm, and its 1-sigma "
        "(else 0.1).",
    ),
]
Rigid = Annotated[bool, typer.Option("--rigid", help="The target is glass or metal: it neither stretches nor bends.")]
Baseline = Annotated[
    float | None,
    typer.Option(
        metavar="MM", min=1, max=1e5, help="Distance from lens to lens by a rule, mm: a result off by 15 % is refused."
    ),
]
Distance = Annotated[
    float | None,
    typer.Option(
        metavar="MM", min=1, max=1e6, help="Distance of the targets by a rule, mm: a result off by 15 % is refused."
    ),
]
WarmUp = Annotated[
    float | None,
    typer.Option(metavar="MINUTES", min=0, max=1e5, help="How long the rig had been on, minutes; is recorded."),
]


def solve(
    captures: Annotated[
        list[Path], typer.Argument(metavar="CAPTURE...", help="Capture folders, scans' folders, or folders of those.")
    ],
    target: Annotated[str, typer.Option(metavar="TARGET", help=TARGET_HELP)],
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="FILE", parser=output_path, help="Calibration file to write.")
    ],
    model: Annotated[
        Model,
        typer.Option(metavar="pinhole|hall", help="Lenses with distortion, or the dissertation's 3 x 4 matrices."),
    ] = Model.PINHOLE,
    length: Length = None,
    rigid: Rigid = False,
    baseline: Baseline = None,
    distance: Distance = None,
    warm_up: WarmUp = None,
    picture: Annotated[
        bool, typer.Option("--picture/--no-picture", help="Draw residuals and coverage to FILE's name with .png.")
    ] = True,
    force: Replace = False,
    as_json: AsJson = False,
) -> int:
    """Calibrate camera and projector from captures of a target, both axes in each.

    Captures that cannot serve are left out and named. A result that cannot be is refused with its likely cause, and no
    file is written.

    \b
    Examples:
    After the simulated run of fringed calibrate run --help:
      fringed calibrate solve scans/rig/poses --target charuco:10x7:30 --length 240:0.05 -o scans/rig.json
    With captures of your own:
      fringed calibrate solve p1 p2 p3 p4 --target charuco:10x7:30 --length 240.1:0.05 -o rig.json
      fringed calibrate solve poses/ --target chessboard:9x6:30 --baseline 240 -o rig.json --json
      fringed calibrate solve wedge/ --target wedge:wedge.json --model hall -o rig.json
    """
    stated = None if length is None else length_given(length)
    drawing = output.with_suffix(".png") if picture else None
    require_free(output, drawing, force=force)
    with progress_lines() as lines:
        lines.stage("opening captures")
        from scanner.calibration.calibration_file import as_text, calibration_dict  # noqa: PLC0415
        from scanner.calibration.observe import find_captures, observe  # noqa: PLC0415
        from scanner.calibration.solve import SolveOptions  # noqa: PLC0415
        from scanner.calibration.solve import solve as solve_pinhole  # noqa: PLC0415
        from scanner.calibration.solve_hall import solve_hall  # noqa: PLC0415
        from scanner.calibration.targets import parse_target  # noqa: PLC0415
        from scanner.storage import replace_file, try_file  # noqa: PLC0415

        looked_for = parse_target(target)
        try_file(output)
        paths = find_captures(captures)
        lines.stage("looking for the target", len(paths))
        observations, left_out = observe(
            paths, looked_for, lambda done, total: lines.advance(done, total, f"{done} of {total} captures")
        )
        options = SolveOptions(stated, rigid, baseline, distance, warm_up)
        solve_rig = solve_hall if model == Model.HALL else solve_pinhole
        solution = solve_rig(looked_for, observations, options, left_out, lines.stage)
        content = calibration_dict(solution)
        lines.stage("writing")
        if drawing is not None:
            from scanner.calibration.pictures import draw  # noqa: PLC0415

            replace_file(drawing, draw(solution))
        replace_file(output, as_text(content).encode())
    report(solution, content, output, drawing, as_json=as_json)
    return 0


def length_given(text: str) -> tuple[float, float]:
    """MM[:SIGMA] as two numbers.

    Raises:
        typer.BadParameter: it is not.
    """
    mm, colon, sigma = text.partition(":")
    try:
        values = float(mm), float(sigma) if colon else 0.1
    except ValueError as error:
        raise typer.BadParameter(f"--length: expected MM or MM:SIGMA, got {text!r}") from error
    if not (0 < values[0] < 1e6 and 0 < values[1] < values[0]):
        raise typer.BadParameter(f"--length: {text!r} is no length with its uncertainty")
    if values[1] < SUREST * values[0]:
        raise typer.BadParameter(
            f"--length: nothing measures {values[0]:g} mm to {values[1]:g} mm (1-sigma): a caliper has some 0.02 mm, a "
            f"coordinate measuring machine 0.001 mm; the least that is taken is {SUREST * values[0]:.1g} mm"
        )
    return values


def report(
    solution: Solution, content: dict[str, Any], output: Path, drawing: Path | None, *, as_json: bool, **more: Any
) -> None:
    """Print what was found: the views, the figures, what was left out. more: members of the JSON document."""
    if as_json:
        print_json({**_document(solution, content, output, drawing), **more})
    else:
        _show(solution, content, output, drawing)
        for one in solution.left_out:
            print_error(f"left out {one.name}: {one.reason}", label="warning")
    for warning in _warnings(solution, content):
        print_error(warning, label="warning")
    if (hint := dominates(_length_in_translation(solution, content))) is not None:
        print_error(hint, label="note")


def _warnings(solution: Solution, content: dict[str, Any]) -> list[str]:
    if content["scale"] != "unverified":
        return list(solution.warnings)
    unverified = (
        "scale unverified: no length was stated, and all lengths are only as right as the target's stated size; "
        "measure its longest row of points (--length MM:SIGMA)"
    )
    return [*solution.warnings, unverified]


def _length_in_translation(solution: Solution, content: dict[str, Any]) -> dict[str, Any] | None:
    """The stated length and its share of the baseline's variance; None where there is none, or no covariance."""
    length, shift = stated_length_of(content["scale"]), solution.state.translation
    if length is None or content["covariance"] is None:
        return None
    from scanner.calibration.problem import SHIFT  # noqa: PLC0415
    from scanner.calibration.sheet import adjusted_length  # noqa: PLC0415

    baseline = math.hypot(*shift)
    variance = float(shift @ solution.adjusted.covariance[SHIFT, SHIFT] @ shift) / baseline**2
    # Where prints are known better than the length is, the print decides, and the length has a small weight.
    adjusted = adjusted_length(solution.problem, solution.state, solution.adjusted.covariance)
    weight = 1.0 if adjusted is None else min((adjusted[1] / length.sigma_mm) ** 2, 1.0)
    share = weight**2 * length.share(baseline, math.sqrt(max(variance, 0.0)))
    of = f"the distance from lens to lens, {baseline:.1f} mm"
    return {"reference_mm": length.reference_mm, "sigma_mm": length.sigma_mm, "share": share, "of": of}


def _document(solution: Solution, content: dict[str, Any], output: Path, drawing: Path | None) -> dict[str, Any]:
    return {
        "file": str(output),
        "picture": drawing and str(drawing),
        "calibration": content,
        "views": content["residuals"]["views"],
        "left_out": [{"name": one.name, "reason": one.reason} for one in solution.left_out],
        "warnings": _warnings(solution, content),
    }


def _show(solution: Solution, content: dict[str, Any], output: Path, drawing: Path | None) -> None:
    residuals = content["residuals"]
    header = ("view", "points", "outliers", "camera px", "projector px", "epipolar px", "held out px")
    names = ("name", "points", "outliers", "camera_px", "projector_px", "epipolar_px", "held_out_px")
    print_table("views", header, ([_cell(view[name]) for name in names] for view in residuals["views"]))
    print_facts("calibration", _facts(solution, content, output, drawing))


def _facts(
    solution: Solution, content: dict[str, Any], output: Path, drawing: Path | None
) -> Sequence[tuple[str, Any]]:
    import numpy as np  # noqa: PLC0415

    from scanner.calibration.lens_slopes import vector_of  # noqa: PLC0415
    from scanner.calibration.solve import sigmas  # noqa: PLC0415

    state, spread = solution.state, sigmas(solution.adjusted)
    facts: list[tuple[str, Any]] = [("id", content["id"])]
    for side, lens in (("camera", state.camera), ("projector", state.projector)):
        m, s = lens.matrix, spread[side]
        facts.append(
            (
                side,
                f"focal {_stated(m[0, 0], s[0])}, {_stated(m[1, 1], s[1])} px; "
                f"axis at {_stated(m[0, 2], s[2])}, {_stated(m[1, 2], s[3])} px",
            )
        )
        if lens.distortion.any():
            numbers = zip(DISTORTION, lens.distortion, s[4:], strict=True)
            facts.append(("", "distortion " + ", ".join(f"{name} {_stated(v, e)}" for name, v, e in numbers)))
    turn = np.degrees(vector_of(state.rotation))
    told = ", ".join(_stated(v, e) for v, e in zip(turn, np.degrees(spread["rotation"]), strict=True))
    facts.append(("rotation", f"{told} degrees, the vector about which the projector is turned"))
    shift, s = state.translation, spread["translation"]
    scale = content["scale"]
    if scale == "unverified":
        facts.append(("translation", _unverified(shift.tolist())))
    else:
        told = ", ".join(_stated(v, e) for v, e in zip(shift, s, strict=True))
        facts.append(("translation", f"{told} mm"))
    facts.append(("sheet", _sheet(solution)))
    if content["covariance"] is not None:
        facts.append(
            ("+-", f"expanded uncertainty, k = 2, of each of these figures{_widened(solution.held_out.widened)}")
        )
    residuals = content["residuals"]
    for name, of in (
        ("camera", "distances of points seen from points predicted"),
        ("projector", "the same in the projector's picture"),
        ("epipolar", "distances of projector points from the lines that their camera points lie on"),
    ):
        facts.append((f"rms {name}", f"{residuals[f'{name}_px']:.4f} px: {of}"))
    facts.append(("outliers", f"{residuals['outliers']} points, in none of these figures"))
    facts.append(
        ("scale", "unverified: no length was stated (--length)")
        if scale == "unverified"
        else ("scale", _scale(solution))
    )
    facts.append(("file", output))
    return facts if drawing is None else [*facts, ("picture", drawing)]


def _unverified(shift: Sequence[float]) -> str:
    """A translation whose scale nobody measured: as many digits as show what it is, and no uncertainty."""
    places = max(0, 2 - math.floor(math.log10(math.hypot(*shift))))
    told = ", ".join(rounded(v, places) for v in shift)
    return f"{told} mm if the target has the size it was stated with: scale unverified, uncertainty unknown"


def _widened(times: float) -> str:
    """Why uncertainties are larger than residuals and the stated length alone make them; nothing where they are not."""
    if times < NOTABLE_WIDENING:
        return ""
    return (
        f"; all are {times:.1f} times what residuals and stated length make of them, that of the scale too: by so much "
        "more the rig moves when views are left out"
    )


def _sheet(solution: Solution) -> str:
    """What was found of the target's sheet, against its nominal size."""
    from scanner.calibration.sheet import is_exact  # noqa: PLC0415
    from scanner.calibration.solve import sigmas  # noqa: PLC0415

    if is_exact(solution.problem.priors):
        return "taken as exact: no stretch and no bend are fitted"
    spreads = sigmas(solution.adjusted)["sheet"]
    x, y, bow, saddle, twist = (_stated(v, e) for v, e in zip(solution.state.sheet, spreads, strict=True))
    unmeasured = "" if solution.problem.length is not None else "; its size is that of prints, not measured"
    return f"scale x {x}, scale y {y} of its nominal size, bow {bow}, saddle {saddle}, twist {twist} mm{unmeasured}"


def _scale(solution: Solution) -> str:
    """The length that was stated, and what it is on the adjusted sheet."""
    from scanner.calibration.sheet import adjusted_length, is_exact  # noqa: PLC0415

    length = solution.problem.length
    found = adjusted_length(solution.problem, solution.state, solution.adjusted.covariance)
    if length is None or found is None:
        return ""
    stated = with_uncertainty(length.mm, 2 * length.sigma_mm)
    if is_exact(solution.problem.priors):
        return f"the target's own, {found[0]:g} mm, taken as exact; stated: {stated} mm (k = 2)"
    return f"rests on {stated} mm (k = 2), adjusted to {_stated(*found)} mm with what prints are off"


def _stated(value: float, sigma: float) -> str:
    """A value with its expanded uncertainty, k = 2, of its 1-sigma; without where that is not known."""
    return rounded(value, 3) if math.isnan(sigma) else with_uncertainty(value, 2 * sigma)


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.4f}" if isinstance(value, float) else str(value)
