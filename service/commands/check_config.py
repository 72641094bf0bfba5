"""`fringed check-config`: what a rig file means, or everything that is wrong with it."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from service.commands.options import AsJson
from service.terminal import print_error, print_facts, print_json

if TYPE_CHECKING:
    from service.config import RigConfig


def check_config(
    file: Annotated[str, typer.Argument(metavar="FILE", help="A rig file (TOML), or simulated[:SCENE].")],
    as_json: AsJson = False,
) -> int:
    """Check a rig file: keys, values, drivers and their options, scenes, modes, calibration. Opens no device.

    All problems are named at once, but those of keys that are missing, or on a line that is no TOML: they are named
    once the syntax is right. What only a device can say, fringed doctor FILE finds.

    \b
    Examples:
      fringed check-config docs/examples/rig.toml
      fringed check-config simulated:quick/board --json
    """
    from service.config import is_simulated  # noqa: PLC0415
    from service.rig_check import examine, examine_simulated  # noqa: PLC0415

    found = examine_simulated(file) if is_simulated(file) else examine(Path(file))
    rig = found.rig
    if as_json:
        print_json(
            {
                "ok": rig is not None,
                "problems": [asdict(problem) for problem in found.problems],
                "warnings": found.warnings,
                "rig": None if rig is None else rig.model_dump(mode="json"),
            }
        )
    for problem in found.problems:
        print_error(str(problem))
    for line in found.warnings:
        print_error(line, label="warning")
    if rig is None:
        return 1
    if not as_json:
        print_facts(f"{file}: OK", _meaning(rig))
    return 0


def _meaning(rig: RigConfig) -> list[tuple[str, Any]]:
    """The rig in words, defaults included."""
    settings, projector, daemon = rig.camera.settings, rig.projector, rig.daemon
    exposure = settings.exposure_us
    ends = [f"after {daemon.retention.max_age_days:g} days"] if daemon.retention.max_age_days else []
    ends += [f"beyond {daemon.spool_limit_gb:g} GB"] if daemon.spool_limit_gb else []
    ends += [f"when less than {daemon.retention.min_free_gb:g} GB are free"]
    known = projector.latency_us is not None and projector.settle_us is not None
    return [
        ("rig", rig.rig.name),
        ("calibration", rig.rig.calibration or "none: rows, but no points (unless the devices know their own)"),
        ("phase axis", rig.rig.phase_axis or "chosen by the calibration"),
        ("camera", f"{rig.camera.driver} {rig.camera.device}".strip()),
        ("exposure", f"{exposure:g} us" if isinstance(exposure, float | int) else "auto: test shots before each scan"),
        ("triggered by", rig.trigger.driver if rig.trigger else settings.trigger_mode or "the planner's choice"),
        ("projector", f"{projector.driver} {projector.device} {projector.mode or ''}".strip()),
        (
            "latency, settle",
            "as the file says" if known else "as the driver declares, or measured before the first scan",
        ),
        ("endpoint", daemon.endpoint),
        ("spool", daemon.spool or "in the daemon's state folder"),
        ("captures leave", ", ".join(ends)),
        ("workers", daemon.workers or "none here: only those of other hosts"),
    ]
