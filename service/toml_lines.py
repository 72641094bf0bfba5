"""On which line of a TOML file each key stands: what `tomllib` does not say and an error message must.

Reads text that `tomllib` has already accepted, so it checks nothing; it only follows tables, dotted and quoted keys,
arrays, inline tables and strings of all four kinds.
"""

from __future__ import annotations

import tomllib

KeyPath = tuple[str | int, ...]

_BARE_ENDS = " \t=.]}"
_VALUE_ENDS = ",]}#\r\n"


def key_lines(text: str) -> dict[KeyPath, int]:
    """Line (from 1) of every key, table and array element of a valid TOML text, by its path."""
    return _Reader(text.replace("\r\n", "\n")).read()


class _Reader:
    """A walk over the text; `_at` is the place reached."""

    def __init__(self, text: str) -> None:
        self._text = text
        self._at = 0
        self._line = 1
        self._found: dict[KeyPath, int] = {}
        self._array_tables: dict[KeyPath, int] = {}

    def read(self) -> dict[KeyPath, int]:
        table: KeyPath = ()
        self._skip_blank()
        while self._at < len(self._text):
            if self._peek("["):
                table = self._header()
            else:
                self._pair(table)
            self._skip_blank()
        return self._found

    def _header(self) -> KeyPath:
        line, double = self._line, self._peek("[[")
        self._at += 2 if double else 1
        table = self._resolved(self._keys(), double)
        self._at += 2 if double else 1
        self._note(table, line)
        return table

    def _resolved(self, keys: list[str], double: bool) -> KeyPath:
        """A header's keys with the index of the latest element put in after each array of tables."""
        path: KeyPath = ()
        for i, key in enumerate(keys):
            path = (*path, key)
            if double and i == len(keys) - 1:
                self._array_tables[path] = self._array_tables.get(path, -1) + 1
            if path in self._array_tables:
                path = (*path, self._array_tables[path])
        return path

    def _pair(self, table: KeyPath) -> None:
        line = self._line
        path = (*table, *self._keys())
        self._at += 1  # the equals sign
        self._note(path, line)
        self._value(path)

    def _keys(self) -> list[str]:
        """A dotted key, up to the character that ends it."""
        keys = []
        while True:
            self._skip_spaces()
            start = self._at
            if self._text[self._at] in "\"'":
                self._string()
                keys.append(str(tomllib.loads(f"k = {self._text[start : self._at]}")["k"]))
            else:
                while self._text[self._at] not in _BARE_ENDS:
                    self._at += 1
                keys.append(self._text[start : self._at])
            self._skip_spaces()
            if not self._peek("."):
                return keys
            self._at += 1

    def _value(self, path: KeyPath) -> None:
        self._skip_spaces()
        if self._text[self._at] in "\"'":
            self._string()
        elif self._peek("["):
            self._elements(path, "]")
        elif self._peek("{"):
            self._elements(path, "}")
        else:
            while self._at < len(self._text) and self._text[self._at] not in _VALUE_ENDS:
                self._at += 1

    def _elements(self, path: KeyPath, end: str) -> None:
        """An array's elements or an inline table's pairs."""
        self._at += 1
        index = 0
        self._skip_blank()
        while not self._peek(end):
            if end == "}":
                self._pair(path)
            else:
                self._note((*path, index), self._line)
                self._value((*path, index))
                index += 1
            self._skip_blank()
            if self._peek(","):
                self._at += 1
                self._skip_blank()
        self._at += 1

    def _string(self) -> None:
        quote = self._text[self._at]
        triple = self._peek(quote * 3)
        mark = quote * 3 if triple else quote
        self._at += len(mark)
        while not self._peek(mark):
            self._line += self._peek("\n")
            self._at += 2 if quote == '"' and self._peek("\\") and not self._peek("\\\n") else 1
        self._at += len(mark)
        while triple and self._peek(quote):  # up to two quotes may stand before the closing three
            self._at += 1

    def _skip_spaces(self) -> None:
        while self._at < len(self._text) and self._text[self._at] in " \t":
            self._at += 1

    def _skip_blank(self) -> None:
        """Spaces, line ends and comments."""
        while self._at < len(self._text) and self._text[self._at] in " \t\r\n#":
            if self._peek("#"):
                end = self._text.find("\n", self._at)
                self._at = len(self._text) if end < 0 else end
            else:
                self._line += self._peek("\n")
                self._at += 1

    def _peek(self, mark: str) -> bool:
        return self._text.startswith(mark, self._at)

    def _note(self, path: KeyPath, line: int) -> None:
        """Remember the path and, unless they have a place of their own, the tables it implies."""
        for length in range(1, len(path)):
            self._found.setdefault(path[:length], line)
        self._found[path] = line
