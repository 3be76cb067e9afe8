"""Browser page of a cell, valid or not: arms with joint sliders, near pairs in colour, and the reach of each arm.

The page reads the files of the cell again when they change, and keeps the joint values.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.load import AnyStructure, as_assembly
from falsework.robots.cells.validate import home_text, propose_home
from falsework.robots.model.cell import Cell, CellRobot
from falsework.utils.files.printable import printable
from falsework.viewer.cells.cell_model import CellModel, build_cell_model
from falsework.viewer.cells.cell_scene import LEGEND, CellScene
from falsework.viewer.palette import MISSING, robot_color
from falsework.viewer.web.file_watch import FileWatch
from falsework.viewer.web.markup import html_text
from falsework.viewer.web.served_page import ServedPage

Array = NDArray[np.float64]

_MOST_PAIRS = 8
"""Near pairs that are listed."""


def view_cell(
    subject: Cell | str | Path,
    structure: AnyStructure | None = None,
    *,
    host: str = "127.0.0.1",
    port: int = 8080,
    allowed_hosts: Iterable[str] = (),
    **options: Any,
) -> CellPage:
    """Serve the page of a cell until `CellPage.close`.

    Args:
        subject: the cell, its file, or the name of a built-in one; it need not be valid.
        structure: structure in it.
        host: address to listen at.
        port: port to listen at; if it is in use, the next free one.
        allowed_hosts: names other than `host` under which browsers may open the page.
        options: as for `load_structure`.

    Raises:
        DependencyError: viser is not installed.
        InputError: there is no such cell or structure, or the address cannot be listened at.
    """
    loaded = None if structure is None else as_assembly(structure, **options)
    return CellPage(lambda: build_cell_model(subject, loaded), host, port, allowed_hosts)


class CellPage(ServedPage):
    """Page of one cell."""

    def __init__(self, look: Callable[[], CellModel], host: str, port: int, allowed_hosts: Iterable[str]) -> None:
        """Read the cell by `look`, which is called again when its files have changed, and start the server."""
        self.sight, self._look = look(), look
        super().__init__(host, port, allowed_hosts)
        self.configurations: list[Array] = []
        self.sliders: list[list[Any]] = []
        self.texts: list[Any] = []
        self._folders: list[Any] = []
        self._latest: dict[int, int] = {}
        self._news = ""
        self._arrange()
        self.scene = CellScene(self.server.scene, self.sight)
        self._fill({})
        self._watch = FileWatch(self._files, self._changed)

    def close(self) -> None:
        """Stop serving, and looking at the files."""
        self._watch.close()
        super().close()

    def refresh(self) -> None:
        """Update scene and texts from the joint values."""
        with self._lock, self.server.atomic():
            pairs = [] if self.sight.cell is None else self.sight.pairs(self.configurations)
            self.scene.show(self.configurations, pairs)
            said = [f"<b style='color:{MISSING}'>{html_text(fault)}</b>" for fault in self.sight.faults]
            said += [html_text(pair.words) for pair in pairs[:_MOST_PAIRS]]
            if len(pairs) > _MOST_PAIRS:
                said.append(f"and {len(pairs) - _MOST_PAIRS} more")
            if self.sight.cell is not None and not pairs:
                said.append("nothing is too near in these configurations")
            said += [html_text(self._news)] if self._news else []
            self.said.content = _block("falsework-faults", "".join(f"<div>{text}</div>" for text in said))
            for text, robot, values in zip(self.texts, self._robots, self.configurations, strict=True):
                line = f"home = {home_text(robot.model, values)}"
                text.content = _block("falsework-home", f"<code>{html_text(line)}</code>")

    def set_configuration(self, robot: int, values: Array) -> None:
        """Move an arm, and its sliders.

        Args:
            values: joint values in rad or m, shape (joints,).
        """
        with self._lock:
            self.configurations[robot] = np.array(values, dtype=float)
            shown = values / self._robots[robot].model.units
            with self.quiet():
                for slider, value in zip(self.sliders[robot], shown.tolist(), strict=True):
                    slider.value = float(np.clip(value, slider.min, slider.max))
            self.refresh()

    @property
    def _robots(self) -> tuple[CellRobot, ...]:
        return () if self.sight.cell is None else self.sight.cell.robots

    def _arrange(self) -> None:
        gui, scene = self.server.gui, self.server.scene
        self._set_theme(Path(self.sight.name).name)
        scene.set_up_direction("+z")
        scene.configure_environment_map(None)
        scene.configure_default_lights(enabled=True, cast_shadow=True)
        scene.add_light_ambient("/ambient", color=(255, 255, 255), intensity=0.7)
        cell, box = self.sight.cell, self.sight.box
        size = float(np.linalg.norm(np.ptp(box, axis=0)))
        floor = box[0, 2] if cell is None or cell.floor is None else cell.floor
        scene.add_grid(
            "/floor", 3 * size, 3 * size, position=(*box.mean(axis=0)[:2], floor - 0.002), infinite_grid=False,
            cell_size=0.1, section_size=1.0, cell_color=(228, 229, 231), section_color=(190, 193, 198),
        )  # fmt: skip
        camera = self.server.initial_camera
        middle = box.mean(axis=0)
        # Slightly right of the centre, since the controls cover the right of the window.
        aside = np.array([0.80, 0.60, 0.0]) * 0.22 * size
        camera.position = middle + np.array([0.70, -0.95, 0.55]) * size * 1.35 + aside
        camera.look_at = middle + aside
        camera.fov = np.radians(36.0)
        self.said = gui.add_html("")
        self._reach = gui.add_checkbox("Reach of the arms", initial_value=False)
        self._reach.on_update(lambda _: self.scene.show_reach(bool(self._reach.value)))
        legend = "".join(f"<span style='color:{color}'>&#9632;</span> {words} &nbsp; " for color, words in LEGEND)
        gui.add_html(_block("falsework-legend", legend))

    def _fill(self, kept: dict[tuple[str, str], float]) -> None:
        """Add a folder of sliders for each robot; joints keep their values by the names of robot and joint."""
        gui = self.server.gui
        self.configurations = []
        for number, robot in enumerate(self._robots):
            units, model = robot.model.units, robot.model
            values = np.array(
                [kept.get((robot.name, joint), home) for joint, home in zip(model.joint_names, robot.home, strict=True)]
            )
            self.configurations.append(np.clip(values, model.lower, model.upper))
            folder = gui.add_folder(f"{printable(robot.name)}: {printable(model.name)}")
            self._folders.append(folder)
            with folder:
                color = robot_color(number)
                gui.add_html(f"<div style='margin:0 1em;height:4px;background:{color}'></div>")
                sliders = []
                for joint, name in enumerate(model.joint_names):
                    step = 0.001 if model.prismatic[joint] else 0.5
                    low, start, high = (
                        round(float(values[joint] / units[joint]), 6)
                        for values in (model.lower, self.configurations[-1], model.upper)
                    )
                    low, high = np.ceil(low / step) * step, np.floor(high / step) * step
                    start = float(np.clip(round(start, 3), low, high))
                    unit = "m" if model.prismatic[joint] else "°"
                    sliders.append(gui.add_slider(f"{printable(name)}, {unit}", low, high, step, start))
                    sliders[-1].on_update(lambda _, robot=number: self.moved(robot))
                self.sliders.append(sliders)
                home = gui.add_button("Home")
                home.on_click(lambda _, robot=number: self.set_configuration(robot, self._robots[robot].home))
                propose = gui.add_button("Propose a home from here")
                propose.on_click(lambda _, robot=number: self.propose(robot))
                self.texts.append(gui.add_html(""))
        self.scene.show_reach(bool(self._reach.value))
        self.refresh()

    def moved(self, robot: int) -> None:
        """Show the configuration that the sliders of a robot have."""
        if self._quiet:
            return
        mine = self._latest[robot] = self._latest.get(robot, 0) + 1
        with self._lock:
            if mine != self._latest[robot] or robot >= len(self.sliders):
                return  # a later value of a slider waits for its turn, or the arm is no longer there
            shown = np.array([slider.value for slider in self.sliders[robot]], dtype=float)
            self.configurations[robot] = shown * self._robots[robot].model.units
            self.refresh()

    def propose(self, robot: int) -> None:
        """Put a robot where its home could be, near its present configuration."""
        cell = self.sight.cell
        assert cell is not None
        found = propose_home(_with_homes(cell, self.configurations), self.sight.parts, robot)
        if found is None:
            self._news = f"no configuration of {cell.robots[robot].name} near this one is free; move its base"
            self.refresh()
            return
        self._news = ""
        self.set_configuration(robot, found)

    def _files(self) -> list[str]:
        """Return the names of the files of the cell."""
        models = [robot.model for robot in self._robots]
        files = [self.sight.name, *(name for model in models for name in (model.source, model.srdf))]
        return [name for name in files if name]

    def _changed(self) -> None:
        try:
            self.read_again()
        except Exception as error:  # whatever is in a file that is just being written, the page goes on
            with self._lock:
                self._news = f"not read again: {' '.join(str(error).split())}"
            self.refresh()

    def read_again(self) -> None:
        """Read the cell again, and keep the joint values; a robot whose home has changed goes there."""
        sight = self._look()
        with self._lock, self.server.atomic():
            before = {robot.name: robot for robot in self._robots}
            kept = {
                (robot.name, joint): float(value)
                for robot, values in zip(self._robots, self.configurations, strict=True)
                for joint, value in zip(robot.model.joint_names, values, strict=True)
            }
            for robot in () if sight.cell is None else sight.cell.robots:
                known = before.get(robot.name)
                if known is not None and not np.array_equal(known.home, robot.home):
                    for joint in robot.model.joint_names:
                        kept.pop((robot.name, joint), None)
            for folder in self._folders:
                folder.remove()
            self.scene.remove()
            self.sliders, self.texts, self._folders = [], [], []
            self.sight = sight
            self.scene = CellScene(self.server.scene, sight)
            self._news = f"read again at {time.strftime('%H:%M:%S')}"
            self._fill(kept)


def _with_homes(cell: Cell, homes: Iterable[Array]) -> Cell:
    robots = (replace(robot, home=home) for robot, home in zip(cell.robots, homes, strict=True))
    return replace(cell, robots=tuple(robots))


def _block(name: str, content: str) -> str:
    return f"<div id='{name}' style='margin:0.5em 1em;font-size:0.85em'>{content}</div>"
