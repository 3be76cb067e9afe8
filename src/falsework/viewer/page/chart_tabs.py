"""Tabs of the page with charts: the state graph and its coverage by the policy, joints and clearance of arms."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from falsework.viewer.page.viewer_state import ViewerState

if TYPE_CHECKING:
    from falsework.viewer.arms import Arms
    from falsework.viewer.page.host import Host


class PlotsTab:
    """Tab with joints and clearance of the arms over time; nothing is shown while the plan has no arms."""

    def __init__(self, gui: Any, page: Host) -> None:
        """Fill the tab."""
        self._page = page
        self._arms: Arms | None = None
        self._joints = gui.add_html("")
        self._button = gui.add_button(
            "Clearance", hint="Distance of each arm to other bodies over time; takes seconds."
        )
        self._button.on_click(lambda event: page.guard(event, self._measure))
        self._clearance = gui.add_html("")

    def update(self) -> None:
        """Show the plots of the arms, if they have changed."""
        from falsework.viewer.plot_svg import joint_plots

        arms = self._page.model.arms
        if arms is not self._arms:
            self._arms = arms
            self._joints.content = "" if arms is None else joint_plots(arms.plan, arms.cell)
            self._clearance.content, self._button.visible = "", arms is not None

    def _measure(self) -> None:
        from falsework.robots.checks.clearance import clearances
        from falsework.robots.model.part_shapes import place_parts
        from falsework.viewer.plot_svg import CLEARANCE, CLEARANCE_TIMES, clearance_plot

        arms = self._arms
        if arms is None:
            return
        times = np.linspace(0.0, arms.plan.makespan, CLEARANCE_TIMES)
        parts = place_parts(self._page.model.assembly, arms.cell.placement)
        found = clearances(arms.plan, arms.cell, parts, times, within=CLEARANCE)
        self._clearance.content = clearance_plot(arms.plan, times, found)


def add_graph_tab(gui: Any, model: ViewerState, guard: Callable[[Any, Callable[[], object]], None]) -> None:
    """Fill the tab."""
    graph = model.graph
    assert graph is not None
    gui.add_markdown(
        f"{len(graph)} states, {len(graph.source)} actions; {int((graph.solvable & graph.reachable).sum())} states "
        "lie on a complete plan."
    )
    image = gui.add_image(_graph_pixels(model, None), label="State graph", format="png")
    if model.policy is None:
        return
    cover = gui.add_button("Coverage by the policy")
    words = gui.add_markdown("")

    def show() -> None:
        from falsework.viewer.pictures.graph_picture import covered

        visited = model.visited()
        share = covered(graph, visited)
        image.image = _graph_pixels(model, visited)
        words.content = f"{int(share.sum())} of {len(graph)} states ({100 * share.mean():.1f} %)."

    cover.on_click(lambda event: guard(event, show))


def _graph_pixels(model: ViewerState, visited: Any) -> Any:
    from falsework.viewer.pictures.graph_picture import figure_pixels, graph_figure

    assert model.graph is not None
    route = model.timeline.states if len(model.timeline) else None
    return figure_pixels(graph_figure(model.graph, model.assembly, route=route, visited=visited), dpi=90)
