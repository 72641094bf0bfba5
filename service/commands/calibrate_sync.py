"""`fringed calibrate sync`: how a rig's devices keep time, measured and kept with the rig."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from service.commands.options import AsJson
from service.terminal import print_error, print_facts, print_json, progress_lines

if TYPE_CHECKING:
    from service.sync_measure import Sync


def sync(
    rig: Annotated[str, typer.Argument(metavar="RIG", help="A rig file, or simulated[:SCENE].")],
    write: Annotated[
        bool, typer.Option("--write", help="Put latency and settling into the rig file (a copy is kept beside it).")
    ] = False,
    as_json: AsJson = False,
) -> int:
    """Measure a rig's latency, settling, pulsed greys and flicker, and say what a scan will do with them.

    Lines that begin with "plan" are those of a default PMP scan: its exposure is found by the same test shots.

    The projector shows black, white and greys; let it light something the camera sees. With latency and settling in
    the rig file no scan has to measure them again, and frames can be proved.

    \b
    Examples:
      fringed calibrate sync simulated
      fringed calibrate sync bench.toml --write
    """
    from scanner.clock import MonotonicClock  # noqa: PLC0415
    from scanner.errors import ConfigError  # noqa: PLC0415
    from scanner.storage import try_file  # noqa: PLC0415
    from service.config import is_simulated, load_rig  # noqa: PLC0415
    from service.rig_file_edit import set_values  # noqa: PLC0415
    from service.sync_measure import measure_sync  # noqa: PLC0415

    if write and is_simulated(rig):
        raise ConfigError("the simulated rig has no file to write to", hint="leave --write out")
    config = load_rig(rig)
    if write:
        try_file(Path(rig))
    with progress_lines() as progress:
        found = measure_sync(config, MonotonicClock(), progress.stage)
    if found.is_poor:
        print_error(
            "the latency is known to half a refresh only, or its begin was not caught",
            "measure again while the machine has nothing else to do, with a brighter view",
            label="warning",
        )
    if warning := (found.exposure or {}).get("warning"):
        print_error(warning, label="warning")
    kept = set_values(Path(rig), "projector", found.rig_lines()) if write and not found.is_poor else None
    if as_json:
        print_json({**found.as_dict(), "written": kept is not None})
        return 1 if found.refused else 0
    print_facts("sync", _facts(found))
    if kept is not None:
        print(f"\nwritten to {rig}; what it was before is in {kept}")
    else:
        if write:
            print_error("nothing was written to the rig file", label="warning")
        lines = "\n".join(f"{key} = {value}" for key, value in found.rig_lines().items())
        print(f"\n[projector]\n{lines}")
    if found.refused:
        print_error(found.refused, label="no scan can work")
        return 1
    return 0


def _facts(found: Sync) -> list[tuple[str, Any]]:
    from service.doctor_rig import MOST_PULSING  # noqa: PLC0415

    light, plan = found.light, found.plan
    facts: list[tuple[str, Any]] = [
        ("latency", f"{found.latency.low_ns / 1e6:.2f} .. {found.latency.high_ns / 1e6:.2f} ms from flip to light"),
        ("settling", f"{found.settle.low_ns / 1e6:.2f} .. {found.settle.high_ns / 1e6:.2f} ms more"),
        ("refresh", f"{found.refresh_ns / 1e6:.3f} ms ({1e9 / found.refresh_ns:.2f} Hz)"),
        ("grey", "pulses: expose for whole periods" if light.pulsing > MOST_PULSING else "constant over a refresh"),
        ("flicker", f"{light.flicker:.2%} of white from frame to frame"),
        ("contrast", f"black {light.black:.0f}, white {light.white:.0f} at {light.exposure_ns / 1e6:.2f} ms"),
    ]
    if found.exposure is not None and found.exposure["mode"] == "auto":
        facts.append(("test shots", found.exposure["note"]))
    if plan is not None:
        facts += [(f"plan: {key.removesuffix('_ns')}", why) for key, why in plan["why"].items()]
    return facts
