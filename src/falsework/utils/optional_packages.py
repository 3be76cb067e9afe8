"""Checks for optional packages, with a one-line error that names the extra to install."""

from __future__ import annotations

from importlib.util import find_spec

from falsework.errors import DependencyError


def check_torch() -> None:
    """Look for the packages that learning cannot do without."""
    for name in ("torch", "safetensors"):
        if find_spec(name) is None:
            raise DependencyError(f"learning needs {name}; pip install 'falsework[learn]'")
