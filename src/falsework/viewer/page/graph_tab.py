"""Tab of the page with the state graph and its coverage by the policy."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from falsework.viewer.page.viewer_state import ViewerState


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
