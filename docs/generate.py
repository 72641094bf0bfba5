"""Writes what is made from the program itself: the command line, the rig file, the trigger board's timing diagrams.

`make docs` runs it; a test fails while a page differs from what it would write.
"""

from __future__ import annotations

import ast
import dataclasses
import inspect
import json
import sys
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any, cast

import typer

from drivers.simulated.faults import FOREVER
from drivers.simulated.options import option_kinds
from service.config import RigConfig
from service.program import app

HERE = Path(__file__).parent
GOLDEN = HERE.parent / "tests" / "golden" / "trigger"
DIAGRAMS = ("<!-- diagrams: begin -->\n", "<!-- diagrams: end -->")
OPTIONS = ("<!-- options: begin -->\n", "<!-- options: end -->")
COLUMNS = 96

CLI_HEAD = """# Command line

Made from the program by `make docs`; `fringed COMMAND --help` says the same.

Exit status: 0 done; 1 the work failed, with message and hint on standard error; 2 wrong usage; 130 interrupted.
With `--json` standard output holds one JSON document and nothing else (on failure `{"error": {...}}`);
progress goes to standard error. `--debug`, anywhere in the line, shows the traceback of an unexpected error, which is
otherwise written to a file. `fringed --install-completion` sets up completion in your shell.
"""

RIG_HEAD = """# Rig file

Made from the program by `make docs`. One TOML file describes a rig, for `--rig`, `fringed daemon` and
`fringed check-config`. Only `camera.driver` and `projector.driver` are required. Unknown keys are errors. Paths are
relative to the rig file. [An example with every key](../examples/rig.toml).
"""


def main() -> int:
    """Write all pages."""
    for path, text in pages().items():
        path.write_text(text, encoding="utf-8")
    return 0


def pages() -> dict[Path, str]:
    """Generated pages by path."""
    return {
        HERE / "reference" / "cli.md": CLI_HEAD + "".join(_commands()),
        HERE / "reference" / "rig-file.md": RIG_HEAD + "".join(_tables(RigConfig, ())),
        HERE / "reference" / "simulated-rigs.md": _with_options(HERE / "reference" / "simulated-rigs.md"),
        HERE / "reference" / "trigger-protocol.md": _with_diagrams(HERE / "reference" / "trigger-protocol.md"),
    }


def _with_options(page: Path) -> str:
    """The page with the tables of what may stand behind a simulated rig's question mark between its marks."""
    before, rest = page.read_text(encoding="utf-8").split(OPTIONS[0])
    after = rest.partition(OPTIONS[1])[2]
    tables = (f"\n### {title}\n\n{_fields(kinds)}" for title, kinds in option_kinds().items())
    return before + OPTIONS[0] + "".join(tables) + OPTIONS[1] + after


def _fields(kinds: tuple[type[Any], ...]) -> str:
    rows = [
        f"| `{f.name}` | {_words(kind, f.name)} | {_range(f)} |\n" for kind in kinds for f in dataclasses.fields(kind)
    ]
    return "| Option | | Default; allowed |\n|---|---|---|\n" + "".join(rows)


def _words(kind: type[Any], name: str) -> str:
    """The string that stands below a field in its class."""
    body = cast("ast.ClassDef", ast.parse(inspect.getsource(kind)).body[0]).body
    for field, said in pairwise(body):
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name) and field.target.id == name:
            if isinstance(said, ast.Expr) and isinstance(said.value, ast.Constant):
                return " ".join(str(said.value.value).split()).replace("|", r"\|")
            break
    raise ValueError(f"{kind.__name__}.{name} has no words")


def _range(field: Any) -> str:
    """Default and limits, as they are written in a device string."""
    default, limits = field.default, field.metadata
    shown = "none" if default in (None, "", ()) else _written(default)
    if "choices" in limits:
        return f"`{shown}`; " + ", ".join(f"`{choice}`" for choice in limits["choices"])
    if isinstance(default, bool):
        return f"`{shown}`; `true`, `false`"
    if isinstance(default, tuple):
        return f"{shown}; numbers, `3,7`"
    if "high" in limits:
        return f"{shown}; {_written(limits['low'])} to {_written(limits['high'])}"
    return f"{shown}; {_written(limits['low'])} or more" if "low" in limits else shown


