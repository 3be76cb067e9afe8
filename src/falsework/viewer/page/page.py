"""Interactive page: the viser scene and its controls; all decisions are in the viewer state."""

from __future__ import annotations

import contextlib
import html
import io
import re
import threading
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from falsework.errors import FalseworkError, InputError
from falsework.utils.files.printable import printable
from falsework.viewer.page.files_tab import FilesTab
from falsework.viewer.page.graph_tab import add_graph_tab
from falsework.viewer.page.look_tab import LookTab
from falsework.viewer.page.page_text import labels_of
from falsework.viewer.page.play_panel import PlayPanel
from falsework.viewer.page.recording import record, save_page
from falsework.viewer.page.scene import ViserScene
from falsework.viewer.page.site_tab import SiteTab
from falsework.viewer.page.stage import NARROW, aim_upright, set_stage
from falsework.viewer.page.step_list import StepsTab
from falsework.viewer.page.viewer_state import ViewerState
from falsework.viewer.web.links import Unit
from falsework.viewer.web.markup import markdown_text
from falsework.viewer.web.origin_guard import LOCAL, WILDCARDS, OriginGuard, import_viser, start_server

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


class Page:
    """Browser page of one model, shared by all clients."""

    def __init__(
        self, model: ViewerState, *, host: str = "127.0.0.1", port: int = 8080, allowed_hosts: Iterable[str] = ()
    ) -> None:
        """Start the server.

        Args:
            port: port to listen at; if it is in use, the next free one.
            allowed_hosts: names other than `host` under which browsers may open the page.

        Raises:
            DependencyError: viser is not installed.
            InputError: the address cannot be listened at.
        """
        viser = import_viser()
        self._lock = threading.RLock()
        self._stop = threading.Event()
        self._quiet = False
        self.host = host
        try:
            self.server = start_server(viser, host, port, OriginGuard(host, allowed_hosts), go=self._linked)
        except OSError as error:
            raise InputError(f"cannot listen at {host} port {port} ({error.strerror}); choose another") from None
        self._fill(model)
        self.server.scene.on_click()(self._clicked)
        self.server.on_client_connect(self._connected)

    @property
    def port(self) -> int:
        """Port of the page."""
        return int(self.server.get_port())

    @property
    def address(self) -> str:
        """Address to open in a browser."""
        name = "localhost" if self.host in (*LOCAL, *WILDCARDS) else self.host
        return f"http://{name}:{self.port}"

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
        """Stop serving."""
        self._stop.set()
        self.play.close()
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()

    def wait(self) -> None:
        """Serve until interrupted."""
        while not self._stop.wait(1.0):
            pass

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

    @contextlib.contextmanager
    def quiet(self) -> Iterator[None]:
        """Change controls without handling their events."""
        before, self._quiet = self._quiet, True
        try:
            yield
        finally:
            self._quiet = before

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

    def _fill(self, model: ViewerState) -> None:
        gui = self.server.gui
        self.model = model
        gui.configure_theme(show_logo=False, show_share_button=False, control_width="large", brand_color=(0, 114, 178))
        gui.set_panel_label(f"falsework: {printable(model.assembly.name)}")
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


def check_host(host: str) -> str | None:
    """Return a warning if others can reach the page, None if not.

    Raises:
        InputError: the host is empty.
    """
    if not host.strip():
        raise InputError("--host is empty; leave it out to serve this machine alone")
    if host in LOCAL:
        return None
    return f"every client that can reach {host} can see and control this page; there is no password"


class Served(Protocol):
    """Page that is being served."""

    def wait(self) -> None:
        """Serve until interrupted."""

    def close(self) -> None:
        """Stop serving."""


def serve(page: Served) -> None:
    """Serve until interrupted by the keyboard."""
    with contextlib.suppress(KeyboardInterrupt):
        page.wait()
    with contextlib.suppress(KeyboardInterrupt):  # a second Ctrl-C
        page.close()
