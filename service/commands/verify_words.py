"""What `fringed calibrate verify` says of its document: tables, lines, warnings, and which error is the largest."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from scanner.digits import UNKNOWN_PLACES, alone, rounded, with_uncertainty
from scanner.stated_length import dominates
from service.terminal import print_error, print_facts, print_table

WORTH_MM = 0.01
"""Uncertainty that a figure has at the least where nothing of it is known: no digit beyond a micrometre is shown"""
LEAST_MM = 0.0001
OF_NOISE = (
    "of normal errors 99.7 % of the points span 5.9 sigmas and 95 % span 3.9, where a scan's own +- is two: of +-0.13 "
    "mm of noise along the normal come a flatness and a PF of 0.39 mm, and a form dispersion of 0.25 mm"
)
"""What connects a width with the uncertainty that a scan states"""
NO_COVARIANCE = (
    "for uncertainties a calibration needs a covariance, which fringed calibrate solve writes into its file: calibrate "
    "(simulated rigs have target poses, simulated:casey2011/charuco_poses?pose=0 to 11), fringed decode CAPTURE "
    "--calibration FILE, and verify that scan"
)
ABSOLUTE = ("distance_mm", "diameter_mm", "size_mm", "measured_mm", "error_mm")
"""Figures that move with all depths; the others compare depths with one another"""


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
        expanded = one[kind]["uncertainty"][name]["expanded"]
        known = _known(one, kind, name)
        shown = with_uncertainty(width, expanded, known)
        by = "what noise makes of it is not known"
        if noise is not None:
            of = one[kind]["uncertainty"][of_noise]["expanded"]
            by = f"a perfect {'board' if kind == 'flat' else kind} has {with_uncertainty(noise, of)} by noise, "
            by += _beyond(one[kind]["beyond"][name], width / max(one[kind]["beyond"][name]["mm"], LEAST_MM) * known)
        lines.append((called, f"{shown} mm, {norm}; {by}: {one['scan']}"))
    return lines


def _of_sizes(one: dict[str, Any]) -> list[tuple[str, str]]:
    """The size of a ball of stated diameter, by its name in the norm."""
    if one.get("sphere", {}).get("size_mm") is None:
        return []
    found = one["sphere"]
    shown = with_uncertainty(
        found["size_mm"], found["uncertainty"]["size_mm"]["expanded"], _known(one, "sphere", "size_mm")
    )
    stated = found["diameter_mm"] - found["size_mm"]
    return [("probing size PS", f"{shown} mm, VDI/VDE 2634-2, measured less the stated {stated:g} mm: {one['scan']}")]


def _of_positions(document: dict[str, Any]) -> list[tuple[str, str]]:
    """That figures which norms define are no test by a norm."""
    if not any(kind in one for one in document["scans"] for kind in ("flat", "sphere")):
        return []
    count = len(document["scans"])
    if document.get("repeatability") is not None:
        scans = f"{count} scans of one scene are one position"
    else:
        scans = "one scan is one position" if count == 1 else f"{count} scans are {count} positions at most"
    return [
        (
            "positions",
            f"{scans}, and no acceptance test: by VDI/VDE 2634-2 that has sphere and board at several, all over the "
            "measuring volume, and distances between spheres besides, and its largest errors count",
        )
    ]


def _beyond(found: dict[str, Any], known: float) -> str:
    """What a width has beyond that of noise: a figure only where its U leaves something of it, else a limit."""
    if found["least_mm"] is None:
        return (
            f"beyond it {with_uncertainty(found['mm'], None, known)}"
            if found["mm"] > 0
            else "nothing beyond it is sure"
        )
    if found["least_mm"] > 0:
        return f"beyond it {with_uncertainty(found['mm'], found['mm'] - found['least_mm'])}"
    return f"beyond it {alone(found['most_mm'])} at most"


def _known(one: dict[str, Any], kind: str, name: str) -> float:
    """Of a figure's unknown U what is known of it, k = 2: the points' part, and, of what moves with all depths, the
    known systematic part of the scan's."""
    random = one[kind]["uncertainty"][name]["random"] or 0.0
    besides = one.get("systematic_besides") or {}
    common = besides.get("mm", 0.0) if name in ABSOLUTE else 0.0
    return max(2 * math.hypot(random, common), WORTH_MM)


