"""Writes the pages of the reference that are made from the program itself: the command line and the rig file.

`make docs` runs it; a test fails while a page differs from what it would write.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import typer

from service.config import RigConfig
from service.program import app

HERE = Path(__file__).parent

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
    }


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
        yield f"\n## {name}\n\n    {usage}\n\n{text.strip()}\n\n"
        if rows := [f"| `{p.metavar or p.name.upper()}` | {p.help or ''} |\n" for p in positional]:
            yield "| Argument | |\n|---|---|\n" + "".join(rows) + "\n"
        if rows := [_option(option) for option in options]:
            yield "| Option | | Default |\n|---|---|---|\n" + "".join(rows) + "\n"
        yield "Examples:\n\n" + "".join(f"    {line.strip()}\n" for line in examples.strip().splitlines())


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
    if field.default in (None, "", {}):
        return ""
    return f"`{str(field.default).lower() if isinstance(field.default, bool) else field.default}`"


if __name__ == "__main__":
    sys.exit(main())
