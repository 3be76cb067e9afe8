"""Imports at first use (PEP 562): exports of a package, as its stub lists them, and optional packages.

Importing a package then costs nothing, and a name costs the import of its own module. Type checkers and editors read
the same stub `__init__.pyi`, so that there is one list (Scientific Python SPEC 1).
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

from falsework.errors import DependencyError

_WITH_EXTRA = ("learn", "robots", "viewer", "service")
"""Packages of falsework whose optional packages come with an extra of the same name."""


def lazy_exports(package: str) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """Make `__getattr__`, `__dir__` and `__all__` of a package from the imports in its stub.

    Returns:
        The three, in this order. A name whose module needs a package that is not installed raises `DependencyError`.
    """
    stub = Path(str(sys.modules[package].__file__)).with_suffix(".pyi")
    origins = {
        alias.name: str(statement.module)
        for statement in ast.parse(stub.read_text(encoding="utf-8")).body
        if isinstance(statement, ast.ImportFrom)
        for alias in statement.names
    }

    def __getattr__(name: str) -> Any:
        if name not in origins:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        if origins[name] == package:
            return import_module(f"{package}.{name}")
        try:
            value = getattr(import_module(origins[name]), name)
        except ModuleNotFoundError as error:
            extra = origins[name].split(".")[1]
            if extra not in _WITH_EXTRA or error.name is None or error.name.startswith("falsework"):
                raise
            raise DependencyError(f"{package}.{name} needs {error.name}; pip install 'falsework[{extra}]'") from None
        setattr(sys.modules[package], name, value)
        return value

    def __dir__() -> list[str]:
        return sorted({*vars(sys.modules[package]), *origins})

    return __getattr__, __dir__, sorted(origins)


@contextmanager
def importing(message: str) -> Iterator[None]:
    """Import what may be missing; a DependencyError with a message where it is."""
    try:
        yield
    except ImportError:
        raise DependencyError(message) from None
