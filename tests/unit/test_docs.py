"""The documentation: generated pages are current, links lead somewhere, commands exist, decisions have four parts."""

import importlib.util
import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import typer

from service.program import app

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = sorted([*DOCS.rglob("*.md"), ROOT / "README.md"])
LINK = re.compile(r"\]\((?!https?://|#)([^)#\s]+)(#[^)]*)?\)")


@pytest.fixture
def generate() -> ModuleType:
    spec = importlib.util.spec_from_file_location("generate", DOCS / "generate.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_generated_pages_are_current(generate: ModuleType) -> None:
    for path, text in generate.pages().items():
        assert path.read_text() == text, f"{path.name} is not current: run `make docs`"


def test_every_command_explains_its_options_and_has_an_example() -> None:
    def leaves(group: Any, before: str) -> Iterator[tuple[str, Any]]:
        for name, command in group.commands.items():
            words = f"{before} {name}"
            yield from leaves(command, words) if hasattr(command, "commands") else ((words, command),)

    every = dict(leaves(typer.main.get_command(app), "fringed"))
    assert len(every) > 20
    for words, command in every.items():
        examples = command.help.partition("Examples:")[2]
        assert re.search(rf"^ +{words}\b", examples, flags=re.MULTILINE), words
        assert [option.name for option in command.params if not option.help] == [], words


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path) -> None:
    lost = [link for link, _ in LINK.findall(page.read_text()) if not (page.parent / link).exists()]
    assert lost == []


def test_every_page_can_be_reached_from_the_index() -> None:
    reached, waiting = set(), [DOCS / "index.md"]
    while waiting:
        page = waiting.pop()
        if page in reached or page.suffix != ".md":
            continue
        reached.add(page)
        waiting += [(page.parent / link).resolve() for link, _ in LINK.findall(page.read_text())]
    assert {page for page in PAGES if page.is_relative_to(DOCS)} <= reached


@pytest.mark.parametrize("page", ["README.md", "docs/tutorials/first-scan.md"])
def test_what_a_first_reader_types_writes_where_git_ignores_it(page: str) -> None:
    written = re.findall(r"^ +fringed .* -o (\S+)", (ROOT / page).read_text(), flags=re.MULTILINE)
    ignored = (ROOT / ".gitignore").read_text().splitlines()
    assert len(written) > 1
    assert {f"/{path.partition('/')[0]}/" for path in written} <= set(ignored)
    assert {"/scan-*/", "/calibration-*/", "/preview.png"} <= set(ignored), "where commands write without -o"


def test_every_decision_has_its_four_parts() -> None:
    records = sorted((DOCS / "decisions").glob("0*.md"))
    assert [int(record.name[:4]) for record in records] == list(range(1, len(records) + 1))
    for record in records:
        headings = re.findall(r"^## (.*)$", record.read_text(), flags=re.MULTILINE)
        assert headings == ["Status", "Context", "Decision", "Consequences"], record.name


def test_the_picture_in_the_readme_is_small() -> None:
    assert (DOCS / "images" / "scan.png").stat().st_size < 400_000


def test_anchors_lead_somewhere() -> None:
    for page in PAGES:
        for link, anchor in re.findall(r"\]\((?!https?://)([^)#\s]*)#([^)]+)\)", page.read_text()):
            target = (page.parent / link).resolve() if link else page
            headings = re.findall(r"^#+ (.*)$", target.read_text(), flags=re.MULTILINE)
            names = {re.sub(r"[^\w -]", "", heading).strip().lower().replace(" ", "-") for heading in headings}
            assert anchor in names, f"{page.name}: {link}#{anchor}"


def printed_commands() -> Iterator[tuple[str, str]]:
    """(page, line) of each `fringed ...` that a reader may type: in backticks, or a line of its own."""
    for page in [*PAGES, *(ROOT / "changelog.d").glob("*.md")]:
        for line in page.read_text().splitlines():
            found = re.findall(r"`(fringed [^`]+)`", line)
            found += re.findall(r"^ {4,}(?:sudo )?(fringed .*?)(?: {3,}.*| +#.*)?$", line)
            yield from ((page.name, words) for words in found if "COMMAND" not in words)


def test_every_command_that_is_printed_exists_with_its_options() -> None:
    wrong, checked = [], 0
    for page, line in printed_commands():
        command: Any = typer.main.get_command(app)
        words = shlex.split(line)[1:]
        while words and hasattr(command, "commands") and words[0] in command.commands:
            command = command.commands[words.pop(0)]
        known = {name for option in command.params for name in (*option.opts, *option.secondary_opts)}
        options = {word for word in words if re.match(r"--?[a-z]", word)} - {
            "--help",
            "--debug",
            "--install-completion",
        }
        if options - known or (hasattr(command, "commands") and words and not words[0].startswith("-")):
            wrong.append(f"{page}: {line}")
        checked += 1
    assert wrong == []
    assert checked > 100
