"""`fringed doctor`: what keeps this machine, or this rig, from scanning, and the command that mends it."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict
from typing import Annotated

import typer

from service.commands.options import AsJson
from service.terminal import print_json, print_table, progress_lines


def doctor(
    rig: Annotated[
        str | None, typer.Argument(metavar="[RIG]", help="A rig file, or simulated[:SCENE]: its devices are measured.")
    ] = None,
    as_json: AsJson = False,
) -> int:
    """Look for what keeps this machine from scanning; with a rig, open its devices and measure.

    For each thing that is wrong the line that mends it is printed. Exit status 1 if anything is.

    \b
    Examples:
      fringed doctor
      fringed doctor simulated:quick/board
      fringed doctor bench.toml --json
    """
    from scanner.clock import MonotonicClock  # noqa: PLC0415
    from service.commands.daemon import state_folder  # noqa: PLC0415
    from service.config import load_rig  # noqa: PLC0415
    from service.doctor import Level, Machine, examine  # noqa: PLC0415
    from service.doctor_rig import examine_rig  # noqa: PLC0415

    config = None if rig is None else load_rig(rig)
    with progress_lines() as progress:
        progress.stage("looking at the machine")
        findings = list(examine(Machine(), state_folder()))
        if config is not None:
            own = list(examine_rig(config, MonotonicClock(), progress.stage))
            # What the camera's driver says of its own buffers goes before the general line.
            known = {finding.subject for finding in own}
            general = [f for f in findings if f.subject != "receive buffers" or "receive buffer" not in known]
            findings = [*general, *own]
    counts = Counter(finding.level for finding in findings)
    if as_json:
        print_json({"ok": not counts[Level.BAD], "findings": [asdict(finding) for finding in findings]})
        return 1 if counts[Level.BAD] else 0
    print_table("findings", ("", "subject", "finding"), ((f.level, f.subject, f.says) for f in findings))
    for finding in findings:
        if finding.mend:
            print(
                f"\n{finding.subject}: {finding.says}\n" + "\n".join(f"    {line}" for line in finding.mend.split("\n"))
            )
    bad, notes = counts[Level.BAD], counts[Level.NOTE]
    print(f"\n{bad} to mend, {notes} to know" if bad or notes else "\nnothing to mend")
    return 1 if bad else 0