def _written(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return "always" if value == FOREVER else f"{value:.10g}" if isinstance(value, int | float) else str(value)


def _with_diagrams(page: Path) -> str:
    """The page with the golden timing files drawn between its marks."""
    before, rest = page.read_text(encoding="utf-8").split(DIAGRAMS[0])
    after = rest.partition(DIAGRAMS[1])[2]
    drawn = [_diagram(json.loads(path.read_text(encoding="utf-8"))) for path in sorted(GOLDEN.glob("*.json"))]
    return before + DIAGRAMS[0] + "".join(drawn) + DIAGRAMS[1] + after


def _diagram(golden: dict[str, Any]) -> str:
    """One golden timing file: what is sent, and every line with edges over time."""
    edges: dict[str, list[tuple[float, int]]] = {}
    for step in golden["do"]:
        if "edge" in step:
            edges.setdefault(step["edge"], []).extend([(step["t"], 1), (step["t"] + 100, 0)])
    times: list[float] = []
    for pin in golden["pins"]:
        times.append(pin["t"] + (times[pin["after"]] if "after" in pin else 0))
        edges.setdefault(pin["pin"], []).append((times[-1], pin["level"]))
    if not edges:
        return ""
    moments = [t for line in edges.values() for t, _ in line]
    margin = (max(moments) - min(moments)) / 24
    first, last = min(moments) - margin, max(moments) + margin
    sent = [f"    {_said(step)}\n" for step in golden["do"] if "edge" not in step]
    names = sorted(edges, key=("VSYNC", "EXT", "CAM1", "CAM2", "SYNC", "LED").index)
    rows = [f"    {name:6}{_trace(edges[name], first, last)}\n" for name in names]
    scale = f"    {'':6}{first / 1e3:.1f} ms".ljust(COLUMNS - 2) + f"{last / 1e3:.1f} ms\n"
    return f"\n### {golden['title']}\n\n{golden['about']}\n\n" + "".join([*sent, "\n", *rows, scale])


def _said(step: dict[str, Any]) -> str:
    if "bytes" in step:
        return f"{step['t'] / 1e3:9.3f} ms  bytes {step['bytes']}"
    return f"{step['t'] / 1e3:9.3f} ms  {step['send']:28} {step['answer']}"


def _trace(edges: list[tuple[float, int]], first: float, last: float) -> str:
    """A level over time, a character a column; what is shorter than one shows as one."""
    drawn, width = "", (last - first) / COLUMNS
    for column in range(COLUMNS):
        begin, end = first + column * width, first + (column + 1) * width
        within = [level for t, level in edges if begin <= t < end]
        before = [level for t, level in edges if t < begin]
        drawn += "▔" if any(within) or (not within and before and before[-1]) else "▁"
    return drawn


def _commands() -> Iterator[str]:
    group: Any = typer.main.get_command(app)
    yield from _commands_of(group, "")


def _commands_of(group: Any, before: str) -> Iterator[str]:
    for name, command in ((before + name, command) for name, command in group.commands.items()):
        if hasattr(command, "commands"):
            yield from _commands_of(command, f"{name} ")
            continue
        text, _, examples = inspect.cleandoc(command.help).partition("\b\nExamples:\n")
        positional = [p for p in command.params if p.param_type_name == "argument"]
        options = [p for p in command.params if p.param_type_name == "option"]
        usage = " ".join(["fringed", name, *(p.metavar or p.name.upper() for p in positional), "[OPTIONS]"])
        yield f"\n## {name}\n\n    {usage}\n\n{_prose(text)}\n\n"
        if rows := [f"| `{p.metavar or p.name.upper()}` | {p.help or ''} |\n" for p in positional]:
            yield "| Argument | |\n|---|---|\n" + "".join(rows) + "\n"
        if rows := [_option(option) for option in options]:
            yield "| Option | | Default |\n|---|---|---|\n" + "".join(rows) + "\n"
        yield "Examples:\n\n" + "".join(f"    {line.strip()}\n" for line in examples.strip().splitlines())


def _prose(text: str) -> str:
    """A command's help; its paragraphs that must keep their lines as code."""
    paragraphs = text.strip().split("\n\n")
    return "\n\n".join(
        "\n".join(f"    {line}" for line in part.splitlines()[1:]) if part.startswith("\b\n") else part
        for part in paragraphs
    )


def _option(option: Any) -> str:
    names = ", ".join(f"`{name}`" for name in (*option.opts, *option.secondary_opts))
    value = "" if option.is_flag else f" `{option.metavar}`"
    default = "required" if option.required else option.default
    shown = "" if default is None or default is False or default == "" else f"{_plain(default)}"
    value = value.replace("|", r"\|")  # a bar ends a table's cell
    return f"| {names}{value} | {option.help or ''} | {shown} |\n"


def _plain(value: Any) -> str:
    return "on" if value is True else str(getattr(value, "value", value))


def _tables(model: Any, path: tuple[str, ...]) -> Iterator[str]:
    plain, tables = [], []
    for name, field in model.model_fields.items():
        inner = [
            c for c in (field.annotation, *getattr(field.annotation, "__args__", ())) if hasattr(c, "model_fields")
        ]
        (tables.append((name, inner[0])) if inner else plain.append((name, field)))
    if path:
        about = inspect.cleandoc(model.__doc__).partition(": ")[2]
        yield f"\n## [{'.'.join(path)}]\n\n{about[:1].upper()}{about[1:]}\n".replace("\n\n\n", "\n")
        yield "\n| Key | Value | Default |\n|---|---|---|\n"
        yield from (f"| `{name}` | {field.description} | {_default(field)} |\n" for name, field in plain)
    for name, inner_model in tables:
        yield from _tables(inner_model, (*path, name))


def _default(field: Any) -> str:
    if field.is_required():
        return "required"
    if in_words := (field.json_schema_extra or {}).get("default in words"):
        return str(in_words)
    if field.default in (None, "", {}):
        return ""
    return f"`{str(field.default).lower() if isinstance(field.default, bool) else field.default}`"


if __name__ == "__main__":
    sys.exit(main())