@dataclass(frozen=True)
class Error:
    """One that a tolerance is for. mm; expanded: U, None where it is unknown; known: the part of U that is; of: what
    it is an error of."""

    mm: float
    expanded: float | None
    known: float
    of: str

    @property
    def words(self) -> str:
        """With its uncertainty."""
        return f"{with_uncertainty(self.mm, self.expanded, self.known)} mm, {self.of}"


def errors_of(document: dict[str, Any]) -> list[Error]:
    """All errors that a tolerance is for. No width of edges; no mark that is hidden."""
    return [*_of_repeating(document), *(error for one in document["scans"] for error in _of_scan(one))]


def _of_repeating(document: dict[str, Any]) -> Iterator[Error]:
    if "repeatability" in document:
        found = document["repeatability"]
        expanded = found["uncertainty"]["depth_mm"]["expanded"]
        yield Error(found["depth_mm"], expanded, WORTH_MM, "the repeatability")


def _of_scan(one: dict[str, Any]) -> Iterator[Error]:
    for kind, name, of in (
        ("flat", "flatness_mm", "the flatness"),
        ("sphere", "form_mm", "the sphere's form"),
        ("sphere", "size_mm", "the sphere's size"),
        ("length", "error_mm", "the length"),
    ):
        if kind in one:
            expanded = one[kind]["uncertainty"][name]["expanded"]
            yield Error(abs(one[kind][name]), expanded, _known(one, kind, name), f"{of} of {one['scan']}")
    marks = one.get("marks") or {}
    if marks.get("largest_mm") is not None:
        yield Error(marks["largest_mm"], None, WORTH_MM, f"a witness mark in {one['scan']}")
    if (edge := (marks.get("plate") or {}).get("edge_mm")) is not None:
        yield Error(edge, None, WORTH_MM, f"the plate in {one['scan']}")


def met(errors: Sequence[Error], worst: Error, tolerance: float) -> str:
    """What a tolerance that is met does not say: errors are compared as measured (ISO 14253-1 would have U added)."""
    said = f"the largest error, {worst.words}, is within {tolerance:g} mm as measured; "
    if any(error.expanded is None for error in errors):
        return said + "whether it is with its uncertainty is not known"
    most, of = max((error.mm + (error.expanded or 0.0), error.of) for error in errors)
    which = "" if of == worst.of else f" ({of})"
    within = "too" if most <= tolerance else "not"
    return said + f"with its expanded uncertainty (k = 2), {most:.4f} mm{which}, it is {within}"


def warnings_in(document: dict[str, Any]) -> list[str]:
    """Of marks, of figures of a part of a board, and of scans that do not repeat each other."""
    found = [f"--repeat: {said}" for said in (document.get("repeatability") or {}).get("warnings", ())]
    for one in document["scans"]:
        own = [*one.get("warnings", ()), one.get("marks", {}).get("warning")]
        found += [f"{one['scan']}: {said}" for said in own if said is not None]
    return found


def show(document: dict[str, Any], worst: Error | None) -> None:
    """Print it."""
    for kind in ("flat", "sphere", "length", "edge", "marks"):
        rows = [(one["scan"], _cells_of(kind, one)) for one in document["scans"] if kind in one]
        if not rows:
            continue
        names = list(dict.fromkeys(name for _, values in rows for name in values))
        cells = ([scan, *(values.get(name, "-") for name in names)] for scan, values in rows)
        print_table(kind, ("scan", *(name.replace("_", " ") for name in names)), cells)
    facts = [line for one in document["scans"] for line in (*_of_widths(one), *_of_sizes(one))]
    facts += _of_repeats(document.get("repeatability"))
    if worst is not None:
        facts.append(("largest error", f"{worst.words}, as measured"))
    scans, one_scene = document["scans"], document.get("repeatability") is not None
    sure = [(_of_uncertainty(one), _points_part(one), one["scan"]) for one in scans if "coverage_factor" in one]
    besides = [one["systematic_besides"] for one in scans]
    facts += _once("+-", sure, one_scene)
    of = [(_of_systematic(b), b["mm"] if b else 0.0, one["scan"]) for b, one in zip(besides, scans, strict=True)]
    facts += _once("systematic", of, one_scene)
    if any(one.get(kind, {}).get(of_noise) is not None for one in scans for kind, _, of_noise, *_ in WIDTHS):
        facts.append(("noise", OF_NOISE))
    print_facts("verification", [*facts, *_of_positions(document)])
    if any("no covariance" in (one.get("unknown") or "") for one in scans):
        print_error(NO_COVARIANCE, label="note")
    # Of the scan whose figure it dominates most: twenty notes say no more than one.
    stated = [one["stated_length"] for one in document["scans"] if one.get("stated_length") is not None]
    if (hint := dominates(max(stated, key=lambda found: float(found["share"]), default=None))) is not None:
        print_error(hint, label="note")


