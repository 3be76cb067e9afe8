"""Interactive page: the viser scene and its controls; all decisions are in the viewer state."""

from __future__ import annotations

import contextlib
import io
import threading
import time
from collections.abc import Callable, Iterable
from typing import Any, Protocol

import numpy as np

from falsework.errors import DependencyError, FalseworkError, InputError
from falsework.search.problem.task import Direction
from falsework.utils.files.printable import printable
from falsework.viewer.appearance import bounds_of
from falsework.viewer.arms import bounds_with_arms
from falsework.viewer.arrows import KINDS, PRESSES, Arrows, arrows_of_step
from falsework.viewer.margin_strip import margin_strip
from falsework.viewer.page.disruption import ClickMode
from falsework.viewer.page.gantt_strip import GanttStrip
from falsework.viewer.page.graph_tab import add_graph_tab
from falsework.viewer.page.markup import markdown_text
from falsework.viewer.page.origin_guard import LOCAL, WILDCARDS, OriginGuard, start_server
from falsework.viewer.page.page_text import about_text, legend_text, marked_text, where_text
from falsework.viewer.page.scene import SIZE, ViserScene
from falsework.viewer.page.viewer_state import ViewerState

FRAMES = 15.0
"""Frames per second while a plan is played."""
NO_MORE_THAN = 400
"""Largest number of robots in the input field."""
_TOGGLES = {"motion": "Motion, where unstable", "sliding": "Motion, where it slides"}
_GONE = """<span class="falsework-alive"></span><style>
body:has(div[style*="pointer-events: none"] .falsework-alive)::before {
  content: "The server has stopped. This is its last view; start falsework view again, and this page reconnects.";
  position: fixed; left: 1em; bottom: 1em; z-index: 10000; max-width: 28em; padding: 0.8em 1.2em;
  background: #b2182b; color: white; font: 15px sans-serif; border-radius: 4px;
}</style>"""
"""Shown by the style sheet alone: viser only disables the controls when it loses the server."""


def import_viser() -> Any:
    """Return the package that serves the page.

    Raises:
        DependencyError: it is not installed.
    """
    try:
        import viser
    except ImportError:
        raise DependencyError("the page needs viser; install it with pip install 'falsework[viewer]'") from None
    return viser


