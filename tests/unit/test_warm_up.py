"""Set-up compiles every kernel: one that is called from Python and is not, would be compiled in somebody's scan."""

from __future__ import annotations

import ast
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from scanner.kernel import CACHED

ROOT = Path(__file__).parents[2]

COMPILED = """
import importlib, json, sys
from service.warm_up import main
main()
kernels = json.loads(sys.argv[1])
print(json.dumps([f"{module}.{name}" for module, name in kernels
                  if not getattr(importlib.import_module(module), name).signatures]))
"""


def is_kernel(node: ast.AST) -> bool:
    return isinstance(node, ast.FunctionDef) and any("kernel" in ast.unparse(d) for d in node.decorator_list)


def called_from_python(node: ast.AST) -> Iterator[str]:
    """Names that are called, or handed on, outside of kernels."""
    if is_kernel(node):
        return
    if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load):
        yield node.id
    for child in ast.iter_child_nodes(node):
        yield from called_from_python(child)


def module_of(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def test_every_kernel_is_compiled_at_set_up() -> None:
    trees = {
        module_of(path): ast.parse(path.read_text())
        for package in ("scanner", "drivers", "service")
        for path in (ROOT / package).rglob("*.py")
    }
    kernels = {module: {n.name for n in tree.body if is_kernel(n)} for module, tree in trees.items()}
    entered = set()
    for module, tree in trees.items():
        names = set(called_from_python(tree))
        entered |= {(module, name) for name in kernels[module] & names}
        imports = (n for n in ast.walk(tree) if isinstance(n, ast.ImportFrom) and n.module in kernels)
        entered |= {
            (str(n.module), a.name) for n in imports for a in n.names if a.name in kernels[str(n.module)] & names
        }
    assert len(entered) > 30
    assert CACHED
    ran = subprocess.run(
        [sys.executable, "-c", COMPILED, json.dumps(sorted(entered))],
        capture_output=True, text=True, check=False, timeout=100,
    )  # fmt: skip
    assert ran.returncode == 0, ran.stderr
    assert json.loads(ran.stdout) == []
