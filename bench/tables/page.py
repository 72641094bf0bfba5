"""A table as a page of the documentation: heading, rows, and in words what differs from what was published and why."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "reference" / "tables"

Cell = str | float | int | None


@dataclass(frozen=True)
class Grid:
    """One grid of a page. places: digits after the point of floats; a dash stands for None and NaN."""

    head: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    caption: str = ""
    places: int = 4

    def markdown(self) -> str:
        """GitHub's pipe table; the first column left, the others right."""
        lines = [f"| {' | '.join(self.head)} |", "|" + "---|" + "---:|" * (len(self.head) - 1)]
        lines += [f"| {' | '.join(self._cell(cell) for cell in row)} |" for row in self.rows]
        return (f"{self.caption}\n\n" if self.caption else "") + "\n".join(lines) + "\n"

    def _cell(self, cell: Cell) -> str:
        if cell is None or (isinstance(cell, float) and cell != cell):  # noqa: PLR0124  (NaN)
            return "-"
        return f"{cell:.{self.places}f}" if isinstance(cell, float) else str(cell)


@dataclass(frozen=True)
class Page:
    """A page. name: file name without its ending. words: what is needed to read it. differs: where and why it does."""

    name: str
    title: str
    words: str
    grids: Sequence[Grid]
    differs: str
    seeds: int = 3
    argument: str = field(default="")

    def markdown(self) -> str:
        """The whole page."""
        parts = [
            f"# {self.title}\n",
            f'Made by `make tables ARGS="{self.argument or self.name}"`. {_worst(self.seeds)}\n',
            self.words.strip() + "\n",
            *(grid.markdown() for grid in self.grids),
            "## Where it differs, and why\n",
            self.differs.strip() + "\n",
            "[All tables](index.md)\n",
        ]
        return "\n".join(parts)


def _worst(seeds: int) -> str:
    return f"Each figure is the worst of {seeds} seeds." if seeds > 1 else "One seed."


def write(page: Page) -> Path:
    """Write a page into the documentation."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    path = FOLDER / f"{page.name}.md"
    path.write_text(page.markdown(), encoding="utf-8")
    return path


def index(entries: Sequence[tuple[str, str, str]]) -> str:
    """The list of all pages: (argument, file name, title)."""
    lines = [f"- [{title}]({name}.md) (`{argument}`)" for argument, name, title in entries]
    return (
        "# The dissertation's tables, reproduced\n\n"
        "`make tables` measures all of them on the simulated rig of Casey 2011, sec. 5.6 (one to two minutes);\n"
        '`make tables ARGS="5.1 gamma"` some. "Casey 2011" is C. J. Casey, *Enhancements to the Modified Composite\n'
        "Pattern Method of Structured Light 3D Capture*, University of Kentucky 2011. The decoder is the reference\n"
        "decoder, `--decoder casey2011`, unless a page says otherwise. How it works: [Modified\n"
        "Composite Pattern](../../explanation/mcp.md).\n\n" + "\n".join(lines) + "\n"
        "- [Scenes and rigs that nobody tuned for](held-out.md) (`cd bench && python -m held_out`)\n"
    )
