"""Compiles every kernel into numba's cache on disk, so that no first scan waits for it. Part of set-up.

A module that holds kernels offers `warm_up()`, which calls each once on tiny arrays of the real types. This module
finds them by that name in the project's packages and calls them; nothing needs to be registered. It is no part of a
running daemon: workers call the `warm_up` of what they use.
"""

from __future__ import annotations

import ast
import importlib
import sys
import time
from collections.abc import Iterator
from importlib.resources import files
from importlib.resources.abc import Traversable

PACKAGES = ("scanner", "drivers", "service")


def modules_with_kernels() -> list[str]:
    """Names of the project's modules that define `warm_up` at their top level. Reads sources, imports nothing."""
    return sorted(name for package in PACKAGES for name in _search(package, files(package)))


def main() -> int:
    """Call every `warm_up`; one line for each on standard error."""
    for name in modules_with_kernels():
        began = time.monotonic()
        importlib.import_module(name).warm_up()
        print(f"set-up: compiled {name} in {time.monotonic() - began:.1f} s", file=sys.stderr)
    return 0


def _search(name: str, folder: Traversable) -> Iterator[str]:
    for entry in folder.iterdir():
        if entry.is_dir() and entry.joinpath("__init__.py").is_file():
            yield from _search(f"{name}.{entry.name}", entry)
        elif entry.name.endswith(".py") and _defines_warm_up(entry.read_text(encoding="utf-8")):
            yield name if entry.name == "__init__.py" else f"{name}.{entry.name.removesuffix('.py')}"


def _defines_warm_up(source: str) -> bool:
    if "def warm_up" not in source:
        return False
    return any(isinstance(node, ast.FunctionDef) and node.name == "warm_up" for node in ast.parse(source).body)


if __name__ == "__main__":
    sys.exit(main())
