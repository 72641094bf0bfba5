"""`fringed calibrate verify`: what a calibrated rig's scans are worth, by features that are known."""

from __future__ import annotations

import math
from collections.abc import Hashable
from pathlib import Path
from typing import Annotated, Any

import typer

from scanner.digits import alone, rounded, with_uncertainty
from scanner.stated_length import dominates
from service.commands.calibrate_marks import region_given
from service.commands.options import AsJson
from service.terminal import print_error, print_facts, print_json, print_table, progress_lines


def verify(
    scans: Annotated[list[Path], typer.Argument(metavar="SCAN...", help="Scans' folders, with points.")],
    flat: Annotated[bool, typer.Option("--flat", help="A flat board: flatness, rms, bow.")] = False,
    sphere: Annotated[
        float | None,
        typer.Option(
            metavar="MM", min=0.1, max=1e5, help="A sphere of this diameter (not radius), mm: form and size error."
        ),
    ] = None,
    target: Annotated[
        str | None,
        typer.Option(metavar="TARGET", help="A target, as in solve: the length of its longest row of points."),
    ] = None,
    length: Annotated[
        float | None,
        typer.Option(metavar="MM", min=0.1, max=1e5, help="With --target: that length as measured; else as nominal."),
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
        typer.Option(metavar="FILE", help="Calibration that made the scans. Default: the one their captures keep."),
    ] = None,
    as_json: AsJson = False,
) -> int:
    """Measure known features in scans, in the words of VDI/VDE 2634 part 2. All lengths are mm.

    Figures of a board, a sphere, a length have an expanded uncertainty (+-, k = 2): of the calibration, by its
    covariance, and of the points used; --repeat's deviation has one from three scans on. Without one: noise, which is
    an expectation; --edge; --marks, which say what is allowed; --repeat's drift.

    \b
    Examples:
      fringed scan --rig simulated:casey2011/sphere_board -o scans/ball       something to verify
      fringed calibrate verify scans/ball --sphere 160 --flat --tolerance 1
      fringed calibrate verify board/ --flat --tolerance 0.2
      fringed calibrate verify ball1 ball2 ball3 --sphere 50.012
      fringed calibrate verify target/ --target charuco:10x7:30 --length 240.05
      fringed calibrate verify board1 board2 board3 --flat --repeat --json
      fringed calibrate verify block/ --edge 600,300,60,200
      fringed calibrate verify today/ --marks marks.json
    """
    if not (flat or repeat or any(given is not None for given in (sphere, target, marks, edge))):
        raise typer.BadParameter("nothing to verify: give --flat, --sphere, --target, --edge, --marks or --repeat")
    part = None if edge is None else region_given(edge, "--edge")
    if length is not None and target is None:
        raise typer.BadParameter("--length is the length of a target's longest row: give --target too")
    if repeat and len(scans) < 2:
        raise typer.BadParameter("--repeat compares scans with each other: give two or more, 20 are good")
    if repeat:
        _refuse_twice(scans)
    with progress_lines() as lines:
        lines.stage("reading scans", len(scans))
        from scanner.calibration.marks import load_marks  # noqa: PLC0415
        from scanner.calibration.targets import parse_target  # noqa: PLC0415
        from scanner.calibration.verification import plain, repeatability  # noqa: PLC0415
        from scanner.calibration.verified import Wanted, verified  # noqa: PLC0415
        from scanner.geometry import load_calibration  # noqa: PLC0415
        from scanner.scan import load_scan  # noqa: PLC0415

        wanted = Wanted(
            flat,
            sphere,
            None if target is None else parse_target(target),
            length,
            None if marks is None else load_marks(marks),
            part,
        )
        results, clouds = [], []
        for number, folder in enumerate(scans):
            scan = load_scan(folder)
            measured = verified(folder, scan, wanted, calibration)
            budget = scan.report.get("uncertainty") or {}
            results.append({"scan": str(folder), "systematic_mm": budget.get("systematic_mm"), **measured})
            results[-1]["systematic_besides"] = _besides(budget, measured)
            if repeat and scan.xyz is not None:
                clouds.append(scan.xyz)
            lines.advance(number + 1, len(scans))
        document: dict[str, Any] = {"scans": results}
        if repeat:
            document["repeatability"] = _with_spread(plain(repeatability(clouds)))
    for said in () if calibration is None else load_calibration(calibration).warnings:
        print_error(said, label="warning")
    worst = _worst(document)
    document["largest_error_mm"] = worst
    if as_json:
        print_json(document)
    else:
        _show(document)
    if tolerance is not None and not worst <= tolerance:
        print_error(f"the largest error is {worst:.4f} mm, {tolerance:g} mm are allowed")
        return 1
    if tolerance is not None:
        print_error(_met(document, worst, tolerance), label="note")
    return 0


