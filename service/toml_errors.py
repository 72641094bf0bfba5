"""What is wrong with a text that is no TOML: where, what stands there, and what was probably meant.

`tomllib` stops at the first error and gives its place in words. Here a broken line is left out and the rest is read
again, so that one look finds them all. What the keys mean is not known here.
"""

from __future__ import annotations

import ast
import re
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass

MOST = 20
"""Errors that are listed: a file with more is probably no TOML at all"""

WIDEST = 96
"""Characters of a line that are shown, around the error"""

_PLACE = re.compile(r" \(at (?:line (\d+), column (\d+)|end of document)\)$")
_KEY = re.compile(r"""(?<= )\(["'].*\)(?= twice$|$)""")
_HUGE = re.compile(r"(?<![\w.])(?:0[xob][\da-fA-F](?:_?[\da-fA-F]){64,}|\d(?:_?\d){300,})(?![\w.])")
_QUOTED = re.compile(r"""\"[^"]*\"|'[^']*'""")
_SPANNING = ("Unclosed array", "Unterminated string", 'Expected "', "Cannot declare")
_HEADER = re.compile(r"\s*\[?\[?\s*([\w-]+(?:\.[\w-]+)*)\s*\]?\]?\s*(?:#.*)?")
_TABLE = re.compile(r"\s*\[\s*[\w-]+(?:\.[\w-]+)*\s*\]\s*(?:#.*)?")
_WORDS = {"true": "true", "yes": "true", "on": "true", "false": "false", "no": "false", "off": "false"}
_NOTHING = ("null", "none", "nil")
_NUMBER = r"[+-]?\d[\d_]*(?:\.\d+)?"
_ONLY_COMMENTS = "only a comment may follow a value, and it begins with #"


