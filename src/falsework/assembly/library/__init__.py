"""Built-in structures: parametric, deterministic, with nothing to download.

Each is a function that returns an `Assembly`, here and as `build("arch:blocks=15,thickness=0.2")`.
"""

from __future__ import annotations

from falsework.assembly.library.arches import arch, catenary
from falsework.assembly.library.blocks import Blocks
from falsework.assembly.library.catalogue import Parameter, Structure
from falsework.assembly.library.domes import dome
from falsework.assembly.library.plates import house, shelf
from falsework.assembly.library.polyominoes import bottle, polycube
from falsework.assembly.library.specification import build, built_in, is_built_in, structures
from falsework.assembly.library.stacks import corbel, stack, wall
from falsework.assembly.library.vaults import vault

__all__ = [
    "Blocks",
    "Parameter",
    "Structure",
    "arch",
    "bottle",
    "build",
    "built_in",
    "catenary",
    "corbel",
    "dome",
    "house",
    "is_built_in",
    "polycube",
    "shelf",
    "stack",
    "structures",
    "vault",
    "wall",
]
