"""`fringed calibrate response`: how far a projector's light is from what was meant, told by a PMP capture itself."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from service.commands.options import AsJson
from service.terminal import print_facts, print_json, progress_lines


def response(
    capture: Annotated[Path, typer.Argument(metavar="CAPTURE", help="A PMP capture folder, or its JSON file.")],
    as_json: AsJson = False,
) -> int:
    """Find the projector's response (gamma) and the ripple it leaves.

    Any PMP capture with two frequencies or four shifts will do; a plain, bright surface is best. What is found is
    applied at projection: as precorrection of the patterns.

    \b
    Examples:
      fringed calibrate response scan/capture
      fringed calibrate response scan/capture --json
    """
    with progress_lines() as lines:
        lines.stage("opening the capture")
        from scanner.calibration.response import response_of_frames  # noqa: PLC0415  (array libraries and kernels)
        from scanner.capture import Capture  # noqa: PLC0415
        from scanner.errors import DecodeError  # noqa: PLC0415

        opened = Capture.open(capture)
        sequence = opened.header.sequence
        if missing := [position for position in range(len(sequence)) if position not in opened.records]:
            raise DecodeError(
                f"frames {', '.join(map(str, missing))} are missing: the response is told by all of them",
                hint="capture again",
            )
        lines.stage("fitting the response")
        frames = [opened.frame(position) for position in range(len(sequence))]
        found = response_of_frames(sequence, opened.header.camera, frames)
    if as_json:
        print_json(found.as_dict())
        return 0
    projected = "" if found.gamma is None else f"{found.gamma:.3f}"
    print_facts(
        "response",
        [
            ("exponent", f"{found.exponent:.3f} +- {found.sigma:.3f} left in this capture (1: the light is linear)"),
            ("ripple", f"{found.ripple_px:.3f} projector px rms in this capture"),
            ("misfit", f"{found.misfit_before:.2%} of the fringes, {found.misfit_after:.2%} with this exponent"),
            ("gamma to undo", projected or "the table used, followed by light ^ (1 / exponent)"),
            ("where", 'calibration file: "response": {"projector": {"gamma": ...}}; what was undone already is in it'),
        ],
    )
    return 0
