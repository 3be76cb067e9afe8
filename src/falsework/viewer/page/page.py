"""Interactive page: the viser scene and its controls; all decisions are in the viewer state."""

from __future__ import annotations

import html
import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np

from falsework.errors import FalseworkError
from falsework.utils.files.printable import printable
from falsework.viewer.page.chart_tabs import PlotsTab, add_graph_tab
from falsework.viewer.page.files_tab import FilesTab
from falsework.viewer.page.look_tab import LookTab
from falsework.viewer.page.page_text import labels_of
from falsework.viewer.page.play_panel import PlayPanel
from falsework.viewer.page.recording import record, save_page
from falsework.viewer.page.scene import ViserScene
from falsework.viewer.page.site_tab import SiteTab
from falsework.viewer.page.stage import NARROW, aim_upright, set_stage
from falsework.viewer.page.step_list import StepsTab
from falsework.viewer.page.viewer_state import ViewerState
from falsework.viewer.web.file_watch import FileWatch
from falsework.viewer.web.links import Unit
from falsework.viewer.web.markup import markdown_text
from falsework.viewer.web.served_page import ServedPage

_STYLE = """<span class="falsework-alive"></span><style>
body:has(div[style*="pointer-events: none"] .falsework-alive)::before {
  content: "The server has stopped. This is its last view; start falsework view again, and this page reconnects.";
  position: fixed; left: 1em; bottom: 1em; z-index: 10000; max-width: 28em; padding: 0.8em 1.2em;
  background: #b2182b; color: white; font: 15px sans-serif; border-radius: 4px;
}
@media (max-width: 36em) {
  div[style*="position: fixed"][style*="max-height: 60%"] { width: 100% !important; max-height: 45% !important; }
  div[style*="position: fixed"][style*="max-height: 60%"] div[style="width: 20em;"] { width: 100% !important; }
  .falsework-hint { display: none; }
}</style>"""
"""A note shown by the style sheet alone, since viser only disables the controls when it loses the server; and controls
across the lower half of a phone."""


