"""`falsework picture`: picture of a plan, a structure or a state graph without a display."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from tyro.conf import arg

from falsework.cli.command import UNSET, Command, Exit
from falsework.cli.planning import writable
from falsework.cli.subject import Subject, SubjectOptions
from falsework.errors import InputError

if TYPE_CHECKING:
    from falsework.assembly.state import States
    from falsework.cli.output import Output
    from falsework.viewer.page.viewer_state import Model
    from falsework.viewer.pictures.render import Camera


@dataclass(frozen=True, kw_only=True)
class MakePicture(Command):
    """Draw a contact sheet of a plan, one step of it, a structure, or a state graph.

    Needs no display and no graphics driver. A two-dimensional structure, such as an arch, can be drawn as lines
    (--svg). With --forces the proof of a state is drawn in: contact forces in blue, friction in red, gravity in
    orange, and where the state does not stand, the motion of the parts. With --verdicts every state that is drawn is
    judged: parts that slide are marked, and states that do not stand are named.
    """

    examples: ClassVar[tuple[str, ...]] = (
        "falsework picture plan.json --out sheet.png",
        "falsework picture plan.json --step 4 --out step.png",
        "falsework picture arch:blocks=9 --svg --forces --out arch.svg",
    )

    subject: SubjectOptions
    out: Annotated[Path, arg(metavar="FILE", help_behavior_hint=UNSET)] = Path("picture.png")
    """File to write, PNG, or SVG with --svg."""
    step: Annotated[int | None, arg(metavar="N", help_behavior_hint=UNSET)] = None
    """Draw the state after this step alone; 0 is the beginning."""
    svg: bool = False
    """Line drawing of a two-dimensional structure, or the state graph, as SVG."""
    forces: bool = False
    """Draw the proof of a single state."""
    verdicts: bool = False
    """Evaluate the stability of the states drawn, and mark unstable parts."""
    criterion: Literal["contact", "equilibrium"] = "contact"
    """Stability criterion: compliant contacts without prestress bring every part to rest, or (paper) contact forces
    in balance exist."""
    policy: Annotated[str | None, arg(metavar="RUN", help_behavior_hint=UNSET)] = None
    """Run whose policy colours the parts of a single state, or whose states are marked in a state graph."""
    frames: int = 12
    """Number of pictures of a contact sheet."""
    columns: int = 4
    """Number of pictures in a row."""
    width: int = 0
    """Width of a picture, pixels; 0: automatic."""
    azimuth: float = -58.0
    """Azimuth of the camera, degrees."""
    elevation: float = 24.0
    """Elevation of the camera, degrees."""
    title: str = ""
    """Title line."""

    def run(self, output: Output) -> Exit:
        """Open, draw, write."""
        if not (self.width == 0 or 80 <= self.width <= 8000):
            raise InputError(f"a picture {self.width} pixels across cannot be drawn; give 80 to 8000")
        if self.frames < 1 or self.columns < 1:
            raise InputError(f"{self.frames} pictures in {self.columns} columns show nothing; give at least 1 of each")
        writable(self.out)
        out = self.out.with_suffix(".svg") if self.svg and self.out == Path("picture.png") else self.out
        if self.svg != (out.suffix.lower() == ".svg"):
            raise InputError(f"{out} and {'--svg' if self.svg else 'no --svg'} do not fit; name a file that does")
        subject = self.subject.open().with_policy(self.policy)
        drawn = self._draw(subject, out)
        output.record({"out": str(out), "kind": subject.kind, **drawn})
        output.say(f"{out}: {drawn['shows']}")
        return Exit.DONE

    def _draw(self, subject: Subject, out: Path) -> dict[str, Any]:
        from falsework.viewer.pictures.contact_sheet import (
            caption,
            check_places,
            contact_sheet,
            legend,
            one_state,
            write_png,
        )
        from falsework.viewer.pictures.drawing import drawing, write_svg
        from falsework.viewer.timeline import interesting

        timeline, policy = subject.timeline, subject.policy
        if subject.graph is not None and self.step is None:
            from falsework.viewer.pictures.graph_picture import covered, graph_figure, write_figure

            route = timeline.states if len(timeline) else None
            visited = self._visited(subject) if policy is not None else None
            figure = graph_figure(subject.graph, subject.assembly, route=route, visited=visited, title=self.title)
            write_figure(out, figure)
            shows = f"{len(subject.graph)} states and {len(subject.graph.source)} actions"
            if visited is None:
                return {"shows": shows}
            seen = int(covered(subject.graph, visited).sum())
            return {"shows": f"{shows}, {seen} of the states visited by the policy", "visited": seen}
        single = self.step if self.step is not None else (0 if len(timeline) == 0 else None)
        if self.forces and single is None:
            raise InputError("forces are drawn for one state at a time; name it with --step")
        if single is not None:
            check_places(timeline, [single])
        places = [single] if single is not None else list(interesting(timeline, self.frames))
        proofs = subject.proofs(places, self.criterion) if self.forces or self.verdicts else {}
        shown = list(proofs[single].arrows.items()) if single is not None and self.forces else []
        arrows = [some for _, some in shown if len(some)]
        key = [(some.color, kind) for kind, some in shown if len(some)] if self.forces else None
        if self.svg:
            columns = min(self.columns, len(places))
            width = float(self.width or (260 if single is None else 640))
            write_svg(
                out, drawing(timeline, places, columns=columns, width=width, arrows=arrows, key=key, proofs=proofs)
            )
        elif single is not None:
            proof = proofs.get(single)
            image = one_state(
                timeline,
                single,
                self._camera(1200, 2 / 3),
                arrows=arrows,
                key=legend(timeline, proof is not None and proof.slides) if key is None else key,
                words=self.title or caption(timeline, single, proof),
                marks=None if proof is None else proof.marks,
                arms=subject.arms,
                chances=None if policy is None else self._model(subject, single).chances(),
            )
            write_png(out, image)
        else:
            sheet = contact_sheet(
                timeline,
                places=places,
                columns=self.columns,
                camera=self._camera(480, 5 / 8),
                title=self.title,
                proofs=proofs,
            )
            write_png(out, sheet)
        shows = f"{len(places)} of {len(timeline) + 1} states" if len(timeline) else f"{subject.assembly.name}"
        if not proofs:
            return {"shows": shows, "steps": places}
        fallen = [place for place, proof in proofs.items() if not proof.stable]
        note = proofs[single].words if single is not None else f"{len(fallen)} of them do not stand"
        return {"shows": f"{shows}; {note}", "steps": places, "criterion": self.criterion, "not_standing": fallen}

    def _model(self, subject: Subject, place: int) -> Model:
        from falsework.viewer.page.viewer_state import Model

        model = Model(subject.timeline, policy=subject.policy, graph=subject.graph)
        model.go_to(place)
        return model

    def _visited(self, subject: Subject) -> States:
        return self._model(subject, 0).visited()

    def _camera(self, width: int, share: float) -> Camera:
        from falsework.viewer.pictures.render import Camera

        across = self.width or width
        return Camera(self.azimuth, self.elevation, across, round(across * share), 0.96)
