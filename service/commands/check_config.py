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
    """Check a rig file: keys, values, drivers, calibration. Opens no device.

    \b
    Examples:
      fringed check-config docs/examples/rig.toml
      fringed check-config simulated:quick/board --json
    """
    from service.config import check_rig, is_simulated, load_rig  # noqa: PLC0415

    rig, problems = (load_rig(file), []) if is_simulated(file) else check_rig(Path(file))
    lines = [str(problem) for problem in problems]
    odd: list[str] = []
    if rig is not None:
        found, odd = _calibration_problems(rig, file)
        lines += found
    if as_json:
        print_json(
            {
                "ok": not lines,
                "problems": [asdict(problem) for problem in problems] or lines,
                "warnings": odd,
                "rig": None if rig is None else rig.model_dump(mode="json"),
            }
        )
    for line in lines:
        print_error(line)
    for line in odd:
        print_error(line, label="warning")
    if lines or rig is None:
        return 1
    if not as_json:
        print_facts(f"{file}: OK", _meaning(rig))
    return 0


def _calibration_problems(rig: RigConfig, file: str) -> tuple[list[str], list[str]]:
    """What is wrong with the rig's calibration, and what is odd about it."""
    if rig.rig.calibration is None:
        return [], []
    from scanner.errors import CalibrationError  # noqa: PLC0415
    from scanner.geometry import load_calibration  # noqa: PLC0415

    where = f"{file}: rig.calibration"
    try:
        calibration = load_calibration(rig.rig.calibration)
    except CalibrationError as error:
        return [f"{where}: {error}" + (f" ({error.hint})" if error.hint else "")], []
    return [], [f"{where}: {said}" for said in calibration.warnings]


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
        ("latency, settle", "measured" if known else "as the device declares; without either nothing is proved"),
        ("endpoint", daemon.endpoint),
        ("spool", daemon.spool or "in the daemon's state folder"),
        ("captures leave", ", ".join(ends)),
        ("workers", daemon.workers or "none here: only those of other hosts"),
    ]
