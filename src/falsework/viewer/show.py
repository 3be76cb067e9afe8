"""Functions that show, draw and animate plans, structures, runs and state graphs."""

from __future__ import annotations

import sys
import webbrowser
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.model import Assembly
from falsework.assembly.state import States, check_robots
from falsework.errors import InputError
from falsework.stability.margins.nearness import nearness_to_limit
from falsework.stability.verdict import Criterion
from falsework.utils.display.notebook import in_notebook
from falsework.utils.models import check_options
from falsework.utils.quantity import check_deadline, check_whole, counted
from falsework.viewer.arrows import Arrows, arrows_of_step
from falsework.viewer.page.viewer_state import ViewerState
from falsework.viewer.pictures.contact_sheet import (
    caption,
    check_places,
    check_suffix,
    contact_sheet,
    legend,
    one_state,
)
from falsework.viewer.pictures.drawing import drawing
from falsework.viewer.pictures.picture import Kind, Picture, PictureReport, figure_of, png_of, svg_of
from falsework.viewer.pictures.render import Camera
from falsework.viewer.pictures.video import frame_places, frame_times, write_film
from falsework.viewer.proof import StateProof
from falsework.viewer.timeline import interesting
from falsework.viewer.viewable import Showable, Viewable, open_file, viewable_of, viewable_options

if TYPE_CHECKING:
    from falsework.learn.networks.policy import Policy
    from falsework.viewer.page.page import Page

AZIMUTH, ELEVATION = -58.0, 24.0
"""Direction of view, degrees about the vertical and above the horizon."""


def view(
    subject: Showable,
    structure: Assembly | str | Path | None = None,
    *,
    policy: Policy | Path | str | None = None,
    robots: int = 2,
    criterion: Criterion = "contact",
    deadline: float | None = 60.0,
    host: str = "127.0.0.1",
    port: int = 8080,
    allowed_hosts: Sequence[str] = (),
    browser: bool | None = None,
    wait: bool | None = None,
    **options: Any,
) -> Page:
    """Show a plan, run, robot plan, state graph, structure or state on a page in the browser.

    A notebook shows what is returned: the file that `Page.save` writes, and a link to the page.

    Args:
        subject: an object, a state of shape (parts,), or a file as `open_file` takes it.
        structure: structure of a plan, graph or state that does not name it.
        policy: colours the parts and proposes new plans; a policy or the folder of a run.
        robots: number of robots, where no plan says it.
        deadline: seconds that a new plan may take; None for as long as it takes.
        host: address to serve at. Beyond this machine, every client that can reach it can view and control the page.
        port: port to serve at; the next free one is taken if it is not free.
        allowed_hosts: names other than `host` under which browsers may open the page.
        browser: open the page in the browser; if not given, everywhere but in a notebook.
        wait: serve until interrupted by the keyboard; else return at once and serve until `Page.close`. If not given,
            scripts wait, notebooks and prompts do not.
        options: as for `viewable_of`.

    Raises:
        InputError: nothing that can be shown, or the address cannot be listened at.
        DependencyError: viser is not installed, or torch for a policy.
    """
    from falsework.viewer.page.page import Page
    from falsework.viewer.web.served_page import serve

    check_options(view, options, viewable_options())
    check_view(robots, host, port, deadline)
    options = {"robots": robots, **options}
    is_file = isinstance(subject, (str, Path))
    shown = open_file(subject, structure, **options) if is_file else viewable_of(subject, structure, **options)
    shown = shown.with_policy(policy)
    model = _model(shown, criterion=criterion, deadline=deadline)
    page = Page(model, file=shown.file, host=host, port=port, allowed_hosts=allowed_hosts)
    if not in_notebook() if browser is None else browser:
        webbrowser.open(page.address)
    if not (in_notebook() or hasattr(sys, "ps1")) if wait is None else wait:
        serve(page)
    return page


def check_view(robots: int, host: str, port: int, deadline: float | None) -> None:
    """Refuse arguments of `view` before anything is loaded."""
    from falsework.viewer.web.origin_guard import import_viser
    from falsework.viewer.web.served_page import check_host

    check_robots(robots)
    if not 0 <= port <= 65535:
        raise InputError(f"there is no port {port}; give 1 to 65535")
    check_deadline(deadline)
    check_host(host)
    import_viser()


