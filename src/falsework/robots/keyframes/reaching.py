"""Lines and motions on which an empty gripper comes to a part that it takes, and leaves one that it lets go of."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from falsework.robots.keyframes.failure_report import FailureLog
from falsework.robots.keyframes.keyframes import PathSegment
from falsework.robots.kinematics.forward import tool_pose
from falsework.robots.model.shapes import Array
from falsework.robots.motion.collision_world import Scene, grasp_contact
from falsework.robots.motion.path_planner import MotionCache, follow_line


class Reaching:
    """Motions of empty grippers to parts, and away from them."""

    def __init__(self, cache: MotionCache, reasons: FailureLog, lengths: Sequence[float]) -> None:
        """Move in the scenes of `cache` on lines of some lengths, in approach margins, and log to `reasons`."""
        self.cell, self.cache, self.reasons, self._lengths = cache.world.cell, cache, reasons, lengths

    def retreat(self, action: str, scene: Scene, part: int, robot: int, here: Array, way: Array) -> Array | None:
        """Return the line on which a gripper leaves a part until it is clear of everything; None if it is blocked."""
        view, clear = self.cache.view(scene, robot, grasp_contact(part)), self.cache.view(scene, robot)
        what = "approach" if action == "hold" else "retreat"
        for share in self._lengths:
            line = follow_line(view, here, way, share * self.cell.margins.approach)
            if line.path is None:
                self.reasons.add(action, part, robot, f"{what}: {line.reason}", line.pair, line.at)
                continue
            near = clear.explain(line.path[-1])
            if near is None:
                return line.path
            self.reasons.add(action, part, robot, f"{what}: too near", near, line.path[-1])
        return None

    def approach(self, scene: Scene, part: int, robot: int, retreat: Array) -> tuple[PathSegment, ...] | None:
        """Return the paths on which a robot comes to a part, with a line away from it, (points, joints), in reverse."""
        free = self.cache.motion(scene, robot, scene.configurations[robot], retreat[-1])
        if free.path is None:
            self.reasons.add("hold", part, robot, f"motion to the part: {free.reason}", free.pair, free.at)
            return None
        line = PathSegment("line", retreat[::-1].copy(), touches=part)
        return PathSegment("free", free.path, view=self.cache.view(scene, robot)), line

    def departures(self, scene: Scene, part: int, robot: int) -> Iterator[tuple[PathSegment, ...]]:
        """Yield the path on which a robot lets go of a part and stays beside it, then those on which it goes home."""
        here, entry = scene.configurations[robot], self.cell.robots[robot]
        path = self.retreat("release", scene, part, robot, here, -tool_pose(entry, here)[:3, 2])
        if path is None:
            return
        line = PathSegment("line", path, touches=part)
        yield (line,)
        home = self.cache.motion(scene, robot, path[-1], entry.home)
        if home.path is not None:
            yield line, PathSegment("free", home.path, view=self.cache.view(scene, robot))