class Page(ServedPage):
    """Browser page of one model."""

    def __init__(
        self,
        model: ViewerState,
        *,
        file: Path | None = None,
        host: str = "127.0.0.1",
        port: int = 8080,
        allowed_hosts: Iterable[str] = (),
    ) -> None:
        """Start the server, see `ServedPage`; a change of the file that the model was read from is told."""
        super().__init__(host, port, allowed_hosts, self._linked)
        self._fill(model)
        self._watch = None if file is None else FileWatch(lambda: [file], lambda: self._file_changed(file))
        self.server.scene.on_click()(self._clicked)
        self.server.on_client_connect(self._connected)

    @property
    def file_name(self) -> str:
        """Name of downloaded files, without an ending."""
        return re.sub(r"[^\w.-]+", "-", self.model.assembly.name).strip("-.") or "plan"

    @property
    def asks(self) -> bool:
        """Whether the proof of the present state is needed."""
        return self.look.asks

    def save(self, path: Path | str) -> None:
        """Write what is shown as one HTML file that plays without a server."""
        save_page(self.model, path)

    def _repr_html_(self) -> str:
        page = html.escape(record(self.model), quote=True)
        link = f'<a href="{self.address}" target="_blank">{self.address}</a>'
        return (
            f'<iframe srcdoc="{page}" width="100%" height="480" style="border:1px solid #ddd"></iframe>'
            f"<div>With all controls, as long as this process runs: {link}</div>"
        )

    def close(self) -> None:
        """Stop serving, playing, and looking at the file."""
        if self._watch is not None:
            self._watch.close()
        self.play.close()
        super().close()

    def show(self, model: ViewerState) -> None:
        """Show another model instead of the present one."""
        self.play.close()  # outside the lock, for which the player may wait
        with self._lock:
            self.server.scene.reset()
            self.server.gui.reset()
            self._fill(model)

    def refresh(self) -> None:
        """Update scene and texts from the model."""
        with self._lock, self.server.atomic():
            if self.scene.assembly is not self.model.assembly:  # with other places for props
                self.server.scene.reset()
                self._set_scene()
            self.look.update()
            self.play.update()
            self.site.update()
            if self.steps is not None:
                self.steps.update()
            if self.plots is not None:
                self.plots.update()
            self.files.update()
            self._draw()  # marks sliding parts, if one of the calls above requested the proof

    def draw(self) -> None:
        """Update what moves within a step."""
        with self._lock, self.server.atomic():
            if self.model.clock is not None:
                self.play.update()  # the slider and the text show the time
            self._draw()

    def pause(self) -> None:
        """Pause playing."""
        self.play.pause()

    def plan_changed(self, words: str) -> None:
        """Show another plan of the model, and say why, in Markdown."""
        if (self.steps is None) == (len(self.model.timeline) > 0):  # other controls are needed
            self.show(self.model)
        else:
            self.scene.order(self.model.timeline)
            self.refresh()
        self.site.say(words)

    def guard(self, event: Any, act: Callable[[], object]) -> None:
        """Run an action, and report an error in one line; the page continues."""
        if self._quiet:
            return
        try:
            act()
        except FalseworkError as error:
            text = printable(" ".join(str(error).split()))
            self.site.say(f"**{markdown_text(text)}**")
            client = getattr(event, "client", None)
            if client is not None:
                client.add_notification("Request failed", text, color="orange", auto_close_seconds=8.0)

    def _file_changed(self, file: Path) -> None:
        text = f"{printable(file.name)} has changed. The page shows it as it was; open it again in the tab Files."
        with self._lock:
            self.site.say(markdown_text(text))
        for client in self.server.get_clients().values():
            client.add_notification("File changed", text, color="orange", auto_close_seconds=8.0)

    def _fill(self, model: ViewerState) -> None:
        gui = self.server.gui
        self.model = model
        self._set_theme(model.assembly.name)
        self._set_scene()
        gui.add_html(_STYLE)
        with self.quiet():
            self.play = PlayPanel(gui, self)
            tabs = gui.add_tab_group()
            with tabs.add_tab("Look"):
                self.look = LookTab(gui, self)
            self.steps: StepsTab | None = None
            if len(model.timeline):
                with tabs.add_tab("Steps"):
                    self.steps = StepsTab(gui, self)
            self.plots: PlotsTab | None = None
            if model.arms is not None:
                with tabs.add_tab("Plots"):
                    self.plots = PlotsTab(gui, self)
            with tabs.add_tab("Disrupt"):
                self.site = SiteTab(gui, self)
            if model.graph is not None:
                with tabs.add_tab("Graph"):
                    add_graph_tab(gui, model, self.guard)
            with tabs.add_tab("Files"):
                self.files = FilesTab(gui, self)
        self.refresh()

    def _set_scene(self) -> None:
        self.scene = ViserScene(self.server.scene, self.model.timeline)
        set_stage(self.server, self.scene, self.model.arms, aside=True)

    def _draw(self) -> None:
        model, marks = self.model, self.model.disruption
        appearance = model.appearance()
        labels, plane = labels_of(model, appearance), model.view.plane(model.assembly)
        self.scene.show(appearance, missing=marks.missing, pale=model.pale, labels=labels, plane=plane)
        self.scene.show_arms(model.arms, model.arm_poses(), seen=self.look.arms)

    def _clicked(self, event: Any) -> None:
        origin, direction = self.scene.ray(event.ray_origin, event.ray_direction)

        def act() -> None:
            self.model.click(origin, direction)
            self.refresh()

        self.guard(event, act)

    def _connected(self, client: Any) -> None:
        def fit(_: Any) -> None:
            """Aim for a narrow window, whose width and first camera may arrive late, unless its user has turned."""
            camera, first = client.camera, self.server.initial_camera.position
            if camera.image_width <= NARROW and np.allclose(camera.position, first, atol=1e-3):
                aim_upright(camera, self.scene, self.model.arms, camera.aspect)

        fit(None)
        client.camera.on_update(fit)

    def _linked(self, unit: Unit, value: float) -> None:
        self.play.pause()
        if unit == "step":
            self.model.go_to(value)
        else:
            self.model.go_to_reading(value)
        self.refresh()
