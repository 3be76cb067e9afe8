"""Cell as nodes of a viser scene: arms, obstacles, parts, places and reach; poses and colours change, shapes do not."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falsework.robots.model.shapes import wxyz_of
from falsework.robots.motion.near_pairs import NearPair
from falsework.viewer.cells.cell_model import COLLIDES, NEAR, CellModel, marks_of
from falsework.viewer.page.scene import link_node
from falsework.viewer.palette import bytes_of, rgb, robot_color

Array = NDArray[np.float64]


class CellScene:
    """Nodes of one cell."""

    def __init__(self, scene: Any, sight: CellModel) -> None:
        """Fill a scene."""
        self._scene, self._sight = scene, sight
        self._links, self._bodies, self._tools, self._reaches, self._others = ([] for _ in range(5))
        if sight.cell is None:
            return
        for number, link in enumerate(sight.links):
            self._links.append(link_node(scene, f"/robots/{link.robot}/{number}", link))
        for number, body in enumerate(sight.bodies):
            shape, color = (body.vertices.astype(np.float32), body.faces.astype(np.uint32)), rgb(body.color)
            node = scene.add_mesh_simple(f"/bodies/{number}", *shape, color=color, flat_shading=True)
            self._bodies.append(node)
        for number, (robot, reach) in enumerate(zip(sight.cell.robots, sight.reaches, strict=True)):
            color = rgb(robot_color(number))
            self._reaches.append(
                scene.add_icosphere(
                    f"/reach/{number}", reach.radius, color, position=reach.center, opacity=0.08, side="double",
                    subdivisions=5, cast_shadow=False, receive_shadow=False,
                )
            )  # fmt: skip
            self._tools.append(
                scene.add_frame(f"/tools/{number}", axes_length=0.08, axes_radius=0.003, origin_radius=0.005)
            )
            for place in np.unique(np.round(robot.places[:, :3, 3], 6), axis=0) if len(robot.places) else ():
                name = f"/places/{number}/{len(self._others)}"
                self._others.append(scene.add_icosphere(name, 0.02, color, position=place))

    def show(self, configurations: Sequence[Array], pairs: Sequence[NearPair]) -> None:
        """Move the arms, and colour the bodies that are too near each other."""
        sight = self._sight
        if sight.cell is None:
            return
        frames, marks = sight.frames(configurations), marks_of(pairs)
        for node, link in zip(self._links, sight.links, strict=True):
            pose, mark = frames[link.robot][link.frame], marks.get(sight.link_name(link))
            node.position, node.wxyz = pose[:3, 3], wxyz_of(pose[:3, :3])
            color = bytes_of(link.color) if mark is None else rgb(mark)
            if tuple(node.color) != color:
                node.color = color
        for node, body in zip(self._bodies, sight.bodies, strict=True):
            color = rgb(marks.get(body.name, body.color))
            if tuple(node.color) != color:
                node.color = color
        for node, robot, poses in zip(self._tools, sight.cell.robots, frames, strict=True):
            tool = poses[-1] @ robot.gripper.tool
            node.position, node.wxyz = tool[:3, 3], wxyz_of(tool[:3, :3])

    def show_reach(self, wanted: bool) -> None:
        """Show or hide the reach of the arms."""
        for node in self._reaches:
            node.visible = wanted

    def remove(self) -> None:
        """Remove all nodes."""
        for node in (*self._links, *self._bodies, *self._tools, *self._reaches, *self._others):
            node.remove()


LEGEND = ((COLLIDES, "touch"), (NEAR, "too near"))
