"""Plan as one HTML file that plays without a server: viser's client with a recorded scene in it.

A second of the recording is a step, or a second of the motions of arms, so that the time below the scene is the step.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from falsework.errors import InputError
from falsework.search.problem.task import Direction
from falsework.utils.files.formats import Exporter, writer_of
from falsework.utils.files.output_file import write_whole
from falsework.utils.files.printable import printable
from falsework.utils.quantity import counted
from falsework.viewer.appearance import Appearance
from falsework.viewer.arrows import Arrows, arrows_of_step
from falsework.viewer.page.page_text import labels_of, legend_text
from falsework.viewer.page.scene import ViserScene
from falsework.viewer.page.stage import set_stage
from falsework.viewer.page.step_list import step_list
from falsework.viewer.page.viewer_state import ViewerState
from falsework.viewer.palette import INK, rgb
from falsework.viewer.pictures.contact_sheet import caption
from falsework.viewer.pictures.video import frame_times
from falsework.viewer.section import Plane
from falsework.viewer.web.content_policy import policy_of
from falsework.viewer.web.markup import html_text
from falsework.viewer.web.origin_guard import OriginGuard, import_viser, start_server, unannounced

if TYPE_CHECKING:
    from falsework.assembly.model import Assembly
    from falsework.robots.cells.cell_file import AnyCell
    from falsework.robots.plans.robot_plan import RobotPlan
    from falsework.search.plans.plan import Plan
    from falsework.viewer.timeline import Timeline
    from falsework.viewer.viewable import Viewable

FRAMES = 8.0
"""Pictures a second of a recording."""
_LONG = 2400
"""Pictures above which there are fewer a second."""
_PANEL = (
    "position:fixed;right:3em;top:0.6em;z-index:5;max-width:min(22em,calc(100vw - 1.2em));max-height:calc(100vh - 6em);"
    "overflow:auto;background:rgba(255,255,255,0.9);border:1px solid #ccc;border-radius:4px;padding:0.4em 0.7em;"
    f"font:14px sans-serif;color:{INK}"
)
_UPRIGHT = """<style>@media (max-aspect-ratio: 3/4) {
#root { height: 110vw !important; }
.falsework-panel { top: 112vw !important; left: 0; right: 0 !important; max-width: none !important;
max-height: calc(100vh - 113vw) !important; }
}</style>"""
"""On a phone held upright the scene is about as high as wide, so that all of it is seen, and the list below it."""


class RecordedScene(ViserScene):
    """Scene with one node a part: a step then changes a few properties, and each mesh is in the file once.

    What is not seen is removed, since viser's player, when it goes back, shows hidden nodes that it makes again.
    """

    def __init__(self, scene: Any, timeline: Timeline) -> None:
        """Begin without parts."""
        super().__init__(scene, timeline)
        parts = self.assembly.part_count
        self._opacities = np.zeros(parts)
        self._colors = np.zeros((parts, 3), dtype=np.uint8)
        self._poses = np.zeros((parts, 12))
        self._parts: dict[int, Any] = {}

    def show(
        self,
        appearance: Appearance,
        *,
        missing: Iterable[int] = (),
        pale: Iterable[int] = (),
        labels: Mapping[int, str] | None = None,
        plane: Plane | None = None,
    ) -> int:
        """Update the parts; see `ViserScene.show`, but nothing is missing, pale or cut in a recording."""
        before, now = self._opacities, appearance.opacity
        dyed = (appearance.color != self._colors).any(axis=1)
        poses = np.concatenate([appearance.shift, appearance.turn.reshape(-1, 9)], axis=1)
        shifted = (poses != self._poses).any(axis=1)
        changed = np.flatnonzero((now != before) | ((now > 0) & (dyed | shifted)))
        for part in changed.tolist():
            if now[part] == 0:
                self._parts.pop(part).remove()
                continue
            color = tuple(appearance.color[part].tolist())
            position, turn = self.pose(appearance, part)
            opacity = None if now[part] >= 1 else round(float(now[part]), 3)
            node = self._parts.get(part)
            if node is None:
                self._parts[part] = self._part(part, color, opacity, position, turn)
                continue
            if dyed[part]:
                node.color = color
            if shifted[part]:
                node.position, node.wxyz = position, turn
            node.opacity = opacity
        seen = changed[now[changed] > 0]
        self._colors[seen], self._poses[seen] = appearance.color[seen], poses[seen]
        self._opacities = now.copy()
        self._show_labels(appearance, labels or {})
        return len(changed)

    def _part(
        self,
        part: int,
        color: tuple[int, ...],
        opacity: float | None,
        position: NDArray[np.float64],
        turn: tuple[float, float, float, float],
    ) -> Any:
        name = f"/parts/{part}"
        node = self._scene.add_mesh_simple(
            name, self._vertices[part], self._faces[part], color=color, opacity=opacity, position=position,
            wxyz=turn, flat_shading=True,
        )  # fmt: skip
        if self._lined:
            edges = self._edges[part]
            self._scene.add_line_segments(f"{name}/edges", edges, rgb(INK), thickness=1.4, thickness_units="screen")
        return node

    def _hide(self, name: str) -> None:
        if name in self.shown:
            del self.shown[name]
            for node in self.nodes.pop(name)[1]:
                node.remove()


class _NoVisitors(OriginGuard):
    """Guard of a server that exists only while a file is written."""

    def refusal(self, hosts: list[str], origins: list[str]) -> str | None:
        """Refuse everybody."""
        return "a file is being written here"


def record(shown: Viewable | ViewerState) -> str:
    """Return a page that plays what is viewable, in the order of assembly."""
    viser = import_viser()
    arms = None if shown.arms is None else shown.arms.turned(Direction.ASSEMBLY)
    model = ViewerState(shown.timeline.turned(Direction.ASSEMBLY), plan=shown.plan, arms=arms)
    # viser has no scene without a server: this one accepts no clients and ends with the recording.
    server = start_server(viser, "127.0.0.1", 0, _NoVisitors("127.0.0.1"))
    try:
        scene = RecordedScene(server.scene, model.timeline)
        set_stage(server, scene, model.arms, aside=False)
        model.go_to_reading(0.0)
        title = server.scene.add_label(
            "/caption", "", position=(0.0, 0.0, 1.12 * scene.height + 0.1), anchor="bottom-center",
        )  # fmt: skip
        arrows = _frame(model, scene, title)
        recorded = server.get_scene_serializer()
        # A power of two, so that sums of its inverse are exact and the time shows steps.
        rate = FRAMES
        while rate > 1 and model.last_reading * rate > _LONG:
            rate /= 2
        readings = frame_times(model.last_reading, rate, 1.0)[1:]
        for reading in readings:
            recorded.insert_sleep(1 / rate)
            model.go_to_reading(reading)
            _frame(model, scene, title)
        if len(readings):
            recorded.insert_sleep(1.0)  # a moment with the last state, before it begins anew
        page = recorded.as_html()
    finally:
        with unannounced():
            server.stop()
    policy = f'<meta http-equiv="Content-Security-Policy" content="{policy_of(page)}">'
    name = f"<title>{html_text(model.assembly.name)}</title>"
    head, body = page.replace("<title>Viser</title>", name, 1).split("</head>", 1)
    # The policy must come before the scripts.
    head = head.replace('<meta charset="utf-8" />', f'<meta charset="utf-8" />{policy}', 1)
    return f"{head}</head>{body.replace('</body>', f'{_panel(model, arrows)}</body>', 1)}"


def save_page(shown: Viewable | ViewerState, path: Path | str) -> None:
    """Write what is viewable as one HTML file."""
    if Path(path).suffix.lower() != ".html":
        raise InputError(f"{path}: a page is written as .html; name such a file")
    page = record(shown)
    write_whole(path, lambda file: file.write(page.encode("utf-8")))


def _frame(model: ViewerState, scene: RecordedScene, title: Any) -> dict[str, Arrows]:
    """Update the scene to the present reading, and return the arrows in it."""
    appearance = model.appearance()
    scene.show(appearance, labels=labels_of(model, appearance))
    scene.show_arms(model.arms, model.arm_poses())
    arrows = arrows_of_step(model.timeline, model.step)
    moved, words = {}, ""
    if len(model.timeline) == 0:
        proof = model.proof()
        if not proof.stable:
            arrows |= {kind: some for kind, some in proof.arrows.items() if kind in ("motion", "sliding")}
            moved = proof.moved
        scene.show_arrows(arrows, moved, proof.motion_color)
        words = f"{model.assembly.name}: {proof.words}"
    else:
        scene.show_arrows(arrows, {})
        words = caption(model.timeline, model.step)
    if title.text != printable(words):
        title.text = printable(words)
    return arrows


def _panel(model: ViewerState, shown: dict[str, Arrows]) -> str:
    steps = len(model.timeline)
    about = counted(model.assembly.part_count, "part") + (f", {counted(steps, 'step')}" if steps else "")
    inside = legend_text(model, shown) + (step_list(model.timeline) if steps else "")
    return (
        f"{_UPRIGHT}<div class='falsework-panel' style='{_PANEL}'>"
        f"<details><summary><b>{html_text(model.assembly.name)}</b>, {about}</summary>"
        f"{inside}</details></div>"
    )


def _page_of(assembly: Assembly, plan: Plan | RobotPlan | None = None, *, cell: AnyCell | None = None) -> str:
    from falsework.viewer.viewable import viewable_of

    return record(viewable_of(assembly if plan is None else plan, None if plan is None else assembly, cell=cell))


_SHOWN = ("Assembly", "Plan", "RobotPlan")
EXPORTER = Exporter(writer_of(_page_of), (".html",), _SHOWN, ("cell",), complete=True)
