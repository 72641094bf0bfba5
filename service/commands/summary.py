"""What a scan or a decode says at its end: points, coverage, time per stage, where the files are."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from scanner.digits import alone
from scanner.stated_length import dominates
from service.terminal import print_error, print_facts, print_json

LEAST_S = 0.1
"""Stages shorter than this are not listed."""

NEGLIGIBLE = 0.001
"""Of the other part: a millionth of the variance"""
LEAST_SATURATED = 0.0005
"""A share that is not printed as 0.0 %"""

_FILES = (
    ("picture", "preview.png"),
    ("error map", "error_map.png"),
    ("cloud", "cloud.ply"),
    ("maps", "scan.npz"),
    ("report", "report.json"),
    ("capture", "capture"),
)


_FOR = {
    "white": "{} white",
    "black": "{} black",
    "sentinel": "{} black and white around them that prove the timing",
    "bars": "{} of bars that prove the order",
}
"""What frames are for that are not the pattern's own, by their role"""


def report_result(folder: Path, seconds: float, stages: Mapping[str, float], *, as_json: bool) -> None:
    """Print the table, or the JSON document, of a scan's folder. stages: seconds by stage, as the user waited."""
    report: dict[str, Any] = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    if as_json:
        files = sorted(str(path) for path in folder.rglob("*") if path.is_file())
        spent = {stage: round(time, 3) for stage, time in stages.items()}
        print_json(
            {"folder": str(folder), "seconds": round(seconds, 3), "stages": spent, "files": files, "report": report}
        )
        return
    facts: list[tuple[str, str]] = [("points", f"{report.get('points', 0):,}"), *_quality(report)]
    facts.append(("time", f"{seconds:.1f} s"))
    facts += [(f"  {stage}", f"{time:.1f} s") for stage, time in stages.items() if time >= LEAST_S]
    facts += [(name, str(folder / file)) for name, file in _FILES if (folder / file).exists()]
    print_facts("scan", facts)
    for warning in report.get("warnings") or ():
        print_error(warning, label="warning")
    if (hint := dominates((report.get("uncertainty") or {}).get("stated_length"))) is not None:
        print_error(hint, label="note")


def _quality(report: Mapping[str, Any]) -> list[tuple[str, str]]:
    facts = _frames(report.get("capture") or {})
    facts += _coverage(report)
    exposure = (report.get("capture") or {}).get("exposure") or {}
    if (used := exposure.get("used_us")) is not None:
        facts.append(("exposure", f"{used / 1000:.3f} ms{', chosen by test shots' * (exposure.get('mode') == 'auto')}"))
    spread = report.get("depth_mm") or {}
    if (near := spread.get("p1")) is not None and (far := spread.get("p99")) is not None:
        facts.append(("depth", f"{near:.1f} .. {far:.1f} mm (1st to 99th percentile)"))
    if (stated := _uncertainty(report.get("uncertainty") or {}, _few(report.get("coverage") or {}))) is not None:
        facts.append(stated)
    facts += _blind(report)
    if removed := {name: count for name, count in (report.get("removed") or {}).items() if count}:
        facts.append(("filtered", ", ".join(f"{count:,} {name}" for name, count in removed.items())))
    truth = report.get("truth") or {}
    inside = truth.get("inside") or {}
    error = inside.get("depth_mm") or {}
    if (rms := error.get("rms")) is not None and (p99 := error.get("p99")) is not None:
        away = f" ({truth['inside_px']} px and more from edges)" if "inside_px" in truth else ""
        facts.append(("depth error", f"{rms:.3f} mm rms, {p99:.3f} mm in 99 of 100 points{away}"))
        facts += _everywhere(truth)
    if (wrong := inside.get("wrong")) is not None:
        everywhere = (truth.get("lit") or {}).get("wrong")
        more = f"; {everywhere:,} with those at edges" if everywhere not in (None, wrong) else ""
        facts.append(("wrong", f"{wrong:,} points off by half a fringe or stripe, or by 20 mm{more}"))
    return facts


