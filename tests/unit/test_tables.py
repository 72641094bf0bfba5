"""The dissertation's tables: their pages are written and listed, and what they are computed by agrees with formulas."""

from __future__ import annotations

import math
import re
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
PAGES = ROOT / "docs" / "reference" / "tables"


@pytest.fixture
def tables(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(ROOT / "bench"))
    import tables.__main__  # noqa: PLC0415  (beside the program, not of it)

    return tables


def test_every_table_has_its_page_and_the_index_lists_it(tables: ModuleType) -> None:
    listed = tables.__main__.TABLES
    assert {path.stem for path in PAGES.glob("*.md")} == {
        "index",
        "held-out",
        *(name for name, _, _ in listed.values()),
    }
    assert (PAGES / "index.md").read_text() == tables.__main__.index_page(), "run `make tables`"
    for argument, (name, title, _) in listed.items():
        text = (PAGES / f"{name}.md").read_text()
        assert text.startswith(f"# {title}\n"), name
        assert f'make tables ARGS="{argument}"' in text
        assert "## Where it differs, and why\n\n" in text
        if name.startswith("table-"):
            assert "| published |" in text or "(published)" in text


def test_the_page_of_held_out_scenes_says_what_its_writer_says(tables: ModuleType) -> None:
    from held_out import figures, page  # noqa: PLC0415  (found where the fixture put the benchmarks' folder)

    text = (PAGES / "held-out.md").read_text()
    assert text.startswith(page.WORDS)
    assert text.endswith(page.page([]).removeprefix(page.WORDS).lstrip())
    for name in {*page.STRIPES.values(), *page.PIXELS.values()}:
        assert f"*{name.removesuffix(' (mm)')}*" in page.WORDS, name
    for method in {line.split(" | ")[2] for line in text.splitlines() if re.match(r"\| di|\| ro", line)}:
        assert f"- *{method}*: " in page.WORDS
    refused = figures.Found(refused="DecodeError: " + 30 * "seventeen ")
    (row,) = (line for line in page.page([("roll", "blob", "mcp", refused)]).splitlines() if line.startswith("| roll"))
    assert row.split(" | ")[3] == " ".join(8 * ["seventeen"] + ["..."])


def test_a_table_that_is_not_there_is_wrong_usage(
    tables: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["tables", "5.9"])
    with pytest.raises(SystemExit, match="2"):
        tables.__main__.main()
    assert "no table 5.9" in capsys.readouterr().err


def test_a_grid_is_a_table_of_markdown(tables: ModuleType) -> None:
    grid = tables.page.Grid(["a", "b"], [["x", 0.12345], [None, math.nan], ["z", 7]], "Said:", places=2)
    assert grid.markdown() == "Said:\n\n| a | b |\n|---|---:|\n| x | 0.12 |\n| - | - |\n| z | 7 |\n"


def test_the_thresholds_worst_case_is_the_published_one(tables: ModuleType) -> None:
    x, high = tables.threshold.solve(8)
    assert x == pytest.approx(0.6776, abs=2e-4)
    assert high == pytest.approx(1.322, abs=5e-4)
    assert high / x == pytest.approx(1.95, abs=5e-3)
    for active in (4, 8, 12):
        x, high = tables.threshold.solve(active)
        # The definition: x = E{B} + 2 sigma of triangles of which half are x high, half 2 - x.
        mean = active / 64
        square = active / 32 * (x**2 + high**2) / 2 / 3
        assert x == pytest.approx(mean + 2 * math.sqrt(square - mean**2))


def test_the_model_of_saturation_is_nothing_below_the_clip_and_the_clipped_series_above(tables: ModuleType) -> None:
    at_90, at_30 = tables.interference._model(1.0)
    assert at_90 == pytest.approx(1)
    assert at_30 == pytest.approx(0, abs=1e-6)
    at_90, at_30 = tables.interference._model(1.5)
    assert 0.7 < at_90 < 0.95
    assert 0.05 < at_30 < 0.3


def test_an_amplitude_is_found_though_the_frequency_is_a_little_off(tables: ModuleType) -> None:
    x = np.arange(1392)
    line = 100 + 40 * np.cos(2 * np.pi * 0.8699 * 1.01 * 90 * x / 1392) + 7 * np.cos(2 * np.pi * 0.8699 * 60 * x / 1392)
    frame = np.repeat(line[None], 700, axis=0)
    assert tables.interference._amplitude(frame, 90) == pytest.approx(40, rel=0.01)
    assert tables.interference._amplitude(frame, 60) == pytest.approx(7, rel=0.02)


def test_runs_are_counted_row_by_row(tables: ModuleType) -> None:
    high = np.array([[1, 1, 0, 1], [0, 0, 0, 0], [1, 1, 1, 1]], bool)
    assert sorted(tables.strips._runs(high).tolist()) == [1, 2, 4]


def test_points_of_the_spheres_middle_alone_are_its_surface(tables: ModuleType) -> None:
    centre = tables.depth.SPHERE_CENTRE_MM
    front, edge, board = centre - np.array([0, 0, 80]), centre + np.array([0, 79.9, -4]), np.array([0.0, 0, 1346])
    assert tables.depth._on_surface(np.array([front, edge, board])).tolist() == [True, False, False]
    figures = tables.depth._figures(
        np.array([[3.0, 0, 4], [math.nan, 0, 0], [3, 0, -4]]), np.array([True, True, False])
    )
    assert figures == [3, 0, 4, 4, 0.5, 2]


def test_the_pictures_of_the_page_on_mcp_are_small() -> None:
    pictures = list((ROOT / "docs" / "images" / "mcp").glob("*.png"))
    page = (ROOT / "docs" / "explanation" / "mcp.md").read_text()
    assert len(pictures) >= 4
    assert all(f"images/mcp/{picture.name}" in page for picture in pictures)
    assert sum(picture.stat().st_size for picture in pictures) < 600_000