def _refuse_twice(scans: list[Path]) -> None:
    """A scan that is compared with itself repeats perfectly, and so does a copy of it."""
    from scanner.calibration.copies import again, file_key  # noqa: PLC0415

    seen: dict[Hashable, tuple[Path, str]] = {}
    for folder in scans:
        file = folder / "scan.npz"
        keys: list[Hashable] = [folder.resolve(), *([file_key(file)] if file.is_file() else [])]
        if (how := again(folder, keys, seen)) is not None:
            raise typer.BadParameter(f"--repeat: {folder} {how}; it takes scans of their own, one after the other")
        seen.update((key, (folder, str(folder))) for key in keys)


def _errors(document: dict[str, Any]) -> list[tuple[float, float | None]]:
    """All errors that a tolerance is for, mm, with their expanded uncertainty; None: unknown. No width of edges."""
    errors: list[tuple[float, float | None]] = []
    if "repeatability" in document:
        found = document["repeatability"]
        errors.append((found["depth_mm"], found["uncertainty"]["depth_mm"]["expanded"]))
    for one in document["scans"]:
        for kind, names in (("flat", ("flatness_mm",)), ("sphere", ("form_mm", "size_mm")), ("length", ("error_mm",))):
            if kind in one:
                errors += [(abs(one[kind][name]), one[kind]["uncertainty"][name]["expanded"]) for name in names]
        if "marks" in one:
            plate = (one["marks"].get("plate") or {}).get("offset_mm") or 0.0
            errors += [(one["marks"].get("largest_mm", 0.0), None), (abs(plate), None)]
    return errors


def _worst(document: dict[str, Any]) -> float:
    """The largest of all errors, mm."""
    return float(max((error for error, _ in _errors(document)), default=0.0))


def _met(document: dict[str, Any], worst: float, tolerance: float) -> str:
    """What a tolerance that is met does not say: errors are compared as measured (ISO 14253-1 would have U added)."""
    errors = _errors(document)
    said = f"the largest error, {worst:.4f} mm, is within {tolerance:g} mm as measured; "
    if any(expanded is None for _, expanded in errors):
        return said + "whether it is with its uncertainty is not known"
    most = max(error + (expanded or 0.0) for error, expanded in errors)
    return said + f"with its expanded uncertainty (k = 2), {most:.4f} mm, it is {'too' if most <= tolerance else 'not'}"


def _cells_of(kind: str, values: dict[str, Any]) -> dict[str, Any]:
    """What is shown of one feature: marks without what does not apply, and the plate's members beside them."""
    shown = values
    if kind == "marks":
        plate = {f"plate_{name}": value for name, value in (values.get("plate") or {}).items()}
        left_out = () if values["points"] else ("seen",)
        shown = {name: value for name, value in values.items() if name not in left_out} | plate
    spreads = values.get("uncertainty", {})
    return {name: _cell(value, spreads.get(name)) for name, value in shown.items() if isinstance(value, int | float)}


def _with_spread(found: dict[str, Any]) -> dict[str, Any]:
    """A repeatability with its uncertainty where the others have theirs."""
    expanded = found.pop("expanded_mm")
    standard = None if expanded is None else expanded / 2
    return {**found, "uncertainty": {"depth_mm": {"random": standard, "expanded": expanded}}}


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


WIDTHS = (
    ("flat", "flatness_mm", "noise_mm", "flatness F", "VDI/VDE 2634-2, 99.7 % of the points"),
    ("sphere", "form_mm", "noise_mm", "probing form PF", "VDI/VDE 2634-2, 99.7 % of the points"),
    ("sphere", "shell_mm", "shell_noise_mm", "form dispersion", "ISO 10360-13, 95 % of the points"),
)
"""Figures that norms define: kind, name, what noise alone makes of it, in words, and which norm"""


