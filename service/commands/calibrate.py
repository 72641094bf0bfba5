"""`fringed calibrate`: the group of commands around a rig's calibration. Each stands in a file of its own."""

from __future__ import annotations

import typer

from service.commands import (
    calibrate_marks,
    calibrate_mcp,
    calibrate_response,
    calibrate_run,
    calibrate_solve,
    calibrate_sync,
    calibrate_target,
    calibrate_verify,
)

group = typer.Typer(
    help="Calibrate a rig: print a target, be guided through its poses, solve from captures, check the result.",
    rich_markup_mode=None,
    no_args_is_help=True,
)
group.command("run")(calibrate_run.run)
group.command("solve")(calibrate_solve.solve)
group.command("target")(calibrate_target.target)
group.command("verify")(calibrate_verify.verify)
group.command("marks")(calibrate_marks.marks)
group.command("mcp")(calibrate_mcp.mcp)
group.command("sync")(calibrate_sync.sync)
group.command("response")(calibrate_response.response)
