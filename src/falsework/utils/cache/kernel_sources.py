"""Source files that the code of a kernel comes from: its own, those of what it calls, and those of constants in it."""

from __future__ import annotations

import ast
import inspect
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any

from falsework.utils.kernel_code import PACKAGE

VECTORS = PACKAGE / "utils/vectors.py"
"""Module of the vector instructions that kernels use through numba, and do not call by name."""


def callees(kernel: Any) -> set[Any]:
    """Return a kernel and all that it calls, directly or not."""
    found, ahead = set(), [kernel]
    while ahead:
        function = ahead.pop()
        if function not in found:
            found.add(function)
            known = inspect.getclosurevars(function.py_func)
            values = (*known.globals.values(), *known.nonlocals.values())
            ahead += [value for value in values if isinstance(value, type(kernel))]
    return found


def sources(kernels: Iterable[Any]) -> list[str]:
    """Return the files that kernels and the constants in them come from, by their paths in the package if there."""
    kernels = list(kernels)
    files = {VECTORS, *(Path(kernel.py_func.__code__.co_filename) for kernel in kernels)}
    names = {name for kernel in kernels for name in kernel.py_func.__code__.co_names}
    for file in list(files):
        for module, imported in _imports(file):
            origin = PACKAGE.parent / (module.replace(".", "/") + ".py")
            if names & imported and origin.is_file():
                files.add(origin)
    return sorted(file.relative_to(PACKAGE).as_posix() if file.is_relative_to(PACKAGE) else str(file) for file in files)


@cache
def _imports(file: Path) -> list[tuple[str, frozenset[str]]]:
    """Return the modules that a file imports names from, with the names."""
    statements = ast.walk(ast.parse(file.read_text(encoding="utf-8")))
    return [
        (str(line.module), frozenset(alias.name for alias in line.names))
        for line in statements
        if isinstance(line, ast.ImportFrom)
    ]