def _once(label: str, said: list[tuple[str, float, str]], one_scene: bool) -> list[tuple[str, str]]:
    """Lines of what is said of scans: what is said of several alike is one line.

    Args:
        said: words, how much they say, and of which scan. one_scene: words that differ in digits alone are alike, too,
            and those that say most stand for all.
    """
    of: dict[str, list[tuple[float, str, str]]] = {}
    for words, much, scan in said:
        of.setdefault(re.sub(r"\d", "#", words) if one_scene else words, []).append((much, words, scan))
    lines = []
    for alike in of.values():
        which = (
            alike[0][2]
            if len(alike) == 1
            else "all scans"
            if len(alike) == len(said)
            else ", ".join(s for *_, s in alike)
        )
        lines.append((label, f"{max(alike)[1]}: {which}{', at most' if len({w for _, w, _ in alike}) > 1 else ''}"))
    return lines


def _of_repeats(found: dict[str, Any] | None) -> list[tuple[str, str]]:
    """Lines of a repeatability."""
    if found is None:
        return []
    shown = with_uncertainty(found["depth_mm"], found["uncertainty"]["depth_mm"]["expanded"], WORTH_MM)
    of = f"standard deviation of {found['scans']} scans (k = 2), rms over {found['points']:,} pixels"
    if found["uncertainty"]["depth_mm"]["expanded"] is None:
        of += "; from three scans on they say whether noise or a change makes it"
    drift = rounded(found["drift_mm"]) if found["drift_mm"] > LEAST_MM else f"below {LEAST_MM:g}"
    return [("depth mm", f"{shown}: {of}"), ("drift mm", f"{drift}, of the farthest scan's mean")]


def _of_systematic(besides: dict[str, Any] | None) -> str:
    """What is in none of a scan's uncertainties, in words: what is unknown is no zero."""
    if besides is None:
        return "not told, in none of the measured figures"
    whole = "" if besides["calibration"] else " besides the calibration"
    unknown = ", ".join(besides["unknown"])
    if not besides["mm"] > 0:
        said = f"unknown ({unknown})" if unknown else "none is known of"
        return f"{said}{whole}; in none of the measured figures"
    known = f"{alone(2 * besides['mm'])} mm of depth (k = 2){whole}"
    if unknown:
        return f"at least +-{known}, and what is unknown ({unknown}); in none of the measured figures"
    return f"+-{known}, in none of the measured figures"


def _of_uncertainty(one: dict[str, Any]) -> str:
    """What the uncertainties of a scan's figures contain, and why they are unknown where they are."""
    if one["unknown"] is None:
        parts = [one[kind]["uncertainty"] for kind in ("sphere", "length") if kind in one]
        stated = any("reference" in figure for part in parts for figure in part.values())
        besides = "; of an error, what it is measured against" if stated else ""
        return f"expanded uncertainty, k = 2: the calibration's covariance, and the points{besides}"
    return f"unknown, {one['unknown']}; the points' own part, k = 2, is up to {alone(2 * _points_part(one))} mm"


def _points_part(one: dict[str, Any]) -> float:
    """The largest 1-sigma, mm, that points leave of a scan's figures."""
    parts = [one[kind]["uncertainty"] for kind in ("flat", "sphere", "length") if kind in one]
    return max(
        (s["random"] for part in parts for n, s in part.items() if n.endswith("_mm") and s["random"]), default=0.0
    )


def _cells_of(kind: str, one: dict[str, Any]) -> dict[str, Any]:
    """What is shown of one feature: marks without what does not apply, and the plate's members beside them."""
    shown = values = one[kind]
    if kind == "marks":
        plate = {f"plate_{name}": value for name, value in (values.get("plate") or {}).items()}
        left_out = () if values["points"] else ("seen",)
        shown = {name: value for name, value in values.items() if name not in left_out} | plate
    cells = {}
    for name, value in shown.items():
        if name in values.get("uncertainty", {}):
            cells[name] = with_uncertainty(value, values["uncertainty"][name]["expanded"], _known(one, kind, name))
        elif isinstance(value, int | float):
            cells[name] = _cell(value, 3 if name.endswith("_mm") else UNKNOWN_PLACES)
    return cells


def _cell(value: float, places: int) -> str:
    return f"{value:,}" if isinstance(value, int) else rounded(value, places)
