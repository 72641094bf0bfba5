"""Options that several commands share: the pattern to project, and which points a cloud keeps.

They end as plain data, in the words of formats.md; numbers out of bounds and contradictions are wrong usage.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from scanner.errors import ConfigError


def output_path(text: str) -> Path:
    """A place to write to. Nothing at all is a shell's empty variable, and not the working directory."""
    if not text:
        raise typer.BadParameter("-o: expected a path, got nothing")
    return Path(text)


OutputFolder = Annotated[
    Path | None,
    typer.Option("-o", "--output", metavar="DIR", parser=output_path, help="Folder to write to; refused unless empty."),
]
Force = Annotated[bool, typer.Option("--force", help="Write into a folder that is not empty.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON document on standard output, and nothing else.")]
Connect = Annotated[
    str | None,
    typer.Option(
        "--connect", metavar="ENDPOINT", help="Endpoint of a running daemon, as ipc:///run/fringed/control.ipc."
    ),
]

Exposure = Annotated[
    str | None,
    typer.Option(
        metavar="auto|US",
        help="Exposure: microseconds, or auto (test shots first). Default: the rig file's, else auto.",
    ),
]
DecoderName = Annotated[
    str,
    typer.Option(metavar="NAME", help="Decoder, by name: default, or casey2011 (mcp as published, a yardstick)."),
]


class Method(StrEnum):
    """Methods that can be projected."""

    PMP = "pmp"
    MCP = "mcp"
    GRAY = "gray"
    CP = "cp"
    GRAY_PMP = "gray+pmp"


# --- patterns -----------------------------------------------------------------------------------------------------

DEFAULT_FREQUENCIES = 3
"""Number of frequencies that PMP projects where none are given"""

Frequencies = Annotated[
    str | None,
    typer.Option(
        metavar="F,F,...",
        help="PMP: cycles per projector height (width with --axis x). Default: 1,8,64; less on small ones.",
    ),
]
Shifts = Annotated[
    str | None,
    typer.Option(
        metavar="N[,N...]",
        help="PMP: images of every frequency, 3 or more, or one number for each. Default: 8 (gray+pmp: 4).",
    ),
]
AxisOption = Annotated[
    str | None,
    typer.Option(metavar="x|y|xy", help="Phase direction: y measures projector rows, x columns. Default: the rig's."),
]
Bits = Annotated[
    int | None,
    typer.Option(
        metavar="N",
        min=1,
        max=16,
        help="MCP: bits of a code word, with --carriers; gray, gray+pmp: bits shown. Default: chosen for the rig.",
    ),
]
Carriers = Annotated[
    str | None,
    typer.Option(
        metavar="F,F,...",
        help="MCP: one carrier a bit, cycles along the stripes; CP: one a shift. Default: chosen for the rig.",
    ),
]
Profile = Annotated[
    str | None, typer.Option(metavar="triangle|cosine", help="MCP: shape of a stripe. Default: triangle.")
]
Levels = Annotated[
    str | None,
    typer.Option(metavar="equal|composite", help="MCP: stripes equally bright, or as published. Default: equal."),
]

White = Annotated[
    bool,
    typer.Option(
        "--white",
        help="MCP: full on and off too, for still, textured scenes: 9 frames with those that prove their order.",
    ),
]


@dataclass(frozen=True)
class PatternOptions:
    """What was said about the pattern on the command line; None = not said, and the daemon's default holds."""

    frequencies: str | None = None
    shifts: str | None = None
    axis: str | None = None
    bits: int | None = None
    carriers: str | None = None
    profile: str | None = None
    levels: str | None = None
    white: bool | None = None

    def members(self, method: Method) -> dict[str, Any]:
        """Members of the pattern's description that were said.

        Raises:
            typer.BadParameter: not of its form, or not of this method.
        """
        allowed = {
            Method.PMP: {"frequencies", "shifts", "axis"},
            Method.MCP: {"axis", "bits", "carriers", "profile", "levels", "white"},
            Method.GRAY: {"axis", "bits"},
            Method.CP: {"axis", "carriers"},
            Method.GRAY_PMP: {"frequencies", "shifts", "axis", "bits"},
        }[method]
        given = {name: value for name, value in vars(self).items() if value is not None}
        for name in given.keys() - allowed:
            raise typer.BadParameter(f"--{name} says nothing to the method {method}")
        members: dict[str, Any] = {
            name: _choice(given[name], name, choices)
            for name, choices in (("profile", ("triangle", "cosine")), ("levels", ("equal", "composite")))
            if name in given
        }
        if "white" in given:
            members["white"] = True
        if "axis" in given:
            members |= _axes(given["axis"], method)
        if "bits" in given:
            members["bits"] = given["bits"]
        for name in ("frequencies", "carriers"):
            if name in given:
                members[name] = numbers(given[name], f"--{name}")
        if "shifts" in given:
            members["shifts"] = _whole_numbers(given["shifts"], "--shifts")
        return _followed(members, method)