def picture(
    subject: Showable,
    path: Path | str | None = None,
    structure: Assembly | str | Path | None = None,
    *,
    step: int | None = None,
    forces: bool = False,
    verdicts: bool = False,
    limits: bool = False,
    criterion: Criterion = "contact",
    policy: Policy | Path | str | None = None,
    frames: int = 12,
    columns: int = 4,
    width: int = 0,
    azimuth: float = AZIMUTH,
    elevation: float = ELEVATION,
    title: str = "",
    **options: Any,
) -> Picture:
    """Draw a contact sheet of a plan, one state of it, a structure, or a state graph, without a screen.

    Notebooks show what is returned.

    Args:
        subject: an object, a state of shape (parts,), or a file as `open_file` takes it.
        path: file to write, PNG, or SVG for line drawings of two-dimensional structures and for state graphs; without
            one the picture is only returned.
        structure: structure of a plan, graph or state that does not name it.
        step: draw the state in which this many steps are done; 0 is the beginning.
        forces: draw the proof of a single state.
        verdicts: decide the stability of the states that are drawn, and mark those that are not stable.
        limits: colour the parts of a single state by how near they are to slipping or tipping.
        policy: colours the parts of a single state, or marks its states in a state graph; a policy or the folder of a
            run.
        frames: pictures of a contact sheet.
        columns: pictures in a row.
        width: pixels of a picture across; 0 chooses.
        azimuth: direction of view about the vertical, degrees.
        elevation: direction of view above the horizon, degrees.
        title: a line above.
        options: as for `viewable_of`.

    Raises:
        InputError: nothing that can be shown, a step that is not there, sizes that cannot be drawn, or a file that
            cannot be written.
        DependencyError: Pillow or matplotlib is not installed, or torch for a policy.
    """
    check_options(picture, options, viewable_options())
    if path is not None:
        check_suffix(path, ".png", ".svg")
    kind: Kind = "svg" if path is not None and Path(path).suffix.lower() == ".svg" else "png"
    check_sizes(width, frames, columns)
    shown = viewable_of(subject, structure, **options).with_policy(policy)
    if shown.graph is not None and step is None:
        drawn = _picture_graph(shown, kind, title)
        if path is not None:
            drawn.save(path)
        return drawn
    timeline = shown.timeline
    single = step if step is not None else (0 if len(timeline) == 0 else None)
    if forces and single is None:
        raise InputError("forces are drawn for one state at a time; name it with --step")
    if single is not None:
        check_places(timeline, [single])
    places = [single] if single is not None else list(interesting(timeline, frames))
    proofs = shown.proofs(places, criterion) if forces or verdicts else {}
    arrows_by_kind: dict[str, Arrows] = {}
    if single is not None:
        arrows_by_kind = arrows_of_step(timeline, single) | (proofs[single].arrows if forces else {})
    arrows = [some for some in arrows_by_kind.values() if len(some)]
    key = None
    if single is not None:
        slides = single in proofs and proofs[single].slides and "sliding" not in arrows_by_kind
        key = legend(timeline, slides, places=[single])
        key += [(some.color, some.words(kind)) for kind, some in arrows_by_kind.items() if len(some)]
    shares = None if shown.policy is None or single is None else _model(shown, single).action_probabilities()
    if limits:
        if single is None or kind == "svg":
            raise InputError("limits colour the parts of one state in a PNG; name the state with --step")
        shares = _nearness(shown, single, criterion)

    def camera(across: int, share: float) -> Camera:
        return Camera(azimuth, elevation, width or across, round((width or across) * share), 0.96)

    if kind == "svg":
        across = float(width or (260 if single is None else 640))
        most = min(columns, len(places))
        lines = drawing(timeline, places, columns=most, width=across, arrows=arrows, key=key, proofs=proofs)
        content = svg_of(lines)
    elif single is not None:
        proof = proofs.get(single)
        borne = timeline.loads_text(single)
        image = one_state(
            timeline,
            single,
            camera(1200, 2 / 3),
            arrows=arrows,
            key=key,
            words=title or "\n".join(filter(None, (caption(timeline, single, proof), borne if proof else ""))),
            marks=None if proof is None else proof.marks,
            arms=shown.arms,
            travelling=False,
            action_probabilities=shares,
            share_of="the limit" if limits else "",
        )
        content = png_of(image)
    else:
        view_of_all = camera(480, 5 / 8)
        look = {"camera": view_of_all, "title": title, "arms": shown.arms, "proofs": proofs}
        content = png_of(contact_sheet(timeline, places, columns=columns, **look))
    shows = f"{len(places)} of {len(timeline) + 1} states" if len(timeline) else f"{shown.assembly.name}"
    if single is not None:
        shows = "; ".join(filter(None, (caption(timeline, single), timeline.loads_text(single))))
    fallen = _unstable(proofs) if proofs else None
    if fallen is not None:
        shows += f"; {proofs[single].words if single is not None else f'{len(fallen)} of them are not stable'}"
    drawn = Picture(shows, tuple(places), fallen, content=content, kind=kind)
    if path is not None:
        drawn.save(path)
    return drawn


