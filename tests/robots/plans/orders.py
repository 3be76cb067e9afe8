"""Settings of robot plans in the order of disassembly; by default they are in that of assembly."""

from falsework.robots.planning.hybrid_result import HybridSettings
from falsework.search.problem.task import Direction

APART = HybridSettings(Direction.DISASSEMBLY)
