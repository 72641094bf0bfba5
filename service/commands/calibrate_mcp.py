"""`fringed calibrate mcp`: MCP's stripes against PMP's rows on one flat board, with a verdict."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from scanner.digits import with_uncertainty
from service.commands.calibrate_solve import Replace
from service.commands.options import AsJson, output_path, require_free
from service.terminal import print_error, print_facts, print_json

if TYPE_CHECKING:
    from scanner.calibration.mcp_phase import McpPhase
    from scanner.geometry import Calibration
    from scanner.patterns import McpPattern, ProjectorSize

_PHASES = ("pmp", "gray+pmp")
"""Methods whose rows are phases at every pixel: finer than what they are to check."""
_ORDER = "the first folder is that of a PMP scan, the second that of an MCP scan: fringed scan --method pmp, then mcp"


def mcp(
    pmp: Annotated[Path, typer.Argument(metavar="PMP-SCAN", help="A PMP scan of a matt white flat board.")],
    single: Annotated[Path, typer.Argument(metavar="MCP-SCAN", help="An MCP scan of it, nothing moved between.")],
    calibration: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Calibration file to which the fit is to be added.")
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="FILE", parser=output_path, help="With --calibration: the new file."),
    ] = None,
    force: Replace = False,
    as_json: AsJson = False,
) -> int:
    """Check MCP's stripes against PMP's rows on one flat board: the code-to-phase fit of the dissertation.

    The decoder knows the pattern, so the fit is a check: its line must be the ideal one. Scans of two scenes are
    refused.

    \b
    Examples:
      fringed scan --rig simulated:casey2011/board -o scans/board-pmp
      fringed scan --rig simulated:casey2011/board --method mcp -o scans/board-mcp
      fringed calibrate mcp scans/board-pmp scans/board-mcp
      fringed calibrate mcp board-pmp/ board-mcp/ --calibration rig.json -o rig-mcp.json
    """
    if (calibration is None) != (output is None):
        raise typer.BadParameter("--calibration FILE and -o FILE belong together")
    require_free(output, force=force)
    from scanner.calibration.calibration_file import as_text  # noqa: PLC0415
    from scanner.calibration.mcp_phase import mcp_phase  # noqa: PLC0415
    from scanner.calibration_id import content_id  # noqa: PLC0415
    from scanner.geometry import load_calibration  # noqa: PLC0415
    from scanner.storage import replace_file, try_file  # noqa: PLC0415

    if output is not None:
        try_file(output)
    rows, peaks, pattern, size = _both(pmp, single)
    axis, pitch = pattern.axis, pattern.pitch_px(size)
    fit = mcp_phase(rows, peaks, pitch, pattern.stripe_count, axis=axis)
    written = None if fit.good is False else output
    if calibration is not None:
        known = load_calibration(calibration)
        _require_rig(known, calibration, rows.shape, size)
        content = {**known.as_dict(), "mcp_phase": fit.member}
        content["id"] = content_id(content)
        if written is not None:
            replace_file(written, as_text(content).encode())
    ideal = {"slope": pitch, "intercept": pitch / 2 - 0.5}
    if as_json:
        verdict = {"good": fit.good, "open_questions": fit.open_questions, "axis": axis, "coverage_factor": 2.0}
        print_json({**vars(fit), "ideal": ideal, "file": written and str(written), **verdict})
    else:
        facts = _facts(fit, pitch, "row" if axis == "y" else "column")
        print_facts("code to phase", facts if written is None else [*facts, ("file", written)])
    for words, hint in _troubles(fit, "rows" if axis == "y" else "columns"):
        print_error(words, hint, label="warning")
    if written is None and output is not None:
        print_error(f"{output} is not written: the fit is not good")
        return 1
    return 0


def _require_rig(known: Calibration, path: Path, picture: tuple[int, ...], projector: ProjectorSize) -> None:
    """Raise CalibrationError where a calibration is of another rig than the scans."""
    from scanner.errors import CalibrationError  # noqa: PLC0415

    there = (*known.camera.size, *known.projector.size)
    here = (picture[1], picture[0], projector.width, projector.height)
    if there != here:
        words = ["camera {} x {}, projector {} x {}".format(*sizes) for sizes in (there, here)]
        raise CalibrationError(f"{path} is another rig's: {words[0]}, and the scans have {words[1]}")


def _facts(fit: McpPhase, pitch: float, line: str) -> list[tuple[str, Any]]:
    from scanner.calibration.mcp_phase import NOTABLE_OUTLIERS, NOTABLE_PX  # noqa: PLC0415

    shown = {name: with_uncertainty(getattr(fit, name), unsure) for name, unsure in fit.expanded.items()}
    verdict = {True: "good", False: "not good", None: f"not sure: {_open(fit)}"}[fit.good]
    allowed = f"at most {NOTABLE_PX:g} {line}s of deviation and of scatter, {NOTABLE_OUTLIERS:.0%} outliers are allowed"
    return [
        ("verdict", f"{verdict} ({allowed})"),
        ("line", f"{line} = ({shown['slope']}) x stripe + ({shown['intercept']})"),
        ("ideal", f"{line} = {pitch:.5f} x stripe + {pitch / 2 - 0.5:.4f}"),
        (
            "deviation",
            f"{shown['deviation_px']} {line}s from the ideal line, at the stripe, of those seen, where it is largest: "
            "to quote",
        ),
        ("scatter", f"{shown['rms_px']} {line}s rms of the peaks about the line: how far a single peak goes astray"),
        ("peaks", f"{fit.peaks:,} on {fit.stripes} of {fit.stripe_count} stripes, {_range(fit)}; {_outliers(fit)}"),
        ("+-", "expanded uncertainty, k = 2, by how much the stripes differ"),
    ]


def _range(fit: McpPhase) -> str:
    return f"from {fit.stripe_range[0]} to {fit.stripe_range[1]}"


def _open(fit: McpPhase) -> str:
    """What a verdict that is neither waits for."""
    what = {
        "deviation_px": f"the stripes seen, {_range(fit)}, do not tell the line at the others, which may be off by "
        + ("any amount" if fit.farthest_px is None else f"{fit.farthest_px:.2g}")
        + ": let the board fill the field",
        "rms_px": "the scatter is within what is allowed, but with its uncertainty it may not be",
    }
    return "; ".join(what[name] for name in fit.open_questions)


def _outliers(fit: McpPhase) -> str:
    wrong = f", {fit.wrong_codes:,} of them with a wrong code" if fit.wrong_codes else ""
    return f"{fit.outliers:,} outliers left out ({fit.outlying:.1%}{wrong})"


def _troubles(fit: McpPhase, lines: str) -> list[tuple[str, str]]:
    """What makes the verdict other than good: words, and what to do."""
    from scanner.calibration.mcp_phase import NOTABLE_OUTLIERS, NOTABLE_PX  # noqa: PLC0415

    found = []
    if fit.deviation_px > NOTABLE_PX:
        found.append(
            (
                f"stripes and PMP {lines} differ by up to {fit.deviation_px:.2f} {lines}",
                "correct the projector's gamma, focus it, and see that nothing moved between the scans",
            )
        )
    if fit.rms_px > NOTABLE_PX:
        found.append(
            (
                f"peaks scatter by {fit.rms_px:.2f} {lines} about the line, {NOTABLE_PX:g} are allowed",
                "take a plain board, without print or gloss, and see that nothing moved between the scans",
            )
        )
    if fit.outlying > NOTABLE_OUTLIERS:
        found.append(
            (
                f"{fit.outlying:.0%} of the peaks are off the line and were left out, {NOTABLE_OUTLIERS:.0%} are "
                "allowed: print, steps in depth, or something that one of the scans has and the other has not",
                "scan a matt white flat board that fills the field, by both methods, and move nothing between",
            )
        )
    return found


def _both(pmp: Path, single: Path) -> tuple[Any, Any, McpPattern, ProjectorSize]:
    """PMP's map along MCP's axis, MCP's peaks, its pattern, and the projector's size."""
    from scanner.capture import Capture  # noqa: PLC0415
    from scanner.errors import DecodeError  # noqa: PLC0415
    from scanner.patterns import McpPattern  # noqa: PLC0415
    from scanner.scan import load_scan  # noqa: PLC0415

    dense, stripes = load_scan(pmp), load_scan(single)
    if stripes.peaks is None:
        raise DecodeError(f"{single} is no MCP scan", hint=_ORDER)
    decoder = dense.report.get("decoder")
    if not isinstance(decoder, Mapping) or decoder.get("method") not in _PHASES:
        raise DecodeError(f"{pmp} is no PMP scan", hint=_ORDER)
    if not (single / "capture").is_dir():
        raise DecodeError(
            f"{single} has no capture, which says what was projected",
            hint="give the folder that fringed scan wrote; one that was decoded again is without",
        )
    sequence = Capture.open(single / "capture").header.sequence
    if not isinstance(sequence.pattern, McpPattern):
        raise DecodeError(f"{single} is no MCP scan", hint=_ORDER)
    axis = sequence.pattern.axis
    rows = dense.rows if axis == "y" else dense.columns
    if rows is None:
        raise DecodeError(
            f"{pmp} was not projected along axis {axis}, as {single} was", hint=f"fringed scan --axis {axis}"
        )
    if rows.shape != stripes.shape:
        raise DecodeError(f"{pmp} and {single} have pictures of different sizes")
    return rows, stripes.peaks, sequence.pattern, sequence.projector
