"""`fringed patterns`: the images of a method as PNG files, with the description that decoding needs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from service.commands.options import (
    AsJson,
    Force,
    Method,
    PatternOptions,
    output_path,
)
from service.commands.pattern_options import UNSAID, takes_pattern
from service.terminal import print_error, print_facts, print_json, progress_lines

if TYPE_CHECKING:
    from collections.abc import Mapping

    from scanner.patterns import PatternSequence
    from service.rig_patterns import KnownRig

PATTERN_FILE = "pattern.json"
DEFAULT_SIZE = "1152x864"


@takes_pattern
def patterns(
    method: Annotated[Method, typer.Argument(metavar="METHOD", help="pmp, mcp, gray, gray+pmp or cp.")],
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="DIR", parser=output_path, help="Folder to write to.")
    ],
    size: Annotated[
        str | None, typer.Option(metavar="WxH", help="The projector's size, pixels (1152x864 where nothing is said).")
    ] = None,
    rig: Annotated[
        str | None,
        typer.Option("--for", metavar="RIG", help="Choose for this rig (a file, or simulated[:SCENE]), and say why."),
    ] = None,
    pattern: PatternOptions = UNSAID,
    gamma: Annotated[
        float | None,
        typer.Option(
            metavar="G",
            min=0.1,
            max=10.0,
            help="The projector's gamma, undone in the images. Without it: the rig's with --for, else none.",
        ),
    ] = None,
    bracketed: Annotated[
        bool, typer.Option("--bracketed", help="With the sentinels and order bars that a scan projects.")
    ] = False,
    force: Force = False,
    as_json: AsJson = False,
) -> int:
    """Write a method's images as PNG files, and pattern.json.

    For projectors driven by other programs: project the images in the order of pattern.json, capture one frame of
    each, and put the description into a capture.json for `fringed decode`.

    \b
    Examples:
      fringed patterns pmp -o scans/pmp --size 1920x1080 --frequencies 1,8,64 --shifts 8 --axis x
      fringed patterns mcp -o scans/mcp --size 1152x864 --gamma 2.2
      fringed patterns mcp -o scans/mcp-bench --for simulated:bench2026     what a scan of that rig projects
      fringed patterns gray -o scans/gray --bits 10 --no-inverse     with full on and off, which it then needs
    """
    from scanner.errors import ScannerError  # noqa: PLC0415
    from scanner.storage import prepare_output, replace_json  # noqa: PLC0415
    from service.rig_patterns import known_rig  # noqa: PLC0415

    members = pattern.members(method)
    if rig is not None and size is not None:
        raise typer.BadParameter("--size and --for exclude each other: the rig has a size")
    try:
        known = _of_size(size or DEFAULT_SIZE) if rig is None else known_rig(rig)
        sequence = _sequence(method, members, known, gamma, bracketed=bracketed)
        why = {} if rig is None else _reasons(known, method, members, gamma)
        warnings = _warnings(sequence)
    except ScannerError as error:
        raise typer.BadParameter(f"{error}{f' ({error.hint})' if error.hint else ''}") from error
    prepare_output(output, force=force)
    names = [f"{position:03d}.png" for position in range(len(sequence))]
    with progress_lines() as lines:
        lines.stage("writing images", len(names))
        for position, name in enumerate(names):
            _write_png(output / name, sequence.image(position))
            lines.advance(position + 1, len(names), f"{position + 1} of {len(names)}")
        projector = {"width": sequence.projector.width, "height": sequence.projector.height}
        content = {
            "format": "fringed-pattern",
            "version": 1,
            "projector": projector,
            "pattern": sequence.describe(),
            "images": names,
        }
        replace_json(output / PATTERN_FILE, content)
    if as_json:
        print_json({"folder": str(output), **content, "why": why, "warnings": list(warnings)})
    else:
        facts = [("images", len(names)), ("description", output / PATTERN_FILE), *why.items()]
        print_facts("patterns", facts)
    for said in warnings:
        print_error(said, label="warning")
    return 0


def _warnings(sequence: PatternSequence) -> tuple[str, ...]:
    """What the decoder will say of these images whatever they show: steps of frequencies that are too wide."""
    from scanner.decode.unwrapping import plan_ladder  # noqa: PLC0415
    from scanner.patterns import PmpPattern  # noqa: PLC0415

    if not isinstance(sequence.pattern, PmpPattern):
        return ()
    return plan_ladder(sequence.pattern.frequencies, [2 / n for n in sequence.pattern.shifts]).warnings()


def _of_size(text: str) -> KnownRig:
    """A projector of which nothing but its size is known."""
    from scanner.patterns import ProjectorSize  # noqa: PLC0415
    from service.rig_patterns import KnownRig  # noqa: PLC0415

    width, _, height = text.partition("x")
    if not (width.isdecimal() and height.isdecimal() and 2 <= int(width) <= 16_384 and 2 <= int(height) <= 16_384):
        raise typer.BadParameter(f"--size: expected WIDTHxHEIGHT in pixels, 2 .. 16384 each, got {text!r}")
    return KnownRig(ProjectorSize(int(width), int(height)), "y", None, None)


def _sequence(
    method: Method, members: dict[str, Any], known: KnownRig, gamma: float | None, *, bracketed: bool
) -> PatternSequence:
    """The sequence to write: the method's images alone, or with those that a scan puts around them."""
    from scanner.patterns import GrayPattern, PatternSequence  # noqa: PLC0415
    from scanner.patterns.sequence import Precorrection  # noqa: PLC0415
    from service.scan_patterns import pattern_for  # noqa: PLC0415

    pattern = pattern_for(method.value, members, known.axis, known.projector, known.camera_scale)
    precorrection = known.precorrection if gamma is None else Precorrection(gamma=gamma)
    white = members.get("white", False)
    if bracketed:
        return PatternSequence.bracketed(known.projector, pattern, precorrection, white=white)
    pattern.validate(known.projector)
    # A code without inverses is decided by full on and off.
    beside = white or (isinstance(pattern, GrayPattern) and not pattern.inverse)
    full, dark = (0, 1) if beside else (None, None)
    return PatternSequence(known.projector, pattern, full, dark, precorrection=precorrection)


def _reasons(known: KnownRig, method: Method, members: dict[str, Any], gamma: float | None) -> dict[str, str]:
    """Why the rig's patterns are what they are, by what was chosen and not given."""
    from scanner.patterns.mcp_choice import choose_mcp  # noqa: PLC0415

    axis = members.get("axis", known.axis)
    reasons: Mapping[str, str] = {"axis": f"{known.axis}: the projected axis that moves with depth"}
    if method is Method.MCP and known.camera_scale is not None:
        reasons = choose_mcp(known.projector, axis, known.camera_scale).why
    why = {
        key: said for key, said in reasons.items() if key not in members and not (key == "axis" and "axes" in members)
    }
    if gamma is None:
        why["gamma"] = _gamma_words(known)
    return why


def _gamma_words(known: KnownRig) -> str:
    correction = known.precorrection
    if correction is None:
        return "none is undone: the rig's calibration names no response (fringed calibrate response)"
    what = "a table" if correction.gamma is None else f"{correction.gamma:g}"
    return f"{what}, undone in the images: the response in the rig's calibration"


def _write_png(path: Path, image: Any) -> None:
    import cv2  # noqa: PLC0415

    from scanner.errors import StorageError  # noqa: PLC0415
    from scanner.storage import replace_file  # noqa: PLC0415

    whole, encoded = cv2.imencode(".png", image)
    if not whole:
        raise StorageError(f"{path}: the image could not be encoded")
    replace_file(path, encoded.tobytes())
