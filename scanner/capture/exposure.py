"""What capture.json tells of exposure and timing: what was asked, what was used, and what test shots had to say.

Captures made elsewhere need not tell anything, and what they tell is not trusted to be well formed.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from scanner.capture.header import CaptureHeader

SAME = 0.01
"""Relative difference up to which the exposure used is the one asked: cameras have steps"""


def exposure_report(header: CaptureHeader) -> dict[str, Any] | None:
    """Member `exposure` of the report: `mode` (given, auto), `asked_us` (given) and `used_us`; None if unknown."""
    told, used = _told(header), _microseconds((header.plan or {}).get("exposure_ns"), 1e-3)
    if used is None:
        return None
    return {"mode": told.get("mode"), "asked_us": _microseconds(told.get("asked_us")), "used_us": used}


def exposure_warnings(header: CaptureHeader) -> tuple[str, ...]:
    """What a user should know: test shots too bright or too dim, an exposure that is not the one asked for, and a
    latency in the rig file that was not the projector's before the scan.
    """
    said = (_told(header).get("warning"), _told(header, "timing").get("warning"))
    warnings = [warning for warning in said if isinstance(warning, str)]
    report = exposure_report(header)
    if report is not None and (asked := report["asked_us"]) and abs(report["used_us"] - asked) > SAME * asked:
        why = ((header.plan or {}).get("why") or {}).get("exposure_ns")
        because = f": {why}" if isinstance(why, str) else ""
        warnings.append(f"exposed for {report['used_us']:g} us and not {asked:g} us as asked{because}")
    return tuple(warnings)


def _told(header: CaptureHeader, of: str = "exposure") -> Mapping[str, Any]:
    told = header.extra.get(of)
    return told if isinstance(told, Mapping) else {}


def _microseconds(value: Any, scale: float = 1.0) -> float | None:
    return float(value) * scale if isinstance(value, int | float) and not isinstance(value, bool) else None
