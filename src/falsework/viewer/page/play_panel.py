"""Controls of the place in the plan: slider, charts below it, playback and order."""

from __future__ import annotations

import threading
import time
from typing import TYPE_CHECKING, Any

import numpy as np

from falsework.search.problem.task import Direction
from falsework.viewer.margin_strip import margin_strip
from falsework.viewer.page.gantt_svg import gantt_svg, marker_style
from falsework.viewer.page.page_text import where_text

if TYPE_CHECKING:
    from falsework.viewer.arms import Arms
    from falsework.viewer.page.host import Host

FRAMES = 15.0
"""Frames per second while a plan is played."""
_KEYS = "Space plays; N and P go to the next step and back, and so do arrow keys, which also turn the view."
_WORDS = {Direction.ASSEMBLY: "assembly", Direction.DISASSEMBLY: "disassembly"}


class PlayPanel:
    """Place in the plan. Without steps only its text is shown."""

    def __init__(self, gui: Any, page: Host) -> None:
        """Add the controls."""
        self._page = page
        model = page.model
        self.where = gui.add_markdown("")
        self.slider = gui.add_slider("Step", min=0.0, max=1.0, step=1.0, initial_value=0.0)
        self.slider.on_update(lambda event: page.guard(event, self._moved))
        self.gantt = gui.add_html("")
        self.marker = gui.add_html("")
        self._arms: Arms | None = None
        self._margins = gui.add_html("")
        self._folder = gui.add_folder("Play")
        with self._folder:
            self._button = gui.add_button("Play", hint=_KEYS)
            self._button.on_click(lambda event: page.guard(event, self.toggle))
            speed = 2.0 if model.arms is None else 1.0
            self.speed = gui.add_slider("Steps per second", min=0.5, max=8.0, step=0.5, initial_value=speed)
            self._order = gui.add_dropdown("Order", tuple(_WORDS.values()), initial_value=_WORDS[model.direction])
            self._order.on_update(lambda event: page.guard(event, self._turned))
        for key, by in (("N", 1), ("P", -1), ("arrowright", 1), ("arrowleft", -1)):
            name = "Next step" if by == 1 else "Previous step"
            gui.add_command(name, hotkey=key).on_trigger(lambda event, by=by: page.guard(event, lambda: self._step(by)))
        gui.add_command("Play or pause", hotkey="space").on_trigger(lambda event: page.guard(event, self.toggle))
        self.playing = threading.Event()
        self._stop = threading.Event()
        self._player = threading.Thread(target=self._play, name="falsework-player", daemon=True)
        self._player.start()

    def close(self) -> None:
        """End the playback."""
        self._stop.set()
        self.playing.set()
        if self._player is not threading.current_thread():
            self._player.join(timeout=5)

    def pause(self) -> None:
        """Pause playing."""
        self.playing.clear()
        self._button.label = "Play"

    def update(self) -> None:
        """Show the place of the model, and what there is to control."""
        model, slider = self._page.model, self.slider
        unit, step = ("Step", 1) if model.clock is None else ("Seconds", 0.1)
        with self._page.quiet():
            if slider.label != unit:
                slider.label, slider.step, slider.precision = unit, step, int(step < 1)
                self.speed.label = "Steps per second" if model.clock is None else "Seconds per second"
            slider.max = max(np.ceil(model.last_reading / step) * step, 1)
            slider.value = min(round(model.reading / step) * step, slider.max)
            self._order.value = _WORDS[model.direction]
        slider.visible = self._folder.visible = len(model.timeline) > 0
        place = round(model.position) if model.clock is None else model.step
        self._margins.content = margin_strip(model.plan, place, model.built)
        self.where.content = where_text(model, ask=self._page.asks)
        if model.arms is not self._arms:
            self._arms = model.arms
            self.gantt.content = "" if model.arms is None else gantt_svg(model.arms.plan)
            self.marker.content = ""
        if model.clock is not None:
            style = marker_style(model.seconds / max(model.clock.makespan, 1e-3))
            if style != self.marker.content:
                self.marker.content = style

    def _moved(self) -> None:
        self._page.model.go_to_reading(self.slider.value)
        self._page.refresh()

    def _step(self, by: int) -> None:
        model = self._page.model
        self.pause()
        model.go_to(model.step + (by if model.direction is Direction.ASSEMBLY else -by))
        self._page.refresh()

    def _turned(self) -> None:
        self._page.model.turn(Direction(self._order.value))
        self._page.refresh()

    def toggle(self) -> None:
        """Play the plan, from its beginning where it has ended, or pause."""
        model = self._page.model
        if self.playing.is_set():
            self.pause()
        elif len(model.timeline):
            if model.at_end:
                model.rewind()
            self.playing.set()
            self._button.label = "Pause"

    def _play(self) -> None:
        while not self._stop.is_set():
            if not self.playing.wait(0.5) or self._stop.is_set():
                continue
            begun = time.perf_counter()
            model = self._page.model
            before = int(model.position)
            model.advance(float(self.speed.value) / FRAMES)
            if int(model.position) != before:
                self._page.refresh()
            else:
                self._page.draw()
            if model.at_end:
                self.pause()
            time.sleep(max(1 / FRAMES - (time.perf_counter() - begun), 0.005))
