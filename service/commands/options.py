"""Options that several commands share: the pattern to project, and which points a cloud keeps.

They end as plain data, in the words of formats.md; numbers out of bounds and contradictions are wrong usage.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from scanner.errors import ConfigError
from service.terminal import print_error


def output_path(text: str) -> Path:
    """A place to write to. Nothing at all is a shell's empty variable, and not the working directory."""
    if not text:
        raise typer.BadParameter("-o: expected a path, got nothing")
    return Path(text)


def require_picture(path: Path) -> None:
    """Raise typer.BadParameter where `--picture` names a kind of file that live pictures are not written as."""
    if path.suffix.lower() not in (".png", ".jpg", ".jpeg"):
        raise typer.BadParameter(f"--picture: expected a png or jpg file, got {str(path)!r}")


def require_free(*files: Path | None, force: bool) -> None:
    """Refuse files to write (None: none) that are folders, or that are there and not to be replaced.

    Raises:
        typer.BadParameter: with what would help.
    """
    for file in files:
        if file is not None and file.is_dir():
            raise typer.BadParameter(f"-o: {file} is a folder, a file is to be written: give another name")
        if file is not None and file.exists() and not force:
            raise typer.BadParameter(f"-o: {file} exists; --force replaces it")


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
Codes = Annotated[
    str | None,
    typer.Option(
        metavar="N,N,...",
        help="MCP: code word of each modulated stripe, 0 .. 2^bits - 1 once each. Default: neighbours differ in two "
        "bits or more (4 bits); 0,1,2,... (others).",
    ),
]
First = Annotated[
    str | None,
    typer.Option(metavar="modulated|unmodulated", help="MCP: kind of the first stripe. Default: modulated."),
]
Unmodulated = Annotated[
    float | None,
    typer.Option(
        metavar="L",
        help="MCP with --levels composite: light of unmodulated stripes, above 0 and at most 1. Default: 1.",
    ),
]
Code = Annotated[
    str | None, typer.Option(metavar="gray|binary", help="gray, gray+pmp: how positions are coded. Default: gray.")
]
Inverse = Annotated[
    bool | None,
    typer.Option(
        "--inverse/--no-inverse",
        help="gray, gray+pmp: after each code image its inverse, or not. Default: with them (gray+pmp: without).",
    ),
]
White = Annotated[
    bool,
    typer.Option(
        "--white",
        help="MCP: full on and off too, for still, textured scenes; a scan then has 9 frames, some to prove the order.",
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
    codes: str | None = None
    first: str | None = None
    unmodulated: float | None = None
    code: str | None = None
    inverse: bool | None = None

    def members(self, method: Method) -> dict[str, Any]:
        """Members of the pattern's description that were said. What follows from them unasked is told, as a note.

        Raises:
            typer.BadParameter: not of its form, or not of this method.
        """
        given = {name: value for name, value in vars(self).items() if value is not None}
        for name in given.keys() - _OF_METHOD[method]:
            option = "inverse/--no-inverse" if name == "inverse" else name
            raise typer.BadParameter(f"--{option} says nothing to the method {method}")
        members: dict[str, Any] = {
            name: given[name] for name in ("bits", "inverse", "unmodulated", "white") if name in given
        }
        members |= {name: _choice(given[name], name, choices) for name, choices in _CHOICES.items() if name in given}
        if "axis" in given:
            members |= _axes(given["axis"], method)
        for name in ("frequencies", "carriers"):
            if name in given:
                members[name] = numbers(given[name], f"--{name}")
        for name, least in (("shifts", 1), ("codes", 0)):
            if name in given:
                members[name] = _whole_numbers(given[name], f"--{name}", least)
        return _followed(members, method)


_OF_METHOD: Mapping[Method, frozenset[str]] = {
    Method.PMP: frozenset({"frequencies", "shifts", "axis"}),
    Method.MCP: frozenset(
        {"axis", "bits", "carriers", "profile", "levels", "white", "codes", "first", "unmodulated"},
    ),
    Method.GRAY: frozenset({"axis", "bits", "code", "inverse"}),
    Method.CP: frozenset({"axis", "carriers"}),
    Method.GRAY_PMP: frozenset({"frequencies", "shifts", "axis", "bits", "code", "inverse"}),
}
_CHOICES: Mapping[str, tuple[str, ...]] = {
    "profile": ("triangle", "cosine"),
    "levels": ("equal", "composite"),
    "first": ("modulated", "unmodulated"),
    "code": ("gray", "binary"),
}


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
    return _followed_mcp(members) if method == Method.MCP else members


def _followed_mcp(members: dict[str, Any]) -> dict[str, Any]:
    light = members.get("unmodulated")
    if light is not None and members.get("levels") != "composite":
        raise typer.BadParameter("--unmodulated says nothing to stripes that are equally bright: --levels composite")
    if light is not None and not 0 < light <= 1:
        raise typer.BadParameter(f"--unmodulated: expected a number above 0 and at most 1, got {light:g}")
    if "carriers" not in members and "bits" not in members:
        return members
    bits = members.get("bits", len(members.get("carriers", ())))
    if len(members.get("carriers", ())) != bits:
        raise typer.BadParameter(f"--bits {bits} needs --carriers with {bits} numbers, one a bit")
    if not 2 <= bits <= 6:
        raise typer.BadParameter(f"--carriers: MCP takes 2 to 6, got {bits}")
    return {**members, "bits": bits, "codes": _codes(members, bits)}


def _codes(members: Mapping[str, Any], bits: int) -> list[int]:
    """The code words said, else the default order of that many bits, told where it is the natural one."""
    from scanner.patterns.mcp_choice import codes_of  # noqa: PLC0415  (array libraries)

    default = list(codes_of(bits))
    said = members.get("codes")
    if said is None:
        if default == sorted(default):
            print_error(f"code words of {bits} bits stand in natural order, 0,1,2,...", "--codes", label="note")
        return default
    if sorted(said) != sorted(default):
        raise typer.BadParameter(f"--codes: {bits} carriers have the words 0 .. {len(default) - 1}, each once")
    return list(said)


def _axes(text: str, method: Method) -> dict[str, Any]:
    if method in (Method.MCP, Method.CP):
        return {"axis": _choice(text, "axis", ("x", "y"))}
    _choice(text, "axis", ("x", "y", "xy", "yx"))
    return {"axes": list(text)}


def _choice(text: str, name: str, choices: tuple[str, ...]) -> str:
    if text not in choices:
        raise typer.BadParameter(f"--{name}: expected one of {', '.join(choices)}, got {text!r}")
    return text


MOST_PERIODS = 65_535
"""No projector has more pixels along an axis (rig-file.md)"""


def numbers(text: str, name: str) -> list[float]:
    """A list of positive numbers, "1,8,64"; whole ones as integers."""
    try:
        values = [float(word) for word in text.split(",")]
    except ValueError as error:
        raise typer.BadParameter(f"{name}: expected numbers with commas between them, got {text!r}") from error
    if any(not 0 < value <= MOST_PERIODS for value in values):  # nor NaN
        raise typer.BadParameter(f"{name}: expected positive numbers up to {MOST_PERIODS}, got {text!r:.80}")
    return [int(value) if value == int(value) else value for value in values]


def _whole_numbers(text: str, name: str, least: int) -> list[int]:
    words = [word.strip() for word in text.split(",")]
    # Sixteen digits: no count of anything here has more, and int() of a million of them takes a while.
    if any(not (word.isascii() and word.isdecimal() and len(word) <= 16 and int(word) >= least) for word in words):
        raise typer.BadParameter(f"{name}: expected whole numbers from {least}, as 4,4,8, got {text!r:.80}")
    return [int(word) for word in words]


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
