"""`fringed calibrate verify`: what a calibrated rig's scans are worth, by features that are known."""

from __future__ import annotations

import math
from collections.abc import Hashable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from service.commands.calibrate_marks import region_given
from service.commands.options import AsJson
from service.commands.verify_words import Error, errors_of, met, show, warnings_in
from service.terminal import print_error, print_json, progress_lines

if TYPE_CHECKING:
    from scanner.calibration.one_scene import Repeat


def verify(
    scans: Annotated[list[Path], typer.Argument(metavar="SCAN...", help="Scans' folders, with points.")],
    flat: Annotated[bool, typer.Option("--flat", help="A flat board: flatness, rms, bow.")] = False,
    sphere: Annotated[
        str | None,
        typer.Option(
            metavar="MM[:SIGMA]",
            help="A sphere of this diameter (not radius), mm, and its 1-sigma: form and size error.",
        ),
    ] = None,
    target: Annotated[
        str | None,
        typer.Option(metavar="TARGET", help="A target, as in solve: the length of its longest row of points."),
    ] = None,
    length: Annotated[
        str | None,
        typer.Option(
            metavar="MM[:SIGMA]",
            help="With --target: that length as measured, mm, and its 1-sigma; else as nominal.",
        ),
    ] = None,
    repeat: Annotated[
        bool, typer.Option("--repeat", help="The scans are of one scene that did not move: repeatability.")
    ] = False,
    marks: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Witness marks (calibrate marks): how far they have moved since."),
    ] = None,
    edge: Annotated[
        str | None,
        typer.Option(
            metavar="X,Y,W,H",
            help="Part of the picture, camera pixels, with one straight edge in depth: 10-90 % width.",
        ),
    ] = None,
    tolerance: Annotated[
        float | None, typer.Option(metavar="MM", min=0, max=1e4, help="Exit status 1 if an error is larger than this.")
    ] = None,
    calibration: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Calibration that made the scans. Default: the one kept with them."),
    ] = None,
    as_json: AsJson = False,
) -> int:
    """Measure known features in scans, in the words of VDI/VDE 2634 part 2. All lengths are mm.

    Figures of a board, a sphere, a length have an expanded uncertainty (+-, k = 2): of the calibration, by its
    covariance, and of the points used; an error's has that of what it is measured against, too, where it is given.
    --repeat's deviation has one from three scans on. Without one: --edge; --marks, which say what is allowed;
    --repeat's drift.

    \b
    Examples:
      fringed scan --rig simulated:casey2011/sphere_board -o scans/ball       something to verify
      fringed calibrate verify scans/ball --sphere 160 --flat --tolerance 1
      fringed calibrate verify board/ --flat --tolerance 0.2
      fringed calibrate verify ball1 ball2 ball3 --sphere 50.012:0.001
      fringed calibrate verify target/ --target charuco:10x7:30 --length 240.05:0.02
      fringed calibrate verify board1 board2 board3 --flat --repeat --json
      fringed calibrate verify block/ --edge 1230,60,60,200
      fringed calibrate verify today/ --marks marks.json
    """
    if length is not None and target is None:
        raise typer.BadParameter(
            "--length is how long a target's longest row was measured to be: give --target, too (a sphere's diameter "
            "is --sphere)"
        )
    known = any(given is not None for given in (sphere, target, marks))
    if not (flat or repeat or known or edge is not None):
        raise typer.BadParameter("nothing to verify: give --flat, --sphere, --target, --edge, --marks or --repeat")
    if tolerance is not None and not (flat or repeat or known):
        raise typer.BadParameter("--tolerance is for errors, and the width of an edge is none")
    part = None if edge is None else region_given(edge, "--edge")
    ball, row = _stated(sphere, "--sphere"), _stated(length, "--length")
    if repeat:
        _refuse_twice(scans)
    with progress_lines() as lines:
        lines.stage("reading scans", len(scans))
        from scanner.calibration.marks import load_marks  # noqa: PLC0415
        from scanner.calibration.one_scene import Repeat  # noqa: PLC0415
        from scanner.calibration.targets import parse_target  # noqa: PLC0415
        from scanner.calibration.verified import Wanted, verified  # noqa: PLC0415
        from scanner.geometry import load_calibration  # noqa: PLC0415
        from scanner.scan import load_scan  # noqa: PLC0415

        wanted = Wanted(
            flat,
            *ball,
            None if target is None else parse_target(target),
            *row,
            None if marks is None else load_marks(marks),
            part,
        )
        results: list[dict[str, Any]] = []
        repeats: list[Repeat] = []
        for number, folder in enumerate(scans):
            scan = load_scan(folder)
            measured = verified(folder, scan, wanted, calibration)
            budget = scan.report.get("uncertainty") or {}
            results.append({"scan": str(folder), "systematic_mm": budget.get("systematic_mm"), **measured})
            results[-1]["systematic_besides"] = _besides(budget, measured)
            if repeat and scan.xyz is not None:
                repeats.append(Repeat(str(folder), scan.xyz, scan.sigma_z, scan.report))
            lines.advance(number + 1, len(scans))
        document: dict[str, Any] = {"scans": results}
        if repeat:
            document["repeatability"] = _repeatability(repeats)
    for said in () if calibration is None else load_calibration(calibration).warnings:
        print_error(said, label="warning")
    worst = max(errors_of(document), key=lambda error: error.mm, default=None)
    document["largest_error_mm"] = None if worst is None else worst.mm
    document["largest_error_of"] = None if worst is None else worst.of
    if as_json:
        print_json(document)
    else:
        show(document, worst)
    for said in warnings_in(document):
        print_error(said, label="warning")
    return 0 if tolerance is None else _judged(errors_of(document), worst, tolerance)