def _blind(report: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Faults of order that would not have shown; of a single frame, which has no order, none."""
    frames = sum(((report.get("capture") or {}).get("shows") or {}).values())
    found = report.get("cannot_reveal") or ()
    return [("cannot reveal", "; ".join(found))] if found and frames > 1 else []


def _everywhere(truth: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The depth error of all points that are lit, with those at edges, where few that are wrong make most of it."""
    lit: Mapping[str, Any] = truth.get("lit") or {}
    error = lit.get("depth_mm") or {}
    if (rms := error.get("rms")) is None or (p99 := error.get("p99")) is None:
        return []
    wrong = f", {lit['wrong_share']:.2%} of them wrong" if "wrong_share" in lit else ""
    unlit = f"; not the {count:,} that the truth has no light for" if (count := truth.get("unlit_points")) else ""
    return [("", f"{rms:.3f} mm rms, {p99:.3f} mm in 99 of 100 points (all that is lit, edges too{wrong}{unlit})")]


def _coverage(report: Mapping[str, Any]) -> list[tuple[str, str]]:
    """How much has a value, of what; how much is too dark, or too bright. Of all that is lit where truth tells it."""
    coverage = report.get("coverage") or {}
    if (shown := coverage.get("lit")) is None:
        return []
    kept = coverage.get("points_of_lit") if report.get("depth_mm") or report.get("removed") else None
    points = f", {kept:.1%} keep a point" if kept is not None and round(kept, 3) != round(shown, 3) else ""
    of_shown = ("coverage", f"{shown:.1%} of the pixels in which the pattern shows{points}")
    truth = (report.get("truth") or {}).get("lit") or {}
    if "too_dark_share" in truth:
        whole = (
            f"{truth['coverage']:.1%} of all that the projector lights (truth); {truth['too_dark_share']:.1%} of it is "
            f"too dark to show the pattern, {truth['undecided_share']:.1%} undecided"
        )
        return [("coverage", whole), ("", of_shown[1]), *_saturated(coverage)]
    if not (dark := coverage.get("too_dark")):
        return [of_shown, *_saturated(coverage)]
    words = f"{dark:.1%} of the image shows no pattern: shadow, a surface that is too dark, or none"
    return [of_shown, ("too dark", words), *_saturated(coverage)]


def _saturated(coverage: Mapping[str, Any]) -> list[tuple[str, str]]:
    """What has no value because the camera's range ended below it; nothing where that rounds to none."""
    if (bright := coverage.get("saturated_of_lit", 0.0)) < LEAST_SATURATED:
        return []
    return [("saturated", f"{bright:.1%} of the pixels in which the pattern shows: too bright to have a value")]


def _frames(capture: Mapping[str, Any]) -> list[tuple[str, str]]:
    """How many frames, and what those are for that the pattern itself does not account for."""
    shows: Mapping[str, int] = capture.get("shows") or {}
    others = [words.format(shows[role]) for role, words in _FOR.items() if shows.get(role)]
    again = f"; {len(capture['retaken'])} taken again" if capture.get("retaken") else ""
    if not others:
        return []
    repeated = f", {capture['repeat']} times" if capture.get("repeat", 1) > 1 else ""
    missing = f"; {len(capture['missing'])} missing" if capture.get("missing") else ""
    fringes = shows.get("fringe", 0)
    return [("frames", f"{fringes} of the pattern, {', '.join(others)}{repeated}{again}{missing}")]


def _few(coverage: Mapping[str, Any]) -> str:
    """What share of the lit pixels the points are, where it is less than half of them: a figure is of these alone."""
    kept = coverage.get("points_of_lit")
    return (
        "" if kept is None or kept >= 0.5 else f" that there are, {kept:.1%} of the pixels in which the pattern shows"
    )


def _uncertainty(budget: Mapping[str, Any], few: str) -> tuple[str, str] | None:
    """One line of the budget: what a point's depth is good to, and what is not in that."""
    if not budget or budget.get("within_mm") is None:
        return None
    names = budget.get("unknown") or ()
    unknown = ", ".join(names)
    at = f"at {budget['depth_mm']:.0f} mm"
    within, random = alone(budget["within_mm"]), alone(2 * budget["random_mm"])
    if "method" in names:  # what is known is the least of it: no figure of the whole
        text = (
            f"at least +-{within} mm {at}, of 95 in 100 points{few}; +-{random} mm is the random part alone (k = 2, "
            "the median point); the method's own error is not known and larger: see docs/explanation/uncertainty.md"
        )
    else:
        text = f"+-{within} mm holds 95 in 100 points{few}, {at}: quote this figure; {_of_median(budget)}"
    return "uncertainty", f"{text}{f'; unknown, and not in it: {unknown}' if unknown else ''}"


def _of_median(budget: Mapping[str, Any]) -> str:
    """The median point's figure and its parts, whose squares add up to its square, all with the same k.

    A kind of which nothing is known has no part, not one of 0, and neither has one that changes no digit.
    """
    k = budget["coverage_factor"]
    each = {kind: k * budget[f"{kind}_mm"] for kind in ("random", "systematic")}
    parts = {kind: part for kind, part in each.items() if part > NEGLIGIBLE * max(each.values())}
    words = [f"+-{alone(part)} mm {kind}" for kind, part in parts.items()]
    words += [f"mostly {dominant['name']}"] if (dominant := budget.get("dominant")) else []
    return (
        f"a point of median uncertainty has +-{alone(math.hypot(*parts.values()))} mm (k = {k:.3g}): {', '.join(words)}"
    )
