"""Parts, arrows and arms as nodes of a viser scene: few merged meshes with incremental updates.

One node per part would need thousands of draw calls. Instead the parts that are not held are merged by the order in
which they leave, some dozens to a mesh, so that a step changes one or two meshes and a jump mostly shows and hides
them; all other parts are merged by colour. Moving parts are nodes of their own, since they change every frame.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falsework.geometry.mesh.mesh import joined_faces, unit_normals
from falsework.robots.model.shapes import wxyz_of
from falsework.utils.files.printable import printable
from falsework.utils.quantity import format_quantity
from falsework.viewer.appearance import Appearance, bounds_of, diagonal
from falsework.viewer.arms import ArmPoses, Arms, Link
from falsework.viewer.arrows import KINDS, Arrows, scale_arrow
from falsework.viewer.palette import INK, INSTALLED, MISSING, MOTION, bytes_of, hex_of, rgb
from falsework.viewer.section import Plane, cut
from falsework.viewer.timeline import Timeline

Array = NDArray[np.float64]

SIZE = 4.0
"""Length to which the diagonal of every structure is scaled, so that camera and lines fit millimetres and bridges."""
CHUNK = 32
"""Number of parts per merged mesh."""
EDGES_UP_TO = 400
"""Largest number of parts for which sharp edges are drawn as lines; above, parts are drawn slightly smaller instead."""
_SHRUNK = 0.985
"""Size of parts that have no edges drawn, as a share of their own."""
_PALE = 0.18
"""Opacity of pale parts."""
_SHARP = np.cos(np.radians(25.0))
"""Cosine of the angle between faces from which their edge is drawn."""


class ViserScene:
    """Browser scene; `show` updates it."""

    def __init__(self, scene: Any, timeline: Timeline) -> None:
        """Fill a scene."""
        assembly = timeline.assembly
        self._scene = scene
        self.assembly = assembly
        self.scale = SIZE / diagonal(assembly)
        low, high = bounds_of(assembly)
        self.origin = np.array([*(low + high)[:2] / 2, low[2]])
        self.height = float(high[2] - low[2]) * self.scale
        shrink = _SHRUNK if assembly.part_count > EDGES_UP_TO else 1.0
        self._vertices = [
            self.place(center + shrink * (mesh.vertices - center)).astype(np.float32)
            for mesh, center in zip(assembly.meshes, assembly.mass.center, strict=True)
        ]
        self._faces = [mesh.faces.astype(np.uint32) for mesh in assembly.meshes]
        self._lined = assembly.part_count <= EDGES_UP_TO
        self._edges = [sharp_edges(v, f) for v, f in zip(self._vertices, self._faces, strict=True)]
        self._plane: Plane | None = None
        self._cut: dict[int, tuple[Any, Any, Any]] = {}
        self._chunk = np.zeros(assembly.part_count, dtype=np.int64)
        self.shown: dict[str, bytes] = {}
        self.nodes: dict[str, Any] = {}
        self._ghosts: dict[int, tuple[bytes, Any]] = {}
        self._labels: dict[int, tuple[str, Any]] = {}
        self._opacity: float | None = None
        self._arms: list[Any] = []
        self._carried: dict[tuple[int, str], Any] = {}
        self._robots: Any = None
        self.order(timeline)

    def order(self, timeline: Timeline) -> None:
        """Merge parts by the order in which they leave in disassembly; to be called when the plan changes."""
        step = timeline.insertion
        rank = np.empty(len(step), dtype=np.int64)
        rank[np.argsort(-step, kind="stable")] = np.arange(len(step))
        self._chunk = rank // CHUNK

    def place(self, points: Array) -> Array:
        """Convert metres to the coordinates of the scene."""
        return (points - self.origin) * self.scale

    def pose(self, appearance: Appearance, part: int) -> tuple[Array, tuple[float, float, float, float]]:
        """Return position and rotation, a quaternion wxyz, of the node of a part."""
        turn = appearance.turn[part]
        position = (appearance.shift[part] + turn @ self.origin - self.origin) * self.scale
        return position, wxyz_of(turn)

    def ray(self, origin: Sequence[float], direction: Sequence[float]) -> tuple[Array, Array]:
        """Convert a ray of the scene to metres."""
        return np.asarray(origin, dtype=float) / self.scale + self.origin, np.asarray(direction, dtype=float)

    def show(
        self,
        appearance: Appearance,
        *,
        missing: Iterable[int] = (),
        pale: Iterable[int] = (),
        labels: Mapping[int, str] | None = None,
        plane: Plane | None = None,
    ) -> int:
        """Update the parts.

        Args:
            plane: section of the parts in their places, metres; None for whole parts.

        Returns:
            Number of nodes that were sent.
        """
        if plane != self._plane:
            self._plane, self._cut = plane, {}
        wanted: dict[str, list[int]] = {}
        base = np.array(rgb(INSTALLED), dtype=np.uint8)
        solid = np.flatnonzero(appearance.solid)
        plain = (appearance.color == base).all(axis=1)
        for part in solid.tolist():
            if plain[part]:
                wanted.setdefault(f"/parts/standing/{self._chunk[part]}", []).append(part)
            else:
                wanted.setdefault(f"/parts/colour/{hex_of(appearance.color[part])[1:]}", []).append(part)
        for name, parts in (("/parts/missing", missing), ("/parts/pale", pale)):
            if chosen := sorted(int(part) for part in parts):
                wanted[name] = chosen
        sent = 0
        for name, parts in wanted.items():
            sent += self._merge(name, parts)
        for name in [name for name in self.shown if name.startswith("/parts/") and name not in wanted]:
            self._hide(name)
        sent += self._show_ghosts(appearance)
        self._show_labels(appearance, labels or {})
        return sent

    def show_scale(self, arrows: Iterable[Arrows]) -> None:
        """Draw an arrow of a round force beside the structure, where some of the arrows are forces."""
        found = scale_arrow(self.assembly, arrows)
        if found is None:
            self._hide("/scale")
        elif (node := self._arrow_node("/scale", "/scale/arrow", found[0])) is not None:
            end = self.place(found[0].ends)[0, 1]
            words = self._scene.add_label("/scale/force", format_quantity(found[1], "force"), position=end)
            self._keep("/scale", self.nodes["/scale"][0], node, words)

    def _arrow_node(self, name: str, path: str, arrows: Arrows) -> Any:
        """Draw arrows as a node of the scene, and return it; None where it is there already."""
        ends = self.place(arrows.ends)
        if not self._fresh(name, ends.tobytes()):
            return None
        width = 0.006 * SIZE * arrows.breadth
        node = self._scene.add_arrows(
            path, ends.astype(np.float32), rgb(arrows.color),
            shaft_radius=width / 2, head_radius=1.3 * width, head_length=2.6 * width,
        )  # fmt: skip
        self._keep(name, ends.tobytes(), node)
        return node

    def show_arrows(self, arrows: Mapping[str, Arrows], moved: Mapping[int, Array], color: str = MOTION) -> None:
        """Update the arrows.

        Args:
            moved: vertices of parts slightly later in their motion, metres.
        """
        for kind in KINDS:
            name, some = f"/arrows/{kind.replace(' ', '-')}", arrows.get(kind)
            if some is None or len(some) == 0:
                self._hide(name)
            else:
                self._arrow_node(name, name, some)
        if not moved:
            self._hide("/motion")
            return
        parts = sorted(moved)
        points, faces = joined_faces(
            [self.place(moved[part]).astype(np.float32) for part in parts], [self._faces[part] for part in parts]
        )
        key = color.encode() + points.tobytes()
        if self._fresh("/motion", key):
            node = self._scene.add_mesh_simple(
                "/motion", points, faces, color=rgb(color), opacity=0.35, side="double",
                flat_shading=True, cast_shadow=False, receive_shadow=False,
            )  # fmt: skip
            self._keep("/motion", key, node)

    def show_arms(self, arms: Arms | None, arm_poses: ArmPoses | None, *, seen: bool = True) -> None:
        """Update the arms, and the parts that they carry.

        Args:
            arms: the robots; None to remove them.
            seen: whether to show the arms; the parts that they carry are always shown.
        """
        if arms is None or arm_poses is None:
            for node in (*self._arms, *self._carried.values()):
                node.remove()
            self._arms, self._carried, self._robots = [], {}, None
            return
        if self._robots is not arms.cell:
            self.show_arms(None, None)
            self._robots = arms.cell
            for number, link in enumerate(arms.links):
                self._arms.append(link_node(self._scene, f"/arms/{number}", link, self.scale))
        for node, pose in zip(self._arms, arm_poses.poses, strict=True):
            if node.visible != seen:
                node.visible = seen
            node.position, node.wxyz = self.place(pose[:3, 3]), wxyz_of(pose[:3, :3])
        for key in self._carried.keys() - {(carried.part, carried.color) for carried in arm_poses.carried}:
            self._carried.pop(key).remove()
        for carried in arm_poses.carried:
            part, turn, key = carried.part, carried.pose[:3, :3], (carried.part, carried.color)
            if key not in self._carried:
                color, shape = rgb(carried.color), (self._vertices[part], self._faces[part])
                node = self._scene.add_mesh_simple(f"/carried/{part}", *shape, color=color, flat_shading=True)
                self._carried[key] = node
            self._carried[key].wxyz = wxyz_of(turn)
            self._carried[key].position = self.place(turn @ self.origin + carried.pose[:3, 3])

    def see_through(self, wanted: bool) -> None:
        """Make the parts transparent, so that arrows inside them are visible, or opaque again."""
        opacity = 0.4 if wanted else None
        if opacity == self._opacity:
            return
        self._opacity = opacity
        for name, (_, nodes) in self.nodes.items():
            if name.startswith("/parts/") and name != "/parts/pale":
                nodes[0].opacity = opacity

    @property
    def node_count(self) -> int:
        """Number of nodes that the browser currently draws."""
        return len(self.shown) + len(self._ghosts) + len(self._arms) + len(self._carried)

    def _merge(self, name: str, parts: Sequence[int]) -> int:
        key = np.asarray(parts, dtype=np.int32).tobytes() + self._cut_of(parts)
        if not self._fresh(name, key):
            return 0
        shapes = [self._shape(part) for part in parts]
        vertices, faces = joined_faces([points for points, _, _ in shapes], [faces for _, faces, _ in shapes])
        missing, pale, standing = name == "/parts/missing", name == "/parts/pale", name.startswith("/parts/standing")
        digits = MISSING if missing else INSTALLED if standing or pale else f"#{name[-6:]}"
        node = self._scene.add_mesh_simple(
            name, vertices, faces.astype(np.uint32), color=rgb(digits), flat_shading=not missing, wireframe=missing,
            opacity=_PALE if pale else self._opacity, cast_shadow=not (missing or pale),
        )  # fmt: skip
        nodes = [node]
        if self._lined and not (missing or pale):
            lines = np.concatenate([edges for _, _, edges in shapes])
            nodes.append(
                self._scene.add_line_segments(f"/edges{name}", lines, rgb(INK), thickness=1.4, thickness_units="screen")
            )
        self._keep(name, key, *nodes)
        return 1

    def _cut_of(self, parts: Sequence[int]) -> bytes:
        """Return what distinguishes the meshes of parts under this section from whole ones; empty if nothing does."""
        plane = self._plane
        if plane is None or not any(self._crosses(part, plane) for part in parts):
            return b""
        return repr(plane).encode()

    def _crosses(self, part: int, plane: Plane) -> bool:
        heights = plane.heights(self.assembly.meshes[part].bounds)
        return bool(heights.min() < 0 < heights.max())

    def _shape(self, part: int) -> tuple[Any, Any, Any]:
        """Return vertices, faces and sharp edges of a part as the section leaves them."""
        plane = self._plane
        if plane is None or not self._crosses(part, plane):
            return self._vertices[part], self._faces[part], self._edges[part]
        if part not in self._cut:
            here = Plane(plane.axis, (plane.at - self.origin[plane.column]) * self.scale, plane.keeps_high)
            points, faces = cut(self._vertices[part].astype(float), self._faces[part].astype(np.int64), here)
            vertices, triangles = points.astype(np.float32), faces.astype(np.uint32)
            self._cut[part] = vertices, triangles, sharp_edges(vertices, triangles)
        return self._cut[part]

    def _show_ghosts(self, appearance: Appearance) -> int:
        sent = 0
        wanted = set(appearance.ghosts.tolist())
        for part in [part for part in self._ghosts if part not in wanted]:
            self._ghosts.pop(part)[1].remove()
        for part in wanted:
            color = appearance.color[part].tobytes() + self._cut_of([part])
            position, turn = self.pose(appearance, part)
            opacity = float(appearance.opacity[part])
            opacity = None if opacity >= 1 else opacity
            known = self._ghosts.get(part)
            if known is None or known[0] != color:
                vertices, faces, edges = self._shape(part)
                node = self._scene.add_mesh_simple(
                    f"/ghosts/{part}", vertices, faces,
                    color=tuple(int(channel) for channel in appearance.color[part]), flat_shading=True,
                    opacity=opacity, position=position, wxyz=turn, cast_shadow=False,
                )  # fmt: skip
                self._ghosts[part] = (color, node)
                sent += 1
                if self._lined:
                    self._scene.add_line_segments(
                        f"/ghosts/{part}/edges", edges, rgb(INK), thickness=1.4, thickness_units="screen"
                    )
            else:
                known[1].position, known[1].wxyz = position, turn
                known[1].opacity = opacity
        return sent

    def _show_labels(self, appearance: Appearance, labels: Mapping[int, str]) -> None:
        for part in [part for part in self._labels if labels.get(part) != self._labels[part][0]]:
            self._labels.pop(part)[1].remove()
        for part, words in labels.items():
            at = self.place(appearance.moved(part, self.assembly.mass.center[part]))
            if part not in self._labels:
                self._labels[part] = (words, self._scene.add_label(f"/labels/{part}", printable(words), position=at))
            elif not np.allclose(self._labels[part][1].position, at):
                self._labels[part][1].position = at

    def _fresh(self, name: str, key: bytes) -> bool:
        """Return whether a node must be sent; one that is only hidden is shown again."""
        if self.shown.get(name) == key:
            return False
        if name in self.nodes and self.nodes[name][0] == key:
            for node in self.nodes[name][1]:
                node.visible = True
            self.shown[name] = key
            return False
        return True

    def _keep(self, name: str, key: bytes, *nodes: Any) -> None:
        self.shown[name] = key
        self.nodes[name] = (key, nodes)

    def _hide(self, name: str) -> None:
        if name in self.shown:
            del self.shown[name]
            for node in self.nodes[name][1]:
                node.visible = False


def link_node(scene: Any, name: str, link: Link, size: float = 1.0) -> Any:
    """Add a piece of a robot to a scene, in lengths of it, and return its node."""
    vertices, faces = (link.vertices * size).astype(np.float32), link.faces.astype(np.uint32)
    return scene.add_mesh_simple(name, vertices, faces, color=bytes_of(link.color), flat_shading=True)


def sharp_edges(vertices: NDArray[np.float32], faces: NDArray[np.uint32]) -> NDArray[np.float32]:
    """Return edges of a mesh with an angle between their faces, shape (edges, 2, 3).

    Args:
        vertices: shape (vertices, 3); coinciding vertices count as one.
    """
    points, same = np.unique(np.round(vertices, 5), axis=0, return_inverse=True)
    corners = same.reshape(-1)[faces.astype(np.int64)]
    normals, solid = unit_normals(points[corners].astype(float))
    corners = corners[solid]
    pairs = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
    owner = np.tile(np.arange(len(corners)), 3)
    ends, index = np.unique(np.sort(pairs, axis=1), axis=0, return_inverse=True)
    index = index.reshape(-1)
    order = np.argsort(index, kind="stable")
    first = np.searchsorted(index[order], np.arange(len(ends)))
    count = np.diff(np.append(first, len(index)))
    one = owner[order[first]]
    other = owner[order[np.minimum(first + 1, len(order) - 1)]]
    sharp = (count != 2) | ((normals[one] * normals[other]).sum(axis=1) < _SHARP)
    return points[ends[sharp]].astype(np.float32)
