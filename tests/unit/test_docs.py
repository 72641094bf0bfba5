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


@pytest.mark.parametrize(
    "page",
    ["README.md", "docs/tutorials/first-scan.md", "docs/how-to/calibrate-a-rig.md", "docs/how-to/decode-a-capture.md"],
)
def test_what_a_first_reader_types_writes_where_git_ignores_it(page: str) -> None:
    written = re.findall(r"^ +fringed .* -o (\S+)", (ROOT / page).read_text(), flags=re.MULTILINE)
    ignored = (ROOT / ".gitignore").read_text().splitlines()
    assert len(written) > 1
    assert {f"/{path.partition('/')[0]}/" for path in written} <= set(ignored)
    assert {"scan-*/", "calibration-*/", "/preview.png"} <= set(ignored), "where commands write without -o"


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


def printed_commands() -> Iterator[tuple[str, str, bool]]:
    """(page, line, whole) of each `fringed ...`: named in backticks, or on a line of its own to be typed as it is."""
    for page in [*PAGES, *(ROOT / "changelog.d").glob("*.md")]:
        for line in page.read_text().splitlines():
            found = [(words, False) for words in re.findall(r"`(fringed [^`]+)`", line)]
            typed = re.findall(r"^ {4,}(?:sudo )?(fringed .*?)(?: {3,}.*| +#.*| &| \| .*)?$", line)
            found += [(words, "[OPTIONS]" not in words) for words in typed]
            yield from ((page.name, words, whole) for words, whole in found if "COMMAND" not in words)


def refusal(root: Any, line: str, *, whole: bool) -> str | None:
    """Why the program would not take a line: unknown commands and options, values out of bounds, what is lacking."""
    command, names = root, ["fringed"]
    words = [{"METHOD": "pmp"}.get(word, word) for word in shlex.split(line)[1:]]
    while words and hasattr(command, "commands") and words[0] in command.commands:
        names.append(words.pop(0))
        command = command.commands[names[-1]]
    words = [word for word in words if word not in ("--debug", "[OPTIONS]")]
    if {"--help", "--version", "--install-completion"} & set(words):
        return None
    if hasattr(command, "commands"):
        return None if not words else "no such command"
    try:
        command.make_context(" ".join(names), words)
    except typer.BadParameter.__mro__[1] as error:  # usage errors
        unsaid = type(error).__name__ in ("MissingParameter", "BadOptionUsage")
        return None if unsaid and not whole else error.format_message()
    return None


def test_every_command_that_is_printed_is_one_that_the_program_takes() -> None:
    root: Any = typer.main.get_command(app)
    printed = list(printed_commands())
    wrong = {f"{page}: {line}": said for page, line, whole in printed if (said := refusal(root, line, whole=whole))}
    assert wrong == {}
    assert len(printed) > 200
    assert sum(whole for *_, whole in printed) > 80


@pytest.mark.parametrize(
    "line",
    [
        "fringed scna",
        "fringed calibrate slove",
        "fringed scan --rigg simulated",
        "fringed scan --method laser",
        "fringed scan --repeat none",
        "fringed scan --repeat 0",
        "fringed decode",
        "fringed doctor --rig rig.toml",
        "fringed status now",
    ],
)
def test_a_line_that_the_program_does_not_take_is_found(line: str) -> None:
    assert refusal(typer.main.get_command(app), line, whole=True) is not None