def _of_widths(one: dict[str, Any]) -> list[tuple[str, str]]:
    """Lines of what norms define, in their words, each with what of it is noise."""
    lines = []
    for kind, name, of_noise, called, norm in WIDTHS:
        if kind not in one:
            continue
        width, noise = one[kind][name], one[kind][of_noise]
        shown = with_uncertainty(width, one[kind]["uncertainty"][name]["expanded"])
        by = "what noise makes of it is not known" if noise is None else _beyond(width, noise, kind)
        lines.append((called, f"{shown} mm, {norm}; {by}: {one['scan']}"))
    return lines


def _beyond(width: float, noise: float, kind: str) -> str:
    """What a width has beyond that of noise, in quadrature, as normal deviations add up."""
    feature = "board" if kind == "flat" else "sphere"
    beyond = math.sqrt(max(width**2 - noise**2, 0.0))
    rest = f"beyond it {rounded(beyond)}" if beyond > 0 else "nothing beyond it"
    return f"a perfect {feature} has {rounded(noise)} by the points' noise, {rest}"


def _show(document: dict[str, Any]) -> None:
    for kind in ("flat", "sphere", "length", "edge", "marks"):
        rows = [(one["scan"], _cells_of(kind, one[kind])) for one in document["scans"] if kind in one]
        if not rows:
            continue
        names = list(dict.fromkeys(name for _, values in rows for name in values))
        cells = ([scan, *(values.get(name, "-") for name in names)] for scan, values in rows)
        print_table(kind, ("scan", *(name.replace("_", " ") for name in names)), cells)
    for one in document["scans"]:
        if (said := one.get("marks", {}).get("warning")) is not None:
            print_error(f"{one['scan']}: {said}", label="warning")
    facts = [line for one in document["scans"] for line in _of_widths(one)]
    facts += _of_repeats(document.get("repeatability"))
    facts.append(("largest error", f"{document['largest_error_mm']:.4f} mm, as measured"))
    for one in document["scans"]:
        if "coverage_factor" in one:
            facts.append(("+-", f"{_of_uncertainty(one)}: {one['scan']}"))
        facts.append(("systematic", f"{_of_systematic(one['systematic_besides'])}: {one['scan']}"))
    print_facts("verification", facts)
    for hint in dict.fromkeys(dominates(one.get("stated_length")) for one in document["scans"]):
        if hint is not None:
            print_error(hint, label="note")


def _of_repeats(found: dict[str, Any] | None) -> list[tuple[str, str]]:
    """Lines of a repeatability."""
    if found is None:
        return []
    shown = with_uncertainty(found["depth_mm"], found["uncertainty"]["depth_mm"]["expanded"])
    of = f"standard deviation of {found['scans']} scans (k = 2), rms over {found['points']:,} pixels"
    if found["uncertainty"]["depth_mm"]["expanded"] is None:
        of += "; from three scans on they say whether noise or a change makes it"
    return [("depth mm", f"{shown}: {of}"), ("drift mm", f"{rounded(found['drift_mm'])}, of the farthest scan's mean")]


def _of_systematic(besides: dict[str, Any] | None) -> str:
    """What is in none of a scan's uncertainties, in words."""
    if besides is None:
        return "not told, in none of these figures"
    whole = "" if besides["calibration"] else " besides the calibration"
    unknown = f"; unknown: {', '.join(besides['unknown'])}" if besides["unknown"] else ""
    return f"+-{alone(2 * besides['mm'])} mm of depth (k = 2){whole}, in none of these figures{unknown}"


def _of_uncertainty(one: dict[str, Any]) -> str:
    """What the uncertainties of a scan's figures contain, and why they are unknown where they are."""
    if one["unknown"] is None:
        return "expanded uncertainty, k = 2: the calibration's covariance, and the points"
    parts = [one[kind]["uncertainty"] for kind in ("flat", "sphere", "length") if kind in one]
    largest = max(
        (s["random"] for part in parts for n, s in part.items() if n.endswith("_mm") and s["random"]), default=0
    )
    return f"unknown, {one['unknown']} (the points' own part, k = 2: up to {alone(2 * largest)} mm)"


def _cell(value: float | None, spread: dict[str, float | None] | None = None) -> str:
    if value is None:
        return "-"
    if spread is not None:
        return with_uncertainty(value, spread["expanded"])
    return f"{value:,}" if isinstance(value, int) else rounded(value)
