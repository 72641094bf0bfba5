"""The short table at the end of a scan or a decode: points, coverage, time per stage, where the files are."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from service.terminal import print_error, print_facts

SHOWN_MS = 100
"""Stages shorter than this go together under "other"."""


def print_summary(folder: Path, report: Mapping[str, Any], seconds: float) -> None:
    """Print the table, and the report's warnings on standard error."""
    facts: list[tuple[str, str]] = [("points", f"{report.get('points', 0):,}")]
    coverage = report.get("coverage") or {}
    if "lit" in coverage:
        facts.append(("coverage", f"{coverage['lit']:.1%} of lit pixels"))
    if spread := report.get("depth_mm"):
        facts.append(("depth", _spread(spread)))
    removed = {name: count for name, count in (report.get("removed") or {}).items() if count}
    if removed:
        facts.append(("filtered", ", ".join(f"{count:,} {name}" for name, count in removed.items())))
    facts += _truth(report.get("truth") or {})
    facts.append(("time", f"{seconds:.1f} s"))
    facts += [(f"  {stage}", f"{spent:.2f} s") for stage, spent in _stages(report.get("timings") or {})]
    facts += [(name, str(folder / file)) for name, file in _FILES if (folder / file).exists()]
    print_facts("scan", facts)
    for warning in report.get("warnings") or ():
        print_error(warning, label="warning")


_FILES = (
    ("picture", "preview.png"),
    ("error map", "error_map.png"),
    ("cloud", "cloud.ply"),
    ("maps", "scan.npz"),
    ("report", "report.json"),
    ("capture", "capture"),
)


def _spread(spread: Mapping[str, float]) -> str:
    values = list(spread.values())
    return f"{values[0]:.1f} .. {values[-1]:.1f} mm (1st to 99th percentile)"


def _stages(timings: Mapping[str, float]) -> list[tuple[str, float]]:
    shown = [(stage, spent) for stage, spent in timings.items() if spent * 1e3 >= SHOWN_MS]
    rest = sum(timings.values()) - sum(spent for _, spent in shown)
    return [*shown, ("other", rest)] if timings else []


def _truth(truth: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Figures of the comparison with truth that are single numbers."""
    return [(f"truth: {name}", f"{value:.4g}") for name, value in truth.items() if isinstance(value, int | float)]
