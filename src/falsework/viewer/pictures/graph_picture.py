"""Picture of a state graph: one column per step, one row per state, with the states that a policy visits."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import States
from falsework.search.problem.state_graph import StateGraph
from falsework.utils.display.fonts import fitting_fonts
from falsework.viewer.appearance import appearance_at
from falsework.viewer.palette import INK, ROBOTS
from falsework.viewer.pictures.drawing import flat_axis, outlines
from falsework.viewer.pictures.picture import figure_class
from falsework.viewer.timeline import Timeline

if TYPE_CHECKING:
    from falsework.assembly.model import Assembly

Array = NDArray[np.float64]

ICONS_UP_TO = 60
"""States up to which each is drawn as a small picture of the structure."""
_SWEEPS = 6
"""Passes in which rows are sorted by the positions of their neighbours."""
EDGE, USELESS, ROUTE, SEEN = "#b9bbbf", "#d8dadd", ROBOTS[1], ROBOTS[0]


def places_of(graph: StateGraph, sweeps: int = _SWEEPS) -> Array:
    """Return column and row of every state: columns by steps of assembly, rows ordered to reduce crossings.

    Returns:
        Shape (states, 2); rows are spread about 0.
    """
    level = graph.level
    column = level.max(initial=0) - level
    row = np.zeros(len(graph))
    members = [np.flatnonzero(column == step) for step in range(int(column.max(initial=0)) + 1)]
    for states in members:
        row[states] = np.arange(len(states)) - (len(states) - 1) / 2
    # Order each column by the mean row of its neighbours in the column before it, forwards and backwards in turn.
    for sweep in range(sweeps):
        forwards = sweep % 2 == 0
        here, there = (graph.source, graph.target) if forwards else (graph.target, graph.source)
        for states in members if forwards else members[::-1]:
            total = np.zeros(len(graph))
            count = np.zeros(len(graph))
            mine = np.isin(here, states)
            np.add.at(total, here[mine], row[there[mine]])
            np.add.at(count, here[mine], 1)
            mean = np.where(count[states] > 0, total[states] / np.maximum(count[states], 1), row[states])
            order = states[np.argsort(mean, kind="stable")]
            row[order] = np.arange(len(states)) - (len(states) - 1) / 2
    return np.stack([column.astype(float), row], axis=1)


def covered(graph: StateGraph, visited: States) -> NDArray[np.bool_]:
    """Return whether each state of a graph is among the visited ones.

    Args:
        visited: shape (count, parts), repeated or not.
    """
    seen = np.zeros(len(graph), dtype=bool)
    if len(visited):
        found = graph.index.find(np.unique(visited, axis=0))
        seen[found[found >= 0]] = True
    return seen


def graph_figure(
    graph: StateGraph,
    assembly: Assembly | None = None,
    *,
    route: States | None = None,
    visited: States | None = None,
    title: str = "",
) -> Any:
    """Return a Matplotlib figure of a state graph.

    Args:
        assembly: its structure; a graph of few states of a two-dimensional one gets small pictures of them.
        route: states of a plan, drawn as a thick line, shape (steps + 1, parts).
        visited: states that a policy visits, drawn in blue, shape (count, parts).
    """
    figure_of_size = figure_class("pictures of state graphs")
    from matplotlib import collections

    place = places_of(graph)
    useful = graph.solvable & graph.reachable
    on_route = covered(graph, route) if route is not None else np.zeros(len(graph), dtype=bool)
    seen = covered(graph, visited) if visited is not None else np.zeros(len(graph), dtype=bool)
    across = None if assembly is None or len(graph) > ICONS_UP_TO else flat_axis(assembly)
    spread = float(np.ptp(place[:, 1])) + 1
    height = 0.62 * (spread + 0.6) if across is not None else 5.2
    figure = figure_of_size(figsize=(9.6, max(height, 2.2)))
    axis = figure.add_axes((0.02, 0.10, 0.96, 0.82 if title else 0.88))
    lines = np.stack([place[graph.source], place[graph.target]], axis=1)
    chosen = on_route[graph.source] & on_route[graph.target]
    gap = 0.3 if across is not None else 0.0
    lines[:, 0, 0] -= gap
    lines[:, 1, 0] += gap
    many = len(graph) > 800
    axis.add_collection(
        collections.LineCollection(
            list(lines[~chosen]), colors=EDGE, linewidths=0.25 if many else 0.8, alpha=0.35 if many else 1.0, zorder=1
        )
    )
    axis.add_collection(collections.LineCollection(list(lines[chosen]), colors=ROUTE, linewidths=2.6, zorder=2))
    if assembly is not None and across is not None:
        _draw_icons(axis, assembly, outlines(assembly, across), graph, place, useful, seen)
    else:
        size = 3.0 if many else 16.0
        for mask, color, order in ((~useful, USELESS, 3), (useful & ~seen, "#6d7076", 3), (seen, SEEN, 4)):
            axis.scatter(*place[mask].T, s=size, color=color, linewidths=0, zorder=order)
        axis.scatter(*place[on_route].T, s=1.6 * size, color=ROUTE, linewidths=0, zorder=5)
    axis.set_xlim(-0.8, place[:, 0].max(initial=0.0) + 0.8)
    low, high = place[:, 1].min(initial=0.0), place[:, 1].max(initial=0.0)
    axis.set_ylim(low - 0.7, high + 0.7)
    axis.set_yticks([])
    for side in ("left", "right", "top"):
        axis.spines[side].set_visible(False)
    axis.set_xlabel("steps of assembly", fontsize=9, color=INK)
    axis.tick_params(labelsize=8, colors=INK)
    _legend(axis, route is not None, visited is not None, bool((~useful).any()))
    if title:
        axis.set_title(title, fontsize=10, color=INK)
    return figure


def figure_pixels(figure: Any, dpi: int = 110) -> NDArray[np.uint8]:
    """Return a figure as an array, shape (height, width, 3)."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    figure.set_dpi(dpi)
    canvas = FigureCanvasAgg(figure)
    with fitting_fonts(figure):
        canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _draw_icons(
    axis: Any,
    assembly: Assembly,
    lines: list[list[Array]],
    graph: StateGraph,
    place: Array,
    useful: NDArray[np.bool_],
    seen: NDArray[np.bool_],
) -> None:
    points = np.concatenate([line for part in lines for line in part])
    low, high = points.min(axis=0), points.max(axis=0)
    scale = np.array([0.54, 0.8]) / (high - low).max()
    for node, state in enumerate(graph.states):
        look = appearance_at(Timeline.from_state(assembly, state, graph.task.robots), 0)
        for part in np.flatnonzero(look.opacity > 0):
            moved = (lines[part][0] - (low + high) / 2) * scale + place[node]
            axis.fill(
                *moved.T, facecolor=look.color[part] / 255, edgecolor=INK, linewidth=0.4,
                alpha=1.0 if useful[node] else 0.35, zorder=3,
            )  # fmt: skip
        if seen[node]:
            axis.plot(place[node, 0], place[node, 1] - 0.42, "o", color=SEEN, markersize=3.5, zorder=4)


def _legend(axis: Any, route: bool, visited: bool, useless: bool) -> None:
    entries = []
    if route:
        entries.append((ROUTE, "a plan"))
    if visited:
        entries.append((SEEN, "visited by the policy"))
    if useless:
        entries.append((USELESS, "on no plan"))
    for color, words in entries:
        axis.plot([], [], "o", color=color, label=words, markersize=6)
    if entries:
        axis.legend(loc="upper center", bbox_to_anchor=(0.5, -0.09), ncols=len(entries), frameon=False, fontsize=9)
