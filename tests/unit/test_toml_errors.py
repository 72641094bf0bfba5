"""Errors of syntax in rig files: the place, the line with a caret, and what was probably meant; all in one look."""

import tomllib
from pathlib import Path

import pytest

from service.config import read_rig
from service.toml_errors import syntax_problems


@pytest.mark.parametrize(
    ("text", "place", "likely"),
    [
        ("driver = simulated", (1, 10), 'text stands in straight quotes: "simulated"'),
        ("driver = simulated # which", (1, 10), '"simulated"'),
        ("device = /dev/video0", (1, 10), '"/dev/video0"'),
        ("mode = 1920x1080@60", (1, 12), 'mode = "1920x1080@60"'),
        ("device = “cam”", (1, 10), 'straight quotes: "cam"'),
        ("mirror = True", (1, 10), "written as true"),
        ("mirror = off", (1, 10), "written as false"),
        ("gain_db = None", (1, 11), "leave the line out"),
        ("gain_db =", (1, 10), "the value is missing: gain_db = ..."),
        ("gain_db == 3", (1, 10), "one = is enough"),
        ("gain_db = .5", (1, 11), "a number begins with a digit: 0.5"),
        ("gain_db = 5.", (1, 12), "a number ends with a digit: 5.0"),
        ("gain_db = 007", (1, 12), "no zeros before it: 7"),
        ("gain_db = 1,5", (1, 12), "gain_db = [1,5]; a fraction has a point: 1.5"),
        (
            "exposure_us = 20,000",
            (1, 17),
            "nothing stands between thousands, and a fraction has a point: exposure_us = 20000",
        ),
        ("latency_us = 3000, 5000", (1, 18), "latency_us = [3000, 5000]"),
        ("latency_us = 4 ms", (1, 16), "without its unit, which is in the key's name: latency_us = 4"),
        ("region = (0, 0, 2, 2)", (1, 10), "square brackets"),
        ("region = [0, 0, 2, 2\nx = 1", (1, 21), "closing ] is missing"),
        ("device = [a, b]", (1, 11), '"a"'),
        ('device = "cam', (1, 14), "closing quote is missing"),
        ("device = 'cam\n", (1, 14), "closing quote is missing"),
        ('device = "cam\nx = 1', (1, 14), "closing quote is missing"),
        ('device = "a"b"', (1, 13), "a quote within quotes"),
        ('device = "C:\\dev"', (1, 15), "a backslash is written twice"),
        ("options = { a = 1", (1, 18), "closing } is missing"),
        ("options = { a: 1 }", (1, 14), "no colon"),
        ('driver: "simulated"', (1, 7), "no colon"),
        ("driver simulated", (1, 8), "driver = simulated"),
        ("gain db = 3", (1, 6), "no blanks"),
        ("= 3", (1, 1), "the key is missing"),
        ("// mine", (1, 1), "a comment begins with #"),
        ("gain_db = 3 // mine", (1, 13), "it begins with #"),
        ("gain_db = 3;", (1, 12), "it begins with #"),
        ("ä = 3", (1, 1), "keys have letters"),
        ("[camera", (1, 8), "closing bracket is missing: [camera]"),
        ("camera]", (1, 7), "opening bracket is missing: [camera]"),
        ("[my camera]", (1, 5), "no blanks"),
        ("a = 1\na = 2", (2, 6), "it stands on line 1 already"),
        ("[a]\n[b]\n[a]\n", (3, 3), "it stands on line 1 already"),
    ],
)
def test_what_was_probably_meant(text: str, place: tuple[int, int], likely: str) -> None:
    (found,), _ = syntax_problems(text)
    assert (found.line, found.column) == place
    assert likely in found.likely
    assert found.text == text.split("\n")[found.line - 1]


def test_the_caret_stands_below_the_place() -> None:
    for before in ("", "\t\t", 300 * "x"):
        (found,), _ = syntax_problems(f"{before or 'k'} = nobody")
        shown, caret = found.excerpt.splitlines()
        assert shown[caret.index("^") :].startswith("nobody") or before.startswith("\t")
        assert caret.count("\t") == before.count("\t")
        assert len(shown) < 110


def test_a_key_is_shown_as_it_is_written() -> None:
    for text, said in (
        ("[camera]\n[camera]", "Cannot declare camera twice"),
        ("[a.'b)']\n[a.'b)']", "Cannot declare a.b) twice"),
        ("a = {}\na.b = 1", "Cannot mutate immutable namespace a"),
    ):
        (found,), _ = syntax_problems(text)
        assert found.said == said


def test_signs_that_steer_a_terminal_are_not_shown() -> None:
    (found,), _ = syntax_problems('name = "\x1b[2J"')
    assert "\x1b" not in found.excerpt


def test_all_errors_are_found_and_the_rest_is_read() -> None:
    found, rest = syntax_problems("[camera\r\ndriver = sim\r\ndwell = 0\r\n[projector]\r\nmirror = True\r\n")
    assert [(one.line, one.column) for one in found] == [(1, 8), (2, 10), (5, 10)]
    assert rest is not None
    assert tomllib.loads(rest) == {"camera": {"dwell": 0}, "projector": {}}


def test_what_reaches_over_lines_ends_the_look() -> None:
    for text in ("region = [1,\n[camera]\nx = y", 'name = """a\nx = y', "[a]\n[b]\n[a]\nx = y"):
        found, rest = syntax_problems(text)
        assert len(found) == 1
        assert rest is None


def test_a_file_that_is_no_toml_at_all_is_not_listed_line_by_line() -> None:
    found, rest = syntax_problems(200 * "this is prose\n")
    assert len(found) == 20
    assert rest is None


def test_a_rig_file_names_errors_of_syntax_and_of_content_together(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    path.write_text('[camera]\ndriver = simulated\ngain = 3\n[projector]\ndriver = "nobody"\ndwell = 0\n')
    said = [str(problem) for problem in read_rig(path).problems]
    assert said[0].splitlines() == [
        f"{path}:2:10: TOML: Invalid value",
        "    driver = simulated",
        '             ^ text stands in straight quotes: "simulated"',
    ]
    assert [line.partition(": ")[2].partition(":")[0] for line in said[1:]] == [
        "camera.gain = 3" if "camera.gain = 3" in said[1] else "camera.gain",
        'projector.driver = "nobody"',
        "projector.dwell = 0",
    ]


def test_an_integer_that_python_refuses_to_read_is_an_error_of_its_line(tmp_path: Path) -> None:
    text = f"[camera]\ndwell = {'9' * 5000}\n# {'1' * 5000}\n[x]\ny = {'1_0' * 3000}\n"
    found, rest = syntax_problems(text)
    assert [(one.line, one.column, one.said) for one in found] == [
        (2, 9, "Integer of too many digits"),
        (5, 5, "Integer of too many digits"),
    ]
    assert rest is not None
    assert tomllib.loads(rest) == {"camera": {}, "x": {}}
    for harmless in (f"x = 0.{'1' * 400}", f"x = {'1' * 400}.0", f"x = '{'1' * 5000}'", f"x = 1 # {'1' * 5000}"):
        assert syntax_problems(harmless) == ([], harmless)
    text = f"[camera]\nexposure_us = 0x{'f' * 5000}\n"  # int() reads it, and str() and float() do not
    (tmp_path / "rig.toml").write_text(text)
    assert any("too many digits" in one.expected for one in read_rig(tmp_path / "rig.toml").problems)
