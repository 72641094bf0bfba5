"""What a person at a terminal sees of a command: progress and errors on standard error, results on standard output.

`rich` draws; it is imported when something is drawn, so that short commands stay quick. With `--json` standard output
holds one JSON document and nothing else.
"""

from __future__ import annotations

import json
import os
import shutil
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from service.logs import visible

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

    from scanner.errors import ScannerError


class ProgressLines:
    """Stages of a job, one line each; a stage with a known length has a bar. `spent` says how long each took.

    On a terminal lines are drawn in place; elsewhere (a log, a pipe) each stage is one plain line when it ends.
    """

    def __init__(self, progress: Progress | None) -> None:
        self.spent: dict[str, float] = {}
        """seconds by stage, in the order they began; a stage that came again has the sum"""
        self._progress = progress
        self._task: TaskID | None = None
        self._stage = ""
        self._note = ""
        self._began = 0.0

    def stage(self, name: str, total: float | None = None) -> None:
        """Begin a stage; the one before is done. The same name again changes nothing."""
        if name == self._stage:
            return
        self.end()
        self._stage, self._note, self._began = name, "", time.monotonic()
        if self._progress is not None:
            self._task = self._progress.add_task(name, total=total, note="")

    def advance(self, done: float, total: float | None, note: str = "") -> None:
        """Say how far the stage has come."""
        self._note = note
        if self._progress is not None and self._task is not None:
            self._progress.update(self._task, completed=done, total=total, note=note)

    def note(self, text: str) -> None:
        """A line that stays: something a reader will want to know later."""
        text = visible(text)
        if self._progress is not None:
            self._progress.console.print(text, markup=False, highlight=False)
        else:
            print(text, file=sys.stderr, flush=True)

    def end(self) -> None:
        """The last stage is done."""
        if not self._stage:
            return
        self.spent[self._stage] = self.spent.get(self._stage, 0.0) + time.monotonic() - self._began
        if self._progress is not None and self._task is not None:
            task = self._progress.tasks[self._progress.task_ids.index(self._task)]
            total = task.total if task.total is not None else 1
            self._progress.update(self._task, completed=total, total=total)
        else:
            print(f"{self._stage}{f' ({self._note})' if self._note else ''}", file=sys.stderr, flush=True)
        self._stage, self._task = "", None


@contextmanager
def progress_lines() -> Iterator[ProgressLines]:
    """Progress on standard error while the block runs."""
    if not sys.stderr.isatty():
        lines = ProgressLines(None)
        yield lines
        lines.end()
        return
    from rich.console import Console  # noqa: PLC0415  (drawn only here)
    from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn  # noqa: PLC0415

    columns = (
        SpinnerColumn(finished_text="[green]✓"),
        TextColumn("{task.description:<22}"),
        BarColumn(bar_width=32),
        TimeElapsedColumn(),
        TextColumn("{task.fields[note]}"),
    )
    with Progress(*columns, console=Console(stderr=True)) as progress:
        lines = ProgressLines(progress)
        yield lines
        lines.end()


@contextmanager
def status_line() -> Iterator[Callable[[str], None]]:
    """Writes a line that changes: in place on a terminal, one below the other elsewhere. On standard error."""
    terminal = sys.stderr.isatty()

    def write(words: str) -> None:
        if terminal:
            width = shutil.get_terminal_size().columns
            print(f"\r\x1b[K{visible(words)[: width - 1]}", end="", file=sys.stderr, flush=True)
        else:
            print(visible(words), file=sys.stderr, flush=True)

    try:
        yield write
    finally:
        if terminal:
            print(file=sys.stderr)


def print_table(title: str, header: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """A table with a heading on standard output; plain columns where that is no terminal."""
    cells = [[visible(str(cell)) for cell in row] for row in rows]
    if not sys.stdout.isatty():
        widths = [max(map(len, column)) for column in zip(header, *cells, strict=True)]
        for row in (header, *cells):
            print("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())
        return
    from rich.console import Console  # noqa: PLC0415
    from rich.markup import escape  # noqa: PLC0415
    from rich.table import Table  # noqa: PLC0415

    table = Table(title=title, title_justify="left", title_style="bold")
    for name in header:
        table.add_column(name, overflow="fold")
    for row in cells:
        table.add_row(*map(escape, row))
    Console().print(table)


def print_facts(title: str, facts: Sequence[tuple[str, Any]]) -> None:
    """Pairs of name and value, one a line, on standard output."""
    facts = [(name, visible(str(value))) for name, value in facts]
    if not sys.stdout.isatty():
        width = max((len(name) for name, _ in facts), default=0)
        for name, value in facts:
            print(f"{name.ljust(width)}  {value}".rstrip())
        return
    from rich.console import Console  # noqa: PLC0415
    from rich.markup import escape  # noqa: PLC0415
    from rich.table import Table  # noqa: PLC0415

    table = Table(title=title, title_justify="left", title_style="bold", show_header=False)
    table.add_column(style="cyan")
    table.add_column(overflow="fold")
    for name, value in facts:
        table.add_row(escape(name), escape(value))
    Console().print(table)


@dataclass
class _Output:
    """What this program has printed so far."""

    document: bool = False


_output = _Output()


def begin_output() -> None:
    """A command begins: its document is not printed yet."""
    _output.document = False


def print_json(content: Any) -> None:
    """The one JSON document on standard output. Numbers that JSON has no form for (NaN, infinity) become null."""
    _output.document = True
    print(visible(json.dumps(_finite(content), indent=1, ensure_ascii=False, default=str)), flush=True)


def print_error(message: str, hint: str | None = None, *, label: str = "error") -> None:
    """An error (or a warning), and what to do about it, on standard error."""
    colour = sys.stderr.isatty() and "NO_COLOR" not in os.environ
    red, faint, plain = ("\x1b[31m", "\x1b[2m", "\x1b[0m") if colour else ("", "", "")
    print(f"{red}{label}:{plain} {visible(message)}", file=sys.stderr)
    if hint:
        print(f"{faint}hint:{plain} {visible(hint)}", file=sys.stderr, flush=True)


def print_failure(content: Any) -> None:
    """The document of what ended a command, unless its own is out: what serves prints that when it begins."""
    if not _output.document:
        print_json(content)


def error_document(error: ScannerError) -> dict[str, Any]:
    """What `--json` prints of an error."""
    return {"error": {"code": error.code, "message": str(error), **error.data()}}


def _finite(value: Any) -> Any:
    if isinstance(value, float):
        return value if value - value == 0 else None
    if isinstance(value, Mapping):
        return {str(key): _finite(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(inner) for inner in value]
    return value
