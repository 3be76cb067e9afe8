"""Parser of built-in structure specifications such as `arch:blocks=15`."""

from __future__ import annotations

from difflib import get_close_matches
from typing import Any

from falsework.assembly.library.arches import arch, catenary
from falsework.assembly.library.catalogue import Structure
from falsework.assembly.library.domes import dome
from falsework.assembly.library.plates import house, shelf
from falsework.assembly.library.polyominoes import bottle, polycube
from falsework.assembly.library.stacks import corbel, stack, wall
from falsework.assembly.library.vaults import vault
from falsework.assembly.model import Assembly
from falsework.errors import InputError

_STRUCTURES: tuple[Structure, ...] = (
    arch,
    catenary,
    dome,
    vault,
    wall,
    stack,
    corbel,
    bottle,
    polycube,
    house,
    shelf,
)
_MATERIAL = ("density", "friction")


def structures() -> tuple[Structure, ...]:
    """Return all built-in structures, with their parameters as data."""
    return _STRUCTURES


def is_built_in(spec: str) -> bool:
    """Return whether a text names a built-in structure, with or without parameters."""
    return any(entry.name == spec.partition(":")[0].strip() for entry in _STRUCTURES)


def built_in(spec: str) -> str:
    """Return the text of a built-in structure in the form that stands for no folder or file: `arch:` for `arch`."""
    return spec if ":" in spec else f"{spec}:"


def build(spec: str, *, density: float | None = None, friction: float | None = None) -> Assembly:
    """Make a built-in structure from a text such as `vault` or `arch:blocks=15,thickness=0.2`.

    Args:
        spec: name, then after a colon values by parameter; `density` (kg/m3) and `friction` go with every
            structure.
        density: kg/m3, in place of one in `spec`.
        friction: coefficient, in place of one in `spec`.
    """
    name, _, text = (piece.strip() for piece in spec.partition(":"))
    entry = next((entry for entry in _STRUCTURES if entry.name == name), None)
    if entry is None:
        names = [known.name for known in _STRUCTURES]
        close = get_close_matches(name, names, 1)
        hint = f"did you mean {close[0]}?" if close else f"choose {', '.join(names)}"
        raise InputError(f"no built-in structure {name!r}; {hint}")
    values = _values(entry, text) if text else {}
    material = {key: _material(name, key, values.pop(key)) for key in _MATERIAL if key in values}
    density = material.get("density") if density is None else density
    friction = material.get("friction") if friction is None else friction
    return entry.make(values, density=density, friction=friction)


def _values(entry: Structure, text: str) -> dict[str, Any]:
    """Split `a=1,b=2`, and check that the parameters exist and that none comes twice."""
    names = (*entry.parameters, *_MATERIAL)
    values: dict[str, Any] = {}
    for pair in text.split(","):
        key, equals, value = (piece.strip() for piece in pair.partition("="))
        if not (key and equals and value):
            example = next(iter(entry.parameters.items()))
            raise InputError(f"{entry.name}: {pair!r} is not name=value, such as {example[0]}={example[1]}")
        if key not in names:
            raise InputError(f"{entry.name} has no parameter {key!r}; it has {', '.join(names)}")
        if key in values:
            raise InputError(f"{entry.name}: {key} is given twice")
        values[key] = value
    return values


def _material(name: str, key: str, value: str) -> float:
    try:
        return float(value)
    except ValueError:
        raise InputError(f"{name}: {key} is {value}; give a number") from None
