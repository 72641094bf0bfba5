"""Set-up compiles every kernel: one that is called from Python and is not, would be compiled in somebody's scan."""

from __future__ import annotations

import ast
import json
import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TypeGuard

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


def is_kernel(node: ast.AST) -> TypeGuard[ast.FunctionDef]:
    return isinstance(node, ast.FunctionDef) and any("kernel" in ast.unparse(d) for d in node.decorator_list)


@dataclass
class Module:
    """What one module has to do with kernels. Not its tree: hundreds of those keep the garbage collector busy."""

    kernels: set[str]
    called: set[str]
    """names that are called, or handed on, outside of kernels"""
    imported: set[tuple[str | None, str]]

    @classmethod
    def of(cls, source: str) -> Module:
        tree = ast.parse(source)
        found = cls({node.name for node in tree.body if is_kernel(node)}, set(), set())
        rest = list[ast.AST](tree.body)
        while rest:
            node = rest.pop()
            if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load):
                found.called.add(node.id)
            elif isinstance(node, ast.ImportFrom):
                found.imported |= {(node.module, alias.name) for alias in node.names}
            elif not is_kernel(node):
                rest.extend(ast.iter_child_nodes(node))
        return found


def module_of(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def test_every_kernel_is_compiled_at_set_up() -> None:
    modules = {
        module_of(path): Module.of(path.read_text())
        for package in ("scanner", "drivers", "service")
        for path in (ROOT / package).rglob("*.py")
    }
    kernels = {(name, kernel) for name, module in modules.items() for kernel in module.kernels}
    entered = {
        (name, kernel)
        for here, module in modules.items()
        for name, kernel in kernels & (module.imported | {(here, kernel) for kernel in module.kernels})
        if kernel in module.called
    }
    assert len(entered) > 30
    assert CACHED
    ran = subprocess.run(
        [sys.executable, "-c", COMPILED, json.dumps(sorted(entered))],
        capture_output=True, text=True, check=False, timeout=100,
    )  # fmt: skip
    assert ran.returncode == 0, ran.stderr
    assert json.loads(ran.stdout) == []


def test_set_up_compiles_anew_when_any_kernel_has_changed() -> None:
    """Numba looks at a kernel's own file only; set-up must know those whose kernels are part of others as well."""
    (pattern,) = re.findall(r"sources=\$\(grep -rlE '([^']+)'", (ROOT / "setup/install.sh").read_text())
    sources = [path for room in ("scanner", "drivers", "service") for path in sorted((ROOT / room).rglob("*.py"))]
    kernels = [path for path in sources if re.search(r"^@\w*kernel", path.read_text(), re.MULTILINE)]
    assert len(kernels) > 40
    assert not [path for path in [*kernels, ROOT / "scanner/lanes.py"] if not re.search(pattern, path.read_text())]