def _followed(members: dict[str, Any], method: Method) -> dict[str, Any]:
    """Members that follow from those said: one number of shifts for all, bits and codes from carriers.

    Raises:
        typer.BadParameter: they contradict each other.
    """
    if method == Method.GRAY_PMP and len(members.get("frequencies", [0])) != 1:
        raise typer.BadParameter("--frequencies: gray+pmp takes one, and tells fringes apart by the code")
    if method == Method.GRAY_PMP and len(members.get("shifts", [0])) != 1:
        raise typer.BadParameter("--shifts: gray+pmp takes one number")
    if method == Method.PMP and "shifts" in members:
        count = len(members.get("frequencies", DEFAULT_FREQUENCIES * [0]))
        shifts = members["shifts"]
        if len(shifts) not in (1, count):
            raise typer.BadParameter(f"--shifts: {len(shifts)} numbers for {count} frequencies; give 1 or {count}")
        return {**members, "shifts": shifts * count if len(shifts) == 1 else shifts}
    if method == Method.MCP and ("carriers" in members or "bits" in members):
        bits = members.get("bits", len(members.get("carriers", ())))
        if len(members.get("carriers", ())) != bits:
            raise typer.BadParameter(f"--bits {bits} needs --carriers with {bits} numbers, one a bit")
        return {**members, "bits": bits, "codes": list(range(1 << bits))}
    return members


def _axes(text: str, method: Method) -> dict[str, Any]:
    if method in (Method.MCP, Method.CP):
        return {"axis": _choice(text, "axis", ("x", "y"))}
    _choice(text, "axis", ("x", "y", "xy", "yx"))
    return {"axes": list(text)}


def _choice(text: str, name: str, choices: tuple[str, ...]) -> str:
    if text not in choices:
        raise typer.BadParameter(f"--{name}: expected one of {', '.join(choices)}, got {text!r}")
    return text


def numbers(text: str, name: str) -> list[float]:
    """A list of positive numbers, "1,8,64"; whole ones as integers."""
    try:
        values = [float(word) for word in text.split(",")]
    except ValueError as error:
        raise typer.BadParameter(f"{name}: expected numbers with commas between them, got {text!r}") from error
    if any(not math.isfinite(value) or value <= 0 for value in values):
        raise typer.BadParameter(f"{name}: expected positive numbers, got {text!r}")
    return [int(value) if value == int(value) else value for value in values]


def _whole_numbers(text: str, name: str) -> list[int]:
    values = numbers(text, name)
    if any(not isinstance(value, int) for value in values):
        raise typer.BadParameter(f"{name}: expected whole numbers, got {text!r}")
    return [int(value) for value in values]


# --- filters ------------------------------------------------------------------------------------------------------

Depth = Annotated[
    str | None,
    typer.Option(metavar="NEAR:FAR", help="Keep points this far from the camera, mm, as 400:700; a side may be empty."),
]
Box = Annotated[
    str | None,
    typer.Option(metavar="X0:X1,Y0:Y1,Z0:Z1", help="Keep points in this box, mm, camera frame; sides may be empty."),
]
MinConfidence = Annotated[
    float | None,
    typer.Option(
        metavar="C",
        min=0.0,
        max=1.0,
        help="Keep points of at least this confidence, 0 .. 1 (that it is no wrong fringe or stripe).",
    ),
]
EdgeFilter = Annotated[
    bool,
    typer.Option(
        "--edge-filter/--no-edge-filter", help="Take out points that fly between two surfaces at depth edges."
    ),
]


def filter_members(
    depth: str | None, box: str | None, min_confidence: float | None, *, edge_filter: bool
) -> dict[str, Any]:
    """The filters that were asked for, as members of `FilterSettings`; absent ones keep their defaults.

    Raises:
        typer.BadParameter: not of its form.
    """
    members: dict[str, Any] = {} if edge_filter else {"edges": False}
    if min_confidence is not None:
        members["min_confidence"] = min_confidence
    if depth is None and box is None:
        return members
    from scanner.filter_settings import parse_box, parse_depth  # noqa: PLC0415

    try:
        if depth is not None:
            members["depth"] = list(parse_depth(depth))
        if box is not None:
            members["box"] = list(parse_box(box))
    except ConfigError as error:
        raise typer.BadParameter(str(error) + (f" ({error.hint})" if error.hint else "")) from error
    return members
