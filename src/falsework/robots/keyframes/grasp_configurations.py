"""Grasp and drop-off configurations of the robots of a cell, ranked for trial."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.model import Assembly
from falsework.assembly.state import REMOVED, States
from falsework.errors import CellError
from falsework.robots.grasping.grasp import Grasp, candidates, clear_grasps, grasp_fault
from falsework.robots.keyframes.failure_report import FailureLog
from falsework.robots.kinematics.forward import tool_pose
from falsework.robots.kinematics.inverse import inverse
from falsework.robots.model.cell import Gripper
from falsework.robots.model.shapes import Array
from falsework.robots.motion.collision_world import Scene, grasp_contact
from falsework.robots.motion.path_planner import MotionCache
from falsework.utils.quantity import counted, format_quantity, listed


@dataclass(frozen=True, eq=False)
class GraspConfiguration:
    """Grasp of a part by one robot, with a configuration that reaches it."""

    robot: int
    grasp: Grasp
    configuration: Array
    """Shape (joints,)."""


class GraspConfigurations:
    """Grasp configurations of the robots of a cell, computed on demand."""

    def __init__(self, assembly: Assembly, cache: MotionCache, reasons: FailureLog, *, limit: int) -> None:
        """Try the `limit` best grasps of a part in the scenes of `cache`; log to `reasons` why none is possible."""
        self.assembly, self.cell, self.parts = assembly, cache.world.cell, cache.world.parts
        self.cache, self.reasons, self.limit = cache, reasons, limit
        self.given: dict[int, GraspConfiguration] = {}
        """Parts that are held in one way only, as robots hold them when an assembly is continued."""
        self._grips: dict[tuple[int, int, bytes, bytes], list[GraspConfiguration]] = {}
        self._places: dict[int, Array] = {}
        self._candidates: dict[tuple[int, Gripper], list[Grasp]] = {}
        self._faults: dict[tuple[int, Gripper], str] = {}

    def get(self, robot: int, part: int, state: States, pose: Array | None = None) -> list[GraspConfiguration]:
        """Return all grasps of a part by a robot among the parts of a state; other robots are ignored.

        `pose` is the displacement of a part that waits away from its place, shape (4, 4).
        """
        if part in self.given and pose is None:
            return [self.given[part]] if self.given[part].robot == robot else []
        present = state != REMOVED
        key = (robot, part, np.packbits(present).tobytes(), b"" if pose is None else pose.tobytes())
        if key not in self._grips:
            self._grips[key] = self._find(robot, part, present, pose)
        return self._grips[key]

    def check(self, parts: Iterable[int]) -> None:
        """Raise CellError for parts that no gripper can carry, whatever else stands and wherever the arms are."""
        faults = {}
        for part in parts:
            of_robots = [self._never(robot, part) for robot in range(self.cell.robot_count)]
            if all(of_robots):
                faults[part] = "; ".join(dict.fromkeys(of_robots))
        if faults:
            named = listed([f"{self.parts.names[part]} ({fault})" for part, fault in faults.items()], 3)
            raise CellError(
                f"no gripper of {self.cell.name} can carry {counted(len(faults), 'part')}: {named}; take other "
                "grippers, or set scale or density of [structure]"
            )

    def places(self, robot: int) -> Array:
        """Return drop-off configurations of a robot, shape (n, joints)."""
        if robot not in self._places:
            entry = self.cell.robots[robot]
            found = [values for values in inverse(entry, entry.places) if len(values)]
            self._places[robot] = np.concatenate(found) if found else np.zeros((0, entry.model.joints))
        return self._places[robot]

    def grasps(self, part: int, present: NDArray[np.bool_], gripper: Gripper) -> list[Grasp]:
        """Return grasps of a part among the present parts, best first; the arm is not considered."""
        return clear_grasps(self._tried(part, gripper), self.parts, part, present, gripper, limit=self.limit)

    def best(
        self, grips: list[GraspConfiguration], robot: int, scene: Scene, held: tuple[int | None, ...], count: int
    ) -> list[GraspConfiguration]:
        """Return the grasps to try, best first: near the robot's configuration, and away from other arms."""
        if not grips:
            return []
        room = self._room(grips, robot, scene.configurations, held)
        here = scene.configurations[robot]
        values = np.array([grip.configuration for grip in grips])
        way = 0.1 * np.abs(values - here).max(axis=1)
        return _spread([grips[row] for row in np.argsort(way - room, kind="stable")], count)

    def _room(
        self, grips: list[GraspConfiguration], robot: int, configurations: Sequence[Array], held: tuple[int | None, ...]
    ) -> Array:
        """Return the distance between grasps and other arms, in approach margins, shape (grasps,).

        The flange end of the gripper should be on the side of its own base, and away from parts that others hold.
        Zeros for fewer than three arms: two seldom obstruct each other, and nearest first does better for them.
        """
        if not grips or self.cell.robot_count < 3:
            return np.zeros(len(grips))
        entry = self.cell.robots[robot]
        tools = np.array([grip.grasp.tool for grip in grips])
        flanges = (tools @ np.linalg.inv(entry.gripper.tool))[:, :2, 3]
        room = -np.linalg.norm(flanges - entry.base[:2, 3], axis=1)
        for other, part in enumerate(held):
            if part is not None:
                flange = tool_pose(self.cell.robots[other], configurations[other]) @ np.linalg.inv(
                    self.cell.robots[other].gripper.tool
                )
                room = room + np.minimum(np.linalg.norm(flanges - flange[:2, 3], axis=1), 0.3)
        return room / self.cell.margins.approach

    def _find(self, robot: int, part: int, present: NDArray[np.bool_], pose: Array | None) -> list[GraspConfiguration]:
        entry, there = self.cell.robots[robot], present.copy()
        if heavy := self._heavy(robot, part):
            self.reasons.add("hold", part, robot, heavy)
            return []
        if pose is not None:  # away from its place other parts are in the way than there
            present, there[part] = np.arange(len(present)) == part, False
        found = self.grasps(part, present, entry.gripper)
        if not found:
            self.reasons.add("hold", part, robot, self._fault(part, entry.gripper))
            return []
        tools = np.array([grasp.tool for grasp in found])
        branches = inverse(entry, tools if pose is None else pose @ tools)
        if not sum(len(solutions) for solutions in branches):
            self.reasons.add("hold", part, robot, "out of reach")
            return []
        # One robot among parts, all others at home.
        waits = () if pose is None else ((part, pose),)
        alone = Scene(self.cell.homes, there, (None,) * self.cell.robot_count, waits)
        view = self.cache.view(alone, robot, grasp_contact(part))
        values = np.concatenate(branches)
        which = np.repeat(np.arange(len(found)), [len(solutions) for solutions in branches]).tolist()
        hits = view.hits(values)
        clear = np.flatnonzero(hits < 0).tolist()
        if not clear:
            self.reasons.add("hold", part, robot, "every grasp collides", view.pair(int(hits[-1])))
        return [GraspConfiguration(robot, found[which[row]], values[row]) for row in clear]

    def _heavy(self, robot: int, part: int) -> str:
        """Return in words that a part is too heavy for a robot; empty if it is not."""
        mass, payload = float(self.parts.mass[part]), self.cell.robots[robot].payload
        if mass <= payload:
            return ""
        return f"it weighs {format_quantity(mass, 'mass')}, more than the payload of {format_quantity(payload, 'mass')}"

    def _never(self, robot: int, part: int) -> str:
        """Return why a robot can never carry a part, not even one that is alone; empty if it may."""
        if heavy := self._heavy(robot, part):
            return heavy
        gripper = self.cell.robots[robot].gripper
        return "" if self._tried(part, gripper) else self._fault(part, gripper)

    def _fault(self, part: int, gripper: Gripper) -> str:
        """Return why a gripper has no grasp of a part among others."""
        key = part, gripper
        if key not in self._faults:
            self._faults[key] = grasp_fault(self.parts, part, gripper, blocked=bool(self._candidates[key]))
        return self._faults[key]

    def _tried(self, part: int, gripper: Gripper) -> list[Grasp]:
        """Return grasps of a part that is alone, best first."""
        key = part, gripper
        if key not in self._candidates:
            self._candidates[key] = candidates(self.assembly, self.parts, part, gripper)
        return self._candidates[key]


def _spread(grips: list[GraspConfiguration], count: int) -> list[GraspConfiguration]:
    """Return the first configurations, one of each grasp in turn, so that a single grasp does not use up all tries."""
    chosen: list[GraspConfiguration] = []
    while grips and len(chosen) < count:
        first: dict[int, GraspConfiguration] = {}
        rest = [grip for grip in grips if first.setdefault(id(grip.grasp), grip) is not grip]
        chosen += first.values()
        grips = rest
    return chosen[:count]