def _nearness(shown: Viewable, place: int, criterion: Criterion) -> NDArray[np.float64]:
    """Return how near the free parts of a stable state are to their limits, NaN elsewhere, shape (parts,)."""
    state = shown.timeline.states[shown.timeline.row(place)]
    forces = shown.proofs([place], criterion)[place].forces
    if forces is None:
        raise InputError("the state is not stable, so its parts are beyond their limits; draw it with --verdicts")
    return nearness_to_limit(shown.assembly, state, forces)


def check_sizes(width: int, frames: int, columns: int) -> None:
    """Refuse sizes of a picture before anything is loaded."""
    check_whole(width=width, frames=frames, columns=columns)
    if not (width == 0 or 80 <= width <= 8000):
        raise InputError(f"a picture {width} pixels across cannot be drawn; give 80 to 8000")
    if frames < 1 or columns < 1:
        raise InputError(f"{frames} pictures in {columns} columns show nothing; give at least 1 of each")


def animate(
    subject: Showable,
    path: Path | str,
    structure: Assembly | str | Path | None = None,
    *,
    seconds: float = 0.4,
    rate: float = 10.0,
    speed: float = 1.0,
    verdicts: bool = False,
    criterion: Criterion = "contact",
    width: int = 800,
    azimuth: float = AZIMUTH,
    elevation: float = ELEVATION,
    progress: Callable[[int, int], None] | None = None,
    **options: Any,
) -> PictureReport:
    """Render a plan as a video, MP4 or GIF, without a display.

    Args:
        subject: an object or a file as `open_file` takes it, with steps to animate.
        path: file to write; it ends in .mp4 or .gif.
        structure: structure of a plan or graph that does not name it.
        seconds: length of a step; a robot plan plays by its own clock instead.
        rate: pictures a second.
        speed: seconds of a robot plan that pass in a second.
        verdicts: decide the stability of every state, and mark those that are not stable.
        width: pixels across.
        azimuth: direction of view about the vertical, degrees.
        elevation: direction of view above the horizon, degrees.
        progress: called with the number of pictures drawn and of all.
        options: as for `viewable_of`.

    Raises:
        InputError: nothing to animate, another kind of file, invalid sizes, or a file that cannot be written.
        DependencyError: Pillow or imageio-ffmpeg is not installed.
    """
    check_options(animate, options, viewable_options())
    check_film(width, seconds, rate, speed)
    shown = viewable_of(subject, structure, **options)
    timeline = shown.timeline
    if len(timeline) == 0:
        raise InputError(f"{shown.assembly.name} has no steps to animate; give a plan, as `falsework plan` writes it")
    places = tuple(timeline.places)
    proofs = shown.proofs(places, criterion) if verdicts else {}
    camera = Camera(azimuth, elevation, width, 2 * round(0.35 * width), 0.95, samples=2)
    count = write_film(
        path,
        timeline,
        seconds=seconds,
        rate=rate,
        speed=speed,
        camera=camera,
        arms=shown.arms,
        proofs=proofs,
        progress=progress,
    )
    fallen = _unstable(proofs)
    note = f"; {len(fallen)} of {len(proofs)} states are not stable" if verdicts else ""
    shows = f"{counted(len(timeline), 'step')} in {counted(count, 'picture')}{note}"
    return PictureReport(shows, places, fallen if verdicts else None, pictures=count)


def check_film(width: int, seconds: float, rate: float, speed: float) -> None:
    """Refuse sizes of a video before anything is loaded."""
    check_whole(width=width)
    if not 80 <= width <= 4000:
        raise InputError(f"a video {width} pixels across cannot be drawn; give 80 to 4000")
    frame_places(0, seconds, rate)
    frame_times(0.0, rate, speed)


def _picture_graph(shown: Viewable, kind: Kind, title: str) -> Picture:
    from falsework.viewer.pictures.graph_picture import covered, graph_figure

    assert shown.graph is not None
    route = shown.timeline.states if len(shown.timeline) else None
    visited: States | None = None if shown.policy is None else _model(shown).visited()
    content = figure_of(graph_figure(shown.graph, shown.assembly, route=route, visited=visited, title=title), kind)
    shows = f"{counted(len(shown.graph), 'state')} and {counted(len(shown.graph.source), 'action')}"
    if visited is None:
        return Picture(shows, content=content, kind=kind)
    seen = int(covered(shown.graph, visited).sum())
    return Picture(f"{shows}, {seen} of the states visited by the policy", visited=seen, content=content, kind=kind)


def _model(shown: Viewable, place: int | None = None, **options: Any) -> ViewerState:
    model = ViewerState(
        shown.timeline, plan=shown.plan, policy=shown.policy, graph=shown.graph, arms=shown.arms, **options
    )
    if place is not None:
        model.go_to(place)
    return model


def _unstable(proofs: dict[int, StateProof]) -> tuple[int, ...]:
    return tuple(sorted(place for place, proof in proofs.items() if not proof.stable))
