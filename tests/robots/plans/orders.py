"""Settings of robot plans in the order of disassembly; by default they are in that of assembly."""

from falsework import Direction
from falsework.robots import HybridSettings

APART = HybridSettings(Direction.DISASSEMBLY)