def _stated(text: str | None, option: str) -> tuple[float | None, float]:
    """A length, mm, and its 1-sigma, as given.

    Raises:
        typer.BadParameter: they are none.
    """
    if text is None:
        return None, 0.0
    mm, colon, sigma = text.partition(":")
    try:
        length, unsure = float(mm), float(sigma) if colon else 0.0
    except ValueError as error:
        raise typer.BadParameter(f"{option}: expected MM or MM:SIGMA, got {text!r}") from error
    if not 0.1 <= length <= 1e5:
        raise typer.BadParameter(f"{option}: expected 0.1 .. 100000 mm, got {mm}")
    if not 0 <= unsure < length:
        raise typer.BadParameter(f"{option}: {sigma} mm is no uncertainty (1-sigma) of {length:g} mm")
    return length, unsure


def _judged(errors: list[Error], worst: Error | None, tolerance: float) -> int:
    """The exit status, with words for it. No error at all (marks that are hidden) meets no tolerance."""
    if worst is None or not worst.mm <= tolerance:
        largest = "there is no error to compare" if worst is None else f"the largest error is {worst.words}"
        print_error(f"{largest}; {tolerance:g} mm are allowed")
        return 1
    print_error(met(errors, worst, tolerance), label="note")
    return 0


def _refuse_twice(scans: list[Path]) -> None:
    """A scan that is compared with itself repeats perfectly, and so does a copy of it."""
    from scanner.calibration.copies import again, file_key  # noqa: PLC0415

    if len(scans) < 2:
        raise typer.BadParameter("--repeat compares scans with each other: give two or more, 20 are good")
    seen: dict[Hashable, tuple[Path, str]] = {}
    for folder in scans:
        file = folder / "scan.npz"
        keys: list[Hashable] = [folder.resolve(), *([file_key(file)] if file.is_file() else [])]
        if (how := again(folder, keys, seen)) is not None:
            told = next(seen[key][0] for key in keys if key in seen)
            if _of_other_captures(folder, told):
                how = (
                    f"is the same as {told} in every bit, though captured anew, which only simulated rigs do: their "
                    "noise is of a seed, and another one is asked for in the rig's name, as "
                    "simulated:casey2011/board?seed=2"
                )
            raise typer.BadParameter(f"--repeat: {folder} {how}; it takes scans of their own, one after the other")
        seen.update((key, (folder, str(folder))) for key in keys)


def _of_other_captures(one: Path, other: Path) -> bool:
    """Whether two scans' folders hold captures of their own."""
    from scanner.capture import Capture  # noqa: PLC0415
    from scanner.errors import ScannerError  # noqa: PLC0415

    try:
        first, second = (Capture.open(folder).header for folder in (one, other))
    except ScannerError:
        return False  # no capture to know it by
    return (first.id, first.created) != (second.id, second.created)


def _repeatability(scans: list[Repeat]) -> dict[str, Any]:
    """The document's, its uncertainty where the others have theirs."""
    from scanner.calibration.one_scene import made_otherwise, require_one_scene  # noqa: PLC0415
    from scanner.calibration.verification import plain, repeatability  # noqa: PLC0415

    warnings = made_otherwise(scans) + require_one_scene(scans)
    found = plain(repeatability([one.xyz for one in scans]))
    expanded = found.pop("expanded_mm")
    standard = None if expanded is None else expanded / 2
    return {**found, "uncertainty": {"depth_mm": {"random": standard, "expanded": expanded}}, "warnings": warnings}


def _besides(budget: dict[str, Any], measured: dict[str, Any]) -> dict[str, Any] | None:
    """What is systematic in a scan and in none of its figures' U; None where the scan has no budget.

    Where U contains the calibration, by its covariance, that is what the others leave: it counts once.
    """
    if budget.get("systematic_mm") is None:
        return None
    contained = "coverage_factor" in measured and measured["unknown"] is None
    if not contained or "contributions" not in budget:
        return {"mm": budget["systematic_mm"], "calibration": True, "unknown": list(budget.get("unknown") or ())}
    others = [c for c in budget["contributions"] if c["kind"] == "systematic" and c["name"] != "calibration"]
    known = [c["mm"] for c in others if c["mm"] is not None]
    return {
        "mm": math.hypot(*known),
        "calibration": False,
        "unknown": [c["name"] for c in others if c["mm"] is None],
    }