@dataclass(frozen=True)
class SyntaxProblem:
    """One error of syntax. line, column: from 1."""

    line: int
    column: int
    said: str
    """in the parser's words"""
    likely: str
    """what was probably meant; empty where there is no telling"""
    text: str
    """the line as it stands"""

    @property
    def excerpt(self) -> str:
        """The line, and below the place a caret with what was probably meant."""
        first = max(0, min(self.column - 1 - WIDEST // 2, len(self.text) - WIDEST))
        shown = "".join(c if c.isprintable() or c == "\t" else "�" for c in self.text[first : first + WIDEST])
        before = re.sub(r"[^\t]", " ", shown[: self.column - 1 - first]).ljust(self.column - 1 - first)
        return f"    {shown}\n    {before}^ {self.likely}".rstrip()


def syntax_problems(text: str) -> tuple[list[SyntaxProblem], str | None]:
    """All errors of syntax in a text, and what is left of it without them, line by line where it was.

    None is left where an error reaches over lines, so that nobody can say what belongs to what.

    Raises:
        RecursionError: nested too deeply.
    """
    lines = text.replace("\r\n", "\n").split("\n")
    found: list[SyntaxProblem] = []
    for _ in range(MOST):
        try:
            tomllib.loads("\n".join(lines))
        except tomllib.TOMLDecodeError as error:
            problem = _problem(str(error), lines)
            found.append(problem)
            if problem.said.startswith(_SPANNING) or not lines[problem.line - 1]:
                return found, None
            lines[problem.line - 1] = _mended(problem)
        except ValueError:  # int()'s own: the parser lets it through
            if not _left_out_huge(lines, found):
                raise
        else:
            if not _left_out_huge(lines, found):
                return found, "\n".join(lines)
    return found, None


def _left_out_huge(lines: list[str], found: list[SyntaxProblem]) -> bool:
    """Leave out the first line with an integer that is too long to be shown or made a float; False where none is."""
    for at, line in enumerate(lines):
        bare = _QUOTED.sub(lambda quoted: " " * len(quoted[0]), line).partition("#")[0]
        if huge := _HUGE.search(bare):
            said, likely = "Integer of too many digits", "too large for any key"
            found.append(SyntaxProblem(at + 1, huge.start() + 1, said, likely, line))
            lines[at] = ""
            return True
    return False


def _mended(problem: SyntaxProblem) -> str:
    """What stands for a broken line while the rest is read: a header's name, as the keys below belong to it."""
    header = _HEADER.fullmatch(problem.text)
    mended = f"[{header[1]}]" if header is not None and "=" not in problem.text else ""
    return "" if mended == problem.text.strip() else mended


def _problem(error: str, lines: Sequence[str]) -> SyntaxProblem:
    place = _PLACE.search(error)
    said = error[: place.start()] if place is not None else error
    if place is not None and place[1] is not None:
        line, column = int(place[1]), int(place[2])
    else:
        line = next((n for n in range(len(lines), 0, -1) if lines[n - 1].strip()), 1)
        column = len(lines[line - 1].rstrip()) + 1
    if said.startswith("Invalid value") and _TABLE.fullmatch(lines[line - 1]):
        said = "Unclosed array"  # of an earlier line: it takes the table's head for an element
    if said.startswith(("Unclosed array", "Unterminated string")):
        line, column = _opening(said, lines, line, column)
    if said.startswith("Cannot overwrite") and line > 1 and not lines[line - 1].strip():
        line, column = line - 1, 1
    said = _KEY.sub(lambda key: ".".join(ast.literal_eval(key[0])), said)  # the parser shows a dotted key as a tuple
    return SyntaxProblem(line, column, said, _likely(said, lines, line, column), lines[line - 1])


def _opening(said: str, lines: Sequence[str], line: int, column: int) -> tuple[int, int]:
    """The end of the line on which began what is not closed, where that is an earlier one than was noticed."""
    for n in range(line, 0, -1):
        value = lines[n - 1].partition("=")[2].partition("#")[0]
        if said.startswith("Unclosed array"):
            begun = value.count("[") > value.count("]")
        else:
            begun = value.count('"""') == 1 or value.count('"') % 2 == 1
        if begun:
            return (n, column) if n == line else (n, len(lines[n - 1].rstrip()) + 1)
    return line, column


def _likely(said: str, lines: Sequence[str], line: int, column: int) -> str:
    text = lines[line - 1]
    if said.startswith(("Cannot declare", "Cannot overwrite")):
        return _standing_before(lines, line)
    meant = next((meant for start, meant in _MEANT if said.startswith(start)), "")
    return meant if isinstance(meant, str) else meant(text, text[column - 1 :].strip())


def _standing_before(lines: Sequence[str], line: int) -> str:
    """Where the table or key of a line stands already."""
    name = re.sub(r"\s", "", lines[line - 1].partition("=")[0])
    for n in range(line - 1, 0, -1):
        if name and re.sub(r"\s", "", lines[n - 1].partition("=")[0]) == name:
            return f"it stands on line {n} already"
        if lines[n - 1].lstrip().startswith("[") and not name.startswith("["):
            break  # another table's keys
    return "it stands further up already"


def _likely_value(text: str, here: str) -> str:
    """Where a value should be and none is."""
    key = text.partition("=")[0].strip()
    in_array = "[" in text.partition("=")[2]
    word = re.split(r"[\s,#\]}]", here, maxsplit=1)[0] if in_array else here.partition(" #")[0].strip()
    bare = word.strip("\"'“”„‘’«»`").replace("\\", "\\\\").replace('"', '\\"')
    cases = (
        (not here or here.startswith("#"), f"the value is missing: {key} = ..."),
        (here.startswith("="), "one = is enough"),
        (here.startswith("("), "a list stands in square brackets: [1, 2]"),
        (re.match(r"[+-]?\.\d", here), f"a number begins with a digit: {word.replace('.', '0.', 1)}"),
        (word.lower() in _WORDS, f"written as {_WORDS.get(word.lower())}"),
        (word.lower() in _NOTHING, "there is no such value: leave the line out"),
        (True, f'text stands in straight quotes: "{bare}"'),
    )
    return next(meant for holds, meant in cases if holds)


def _likely_value_and_more(text: str, here: str) -> str:
    """Where a value ends and more follows."""
    key, _, value = text.partition("=")
    key, value = key.strip(), value.partition("#")[0].strip()
    numbers = re.fullmatch(rf"{_NUMBER}\s*,\s*{_NUMBER}(\s*,\s*{_NUMBER})*", value)
    fraction = f"; a fraction has a point: {value.replace(',', '.')}" if re.fullmatch(r"\d+,\d+", value) else ""
    thousands = re.fullmatch(r"[+-]?[1-9]\d{0,2}(,\d{3})+", value)
    unit = re.fullmatch(rf"({_NUMBER})\s*[A-Za-zµ%]+", value)
    quoted = value.startswith(('"', "'"))
    cases = (
        (here.startswith((";", "//")), _ONLY_COMMENTS),
        (thousands, f"nothing stands between thousands, and a fraction has a point: {key} = {value.replace(',', '')}"),
        (numbers, f"several numbers stand in brackets: {key} = [{value}]{fraction}"),
        (re.match(r"0\d", value), f"a number has no zeros before it: {value.lstrip('0') or '0'}"),
        (re.fullmatch(r"\d+\.", value), f"a number ends with a digit: {value}0"),
        (unit, f"a number stands without its unit, which is in the key's name: {key} = {unit and unit[1]}"),
        (quoted and value.count(value[:1]) == 2, _ONLY_COMMENTS),
        (quoted, 'a quote within quotes is written \\"'),
        (True, f'text stands in straight quotes: {key} = "{value}"'),
    )
    return next(meant for holds, meant in cases if holds)


def _likely_pair(text: str, here: str) -> str:
    """Where = should follow a key."""
    if "=" in here:
        return "a key has no blanks in it"
    if here.startswith(":"):
        return "= stands between key and value, and no colon"
    words = text.partition("#")[0].split()
    header = _HEADER.fullmatch(text)
    if header is not None and text.partition("#")[0].rstrip().endswith("]"):
        return f"the opening bracket is missing: [{header[1]}]"
    return f"= stands between key and value: {words[0]} = {' '.join(words[1:])}" if len(words) > 1 else "= is missing"


def _likely_statement(_text: str, here: str) -> str:
    """Where a line begins as none can."""
    if here.startswith(("//", ";", "--", "/*", "%")):
        return "a comment begins with #"
    if here.startswith("="):
        return "the key is missing before ="
    return "a line is [table], key = value or # comment; keys have letters a-z, digits, - and _"


def _likely_header(text: str, _here: str) -> str:
    """Where a table's name should end."""
    header = _HEADER.fullmatch(text)
    return f"the closing bracket is missing: [{header[1]}]" if header else "a table's name has no blanks in it"


_QUOTE = "the closing quote is missing"
_MEANT: tuple[tuple[str, str | Callable[[str, str], str]], ...] = (
    ("Unterminated string", _QUOTE),
    ("Illegal character '\\n'", _QUOTE),
    ('Expected "\'"', _QUOTE),
    ("Unescaped '\\'", "in double quotes a backslash is written twice; in single quotes text stands as it is: '...'"),
    ("Unclosed array", "a comma or the closing ] is missing"),
    ("Unclosed inline table", "a comma or the closing } is missing: it ends on the line on which it begins"),
    ("Expected ']", _likely_header),
    ("Expected '='", _likely_pair),
    ("Expected newline", _likely_value_and_more),
    ("Invalid value", _likely_value),
    ("Invalid statement", _likely_statement),
)
"""What was probably meant, by how the parser's words begin"""