class Page:
    """Browser page of one model, shared by all clients."""

    def __init__(
        self, model: ViewerState, *, host: str = "127.0.0.1", port: int = 8080, allowed_hosts: Iterable[str] = ()
    ) -> None:
        """Start the server.

        Args:
            model: state of the viewer.
            host: address to listen at.
            port: port to listen at; if it is in use, the next free one.
            allowed_hosts: names other than `host` under which browsers may open the page.

        Raises:
            DependencyError: viser is not installed.
            InputError: the address cannot be listened at.
        """
        viser = import_viser()
        try:
            self.server = start_server(viser, host, port, OriginGuard(host, allowed_hosts))
        except OSError as error:
            raise InputError(f"cannot listen at {host} port {port} ({error.strerror}); choose another") from None
        self.model = model
        self.host = host
        self._lock = threading.RLock()
        self._stop = threading.Event()
        self._playing = threading.Event()
        self._quiet = False
        self.scene = ViserScene(self.server.scene, model.timeline)
        self._arrange()
        self._controls()
        self.server.scene.on_click()(self._clicked)
        self._player = threading.Thread(target=self._play, name="falsework-player", daemon=True)
        self._player.start()
        self._set_slider()
        self.refresh()

    @property
    def port(self) -> int:
        """Port of the page."""
        return int(self.server.get_port())

    @property
    def address(self) -> str:
        """Address to open in a browser."""
        name = "localhost" if self.host in (*LOCAL, *WILDCARDS) else self.host
        return f"http://{name}:{self.port}"

    def close(self) -> None:
        """Stop serving."""
        self._stop.set()
        self._playing.set()
        self._player.join(timeout=5)
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()

    def wait(self) -> None:
        """Serve until interrupted."""
        while not self._stop.wait(1.0):
            pass

    def refresh(self) -> None:
        """Update scene and texts from the model."""
        with self._lock, self.server.atomic():
            self._show_proof()
            self._say()
            self._draw()  # marks sliding parts, if one of the calls above requested the proof

    def _draw(self) -> None:
        model = self.model
        appearance = model.appearance()
        self.scene.show(appearance, missing=model.disruption.missing, pale=model.pale, labels=model.labels(appearance))
        self.scene.show_arms(model.arms, model.arm_poses())
        self._gantt.show(model.arms, model.seconds)

    # Elements of the page.

    def _arrange(self) -> None:
        gui, scene = self.server.gui, self.server.scene
        gui.configure_theme(show_logo=False, show_share_button=False, control_width="large", brand_color=(0, 114, 178))
        gui.set_panel_label(f"falsework: {printable(self.model.assembly.name)}")
        scene.set_up_direction("+z")
        scene.configure_environment_map(None)
        scene.configure_default_lights(enabled=True, cast_shadow=self.model.assembly.part_count <= 400)
        scene.world_axes.visible = False
        scene.add_grid(
            "/floor", 3 * SIZE, 3 * SIZE, position=(0.0, 0.0, -0.002 * SIZE), cell_color=(228, 229, 231),
            section_color=(210, 212, 215), infinite_grid=False,
        )  # fmt: skip
        scene.add_light_ambient("/ambient", color=(255, 255, 255), intensity=0.85)
        # Slightly right of the centre, since the controls cover the right of the window.
        aside = np.array([0.80, 0.60, 0.0]) * 0.17 * SIZE
        middle = np.array([0.0, 0.0, 0.42 * self.scene.height])
        camera = self.server.initial_camera
        far = 1.0
        if self.model.arms is not None:  # arms reach beyond the structure
            box = bounds_with_arms(self.model.arms, bounds_of(self.model.assembly))
            far = max(0.8 * float(np.linalg.norm(np.ptp(box, axis=0))) * self.scene.scale / SIZE, 1.0)
        camera.position = np.array([0.97, -1.30, 0.86]) * far * SIZE + middle + aside * far
        camera.look_at = middle + aside * far
        camera.fov = np.radians(36.0)
        gui.add_html(_GONE)

    def _controls(self) -> None:
        gui, model = self.server.gui, self.model
        self._where = gui.add_markdown("")
        steps = len(model.timeline)
        self._slider = gui.add_slider("Step", min=0.0, max=1.0, step=1.0, initial_value=0.0)
        self._slider.on_update(lambda event: self._guard(event, self._moved))
        self._gantt = GanttStrip(gui)
        self._margins = gui.add_html("")
        with gui.add_folder("Play"):
            self._play_button = gui.add_button("Play", disabled=steps == 0)
            self._play_button.on_click(lambda event: self._guard(event, self._toggle_play))
            speed = 2.0 if model.arms is None else 0.5 if model.clock is None else 1.0
            self._speed = gui.add_slider("Steps per second", min=0.5, max=8.0, step=0.5, initial_value=speed)
            words = {Direction.ASSEMBLY: "assembly", Direction.DISASSEMBLY: "disassembly"}
            self._order = gui.add_dropdown("Order", tuple(words.values()), initial_value=words[model.direction])
            self._order.on_update(lambda event: self._guard(event, self._turned))
        tabs = gui.add_tab_group()
        with tabs.add_tab("Look"):
            self._toggles = {}
            for kind in KINDS:
                name = _TOGGLES.get(kind, kind.capitalize())
                self._toggles[kind] = gui.add_checkbox(name, initial_value=kind == PRESSES)
                self._toggles[kind].on_update(lambda event: self._guard(event, self.refresh))
            if model.policy is not None:
                self._chances = gui.add_checkbox("Probabilities of the policy", initial_value=model.show_probabilities)
                self._chances.on_update(lambda event: self._guard(event, self._chances_changed))
            self._about = gui.add_html("")
            self._legend = gui.add_html("")
        with tabs.add_tab("Disrupt"):
            self._tool = gui.add_dropdown(
                "A click will", tuple(str(tool) for tool in ClickMode), initial_value=str(ClickMode.LOOK)
            )
            self._tool.on_update(lambda event: self._guard(event, self._tool_changed))
            self._robots = gui.add_number("Robots", model.disruption.robots, min=1, max=NO_MORE_THAN, step=1)
            self._robots.on_update(lambda event: self._guard(event, self._robots_changed))
            self._marked = gui.add_markdown("")
            self._replan_button = gui.add_button("Replan", color=(0, 114, 178))
            self._replan_button.on_click(lambda event: self._guard(event, self._replan))
            self._clear = gui.add_button("Clear marks")
            self._clear.on_click(lambda event: self._guard(event, self._cleared))
            self._back = gui.add_button("Back to the previous plan", disabled=True)
            self._back.on_click(lambda event: self._guard(event, self._go_back))
            self._answer = gui.add_markdown("")
        if model.graph is not None:
            with tabs.add_tab("Graph"):
                add_graph_tab(gui, model, self._guard)

    # Handlers of the controls.

    def _guard(self, event: Any, act: Callable[[], object]) -> None:
        """Run an action, and report an error in one line; the page continues."""
        if self._quiet:
            return
        try:
            act()
        except FalseworkError as error:
            text = printable(" ".join(str(error).split()))
            self._answer.content = f"**{markdown_text(text)}**"
            client = getattr(event, "client", None)
            if client is not None:
                client.add_notification("Request failed", text, color="orange", auto_close_seconds=8.0)

    def _clicked(self, event: Any) -> None:
        origin, direction = self.scene.ray(event.ray_origin, event.ray_direction)

        def act() -> None:
            self.model.click(origin, direction)
            self.refresh()

        self._guard(event, act)

    def _moved(self) -> None:
        self.model.go_to_reading(self._slider.value)
        self.refresh()

    def _turned(self) -> None:
        self.model.turn(Direction(self._order.value))
        self._set_slider()
        self.refresh()

    def _toggle_play(self) -> None:
        if self._playing.is_set():
            self._playing.clear()
        else:
            if self.model.reading >= self.model.last_reading:
                self.model.go_to(0)
            self._playing.set()
        self._play_button.label = "Pause" if self._playing.is_set() else "Play"

    def _tool_changed(self) -> None:
        self.model.tool = ClickMode(self._tool.value)
        self.refresh()

    def _robots_changed(self) -> None:
        self.model.set_robots(int(self._robots.value))
        self.refresh()

    def _chances_changed(self) -> None:
        self.model.show_probabilities = bool(self._chances.value)
        self.refresh()

    def _cleared(self) -> None:
        self.model.clear_marks()
        self._answer.content = ""
        self.refresh()

    def _replan(self) -> None:
        self._playing.clear()
        self._play_button.label = "Play"
        self._replan_button.disabled = True
        self._answer.content = "planning ..."
        try:
            answer = self.model.replan()
            self._answer.content = markdown_text(answer.words)
            self._plan_changed()
        finally:
            self._replan_button.disabled = False

    def _go_back(self) -> None:
        self.model.go_back()
        self._answer.content = "This is the previous plan."
        self._plan_changed()

    def _plan_changed(self) -> None:
        self.scene.order(self.model.timeline)
        self._back.disabled = not self.model.can_go_back
        self._quiet = True
        try:
            self._order.value = self.model.direction.value
        finally:
            self._quiet = False
        self._set_slider()
        self.refresh()

    def _set_slider(self) -> None:
        """Update the slider: steps, or seconds of a schedule."""
        model, slider = self.model, self._slider
        unit, step = ("Step", 1) if model.clock is None else ("Seconds", 0.1)
        self._quiet = True
        try:
            if slider.label != unit:
                slider.label, slider.step, slider.precision = unit, step, int(step < 1)
                self._speed.label = "Steps per second" if model.clock is None else "Seconds per second"
            slider.max = max(np.ceil(model.last_reading / step) * step, 1)
            slider.disabled = self._play_button.disabled = len(model.timeline) == 0
            slider.value = min(round(model.reading / step) * step, slider.max)
        finally:
            self._quiet = False

    def _play(self) -> None:
        while not self._stop.is_set():
            if not self._playing.wait(0.5) or self._stop.is_set():
                continue
            begun = time.perf_counter()
            model = self.model
            before = int(model.position)
            model.go_to_reading(model.reading + float(self._speed.value) / FRAMES)
            if int(model.position) != before or model.clock is not None:
                self._set_slider()
            if int(model.position) != before:
                self.refresh()
            else:
                with self._lock, self.server.atomic():
                    if model.clock is not None:  # the text shows the time
                        self._where.content = where_text(model, ask=bool(self._shown()))
                    self._draw()
            if model.reading >= model.last_reading:
                self._playing.clear()
                self._play_button.label = "Play"
            time.sleep(max(1 / FRAMES - (time.perf_counter() - begun), 0.005))

    # Texts.

    def _shown(self) -> list[str]:
        """Return the kinds of arrows that belong to a proof and are chosen."""
        return [kind for kind, toggle in self._toggles.items() if toggle.value and kind != PRESSES]

    def _presses(self) -> dict[str, Arrows]:
        """Return the arrows of the present step, if they are chosen and its state is not marked otherwise."""
        model = self.model
        shown = self._toggles[PRESSES].value and model.disruption.empty
        return arrows_of_step(model.timeline, model.step) if shown else {}

    def _show_proof(self) -> None:
        kinds, presses = self._shown(), self._presses()
        if not kinds:
            self.scene.show_arrows(presses, {})
            self.scene.see_through(bool(presses))
            return
        proof = self.model.proof()
        if presses:
            kinds.append(PRESSES)
        chosen = presses | {kind: some for kind, some in proof.arrows.items() if kind in kinds}
        self.scene.see_through(bool(chosen))
        moved = proof.moved if ("sliding" if proof.slides else "motion") in kinds else {}
        self.scene.show_arrows(chosen, moved, proof.motion_color)

    def _say(self) -> None:
        model, shown = self.model, [*self._shown(), *self._presses()]
        self._where.content = where_text(model, ask=bool(self._shown()))
        self._marked.content = marked_text(model)
        self._margins.content = margin_strip(
            model.plan, model.direction, round(model.position) if model.clock is None else model.step
        )
        self._about.content = about_text(model)
        self._legend.content = legend_text(model, shown)


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
