"""`falsework picture`: picture of a plan, a structure or a state graph without a display."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from tyro.conf import arg

from falsework.cli.command import UNSET, JudgingCommand
from falsework.cli.exit_code import Exit
from falsework.cli.output import counted
from falsework.cli.planning import writable
from falsework.cli.subject import ViewableOptions
from falsework.errors import InputError

if TYPE_CHECKING:
    from falsework.cli.output import Output


@dataclass(frozen=True, kw_only=True)
class MakePicture(JudgingCommand):
    """Draw a contact sheet of a plan, one step of it, a structure, a state graph, or a cell.

    Needs no display and no graphics driver. A two-dimensional structure, such as an arch, can be drawn as lines
    (--svg). --forces draws the certificate of a state: contact forces in blue, friction in red, gravity in orange and,
    if the state is not stable, the motion of the parts. --verdicts computes the verdict of every state drawn, marks
    parts that slide, and labels states that are not stable.
    """

    examples: ClassVar[tuple[str, ...]] = (
        "falsework picture plan.json --out sheet.png",
        "falsework picture plan.json --step 4 --out step.png",
        "falsework picture arch:blocks=9 --svg --forces --out arch.svg",
        "falsework picture plan.json --step 4 --limits --out limits.png",
    )

    subject: ViewableOptions
    out: Annotated[Path, arg(metavar="FILE", help_behavior_hint=UNSET)] = Path("picture.png")
    """File to write, PNG, or SVG with --svg."""
    step: Annotated[int | None, arg(metavar="N", help_behavior_hint=UNSET)] = None
    """Draw the state after this step alone; 0 is the beginning."""
    svg: bool = False
    """Line drawing of a two-dimensional structure, or the state graph, as SVG."""
    gantt: bool = False
    """Draw when each arm of a robot plan moves, holds and waits."""
    forces: bool = False
    """Draw the certificate of a single state."""
    verdicts: bool = False
    """Evaluate the stability of the states drawn, and mark unstable parts."""
    limits: bool = False
    """Colour the parts of a single state by how near they are to slipping or tipping."""
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
        from falsework.viewer.cells.cell_sight import is_cell
        from falsework.viewer.pictures.contact_sheet import check_suffix
        from falsework.viewer.show import check_sizes, picture

        writable(self.out)
        out = self.out.with_suffix(".svg") if self.svg and self.out == Path("picture.png") else self.out
        if self.svg != (out.suffix.lower() == ".svg") and not (self.gantt and not self.svg):
            raise InputError(f"{out} and {'--svg' if self.svg else 'no --svg'} do not fit; name a file that does")
        check_sizes(self.width, self.frames, self.columns)
        if self.gantt:
            return self._gantt(out, output)
        if is_cell(self.subject.spec):
            return self._cell(out, output)
        check_suffix(out, ".png", ".svg")
        subject = self.subject.open().with_policy(self.policy)
        drawn = picture(
            subject,
            out,
            step=self.step,
            forces=self.forces,
            verdicts=self.verdicts,
            limits=self.limits,
            criterion=self.criterion,
            frames=self.frames,
            columns=self.columns,
            width=self.width,
            azimuth=self.azimuth,
            elevation=self.elevation,
            title=self.title,
        )
        record: dict[str, Any] = {"out": str(out), "kind": subject.kind, "shows": drawn.shows}
        if subject.graph is None or self.step is not None:
            record["steps"] = list(drawn.places)
        if drawn.unstable is not None:
            record |= {"criterion": self.criterion, "not_standing": list(drawn.unstable)}
        if drawn.visited is not None:
            record["visited"] = drawn.visited
        output.record(record)
        output.say(f"{out}: {drawn.shows}")
        return Exit.DONE

    def _cell(self, out: Path, output: Output) -> Exit:
        from falsework.viewer.cells.cell_picture import picture_cell

        others = {"step": self.step is not None, "svg": self.svg, "forces": self.forces, "verdicts": self.verdicts}
        others |= {"limits": self.limits, "policy": self.policy is not None}
        if wrong := [f"--{name}" for name, given in others.items() if given]:
            raise InputError(f"a cell has no states; leave out {' and '.join(wrong)}")
        look: dict[str, Any] = {"width": self.width, "azimuth": self.azimuth, "elevation": self.elevation}
        drawn = picture_cell(
            self.subject.spec, out, self.subject.structure, title=self.title, **look, **self.subject.given()
        )
        output.record(
            {"out": str(out), "kind": "cell", "shows": drawn.shows, "faults": drawn.faults, "too_near": drawn.pairs}
        )
        output.say(f"{out}: {drawn.shows}")
        for fault in drawn.faults:
            output.note(f"falsework: {fault}")
        return Exit.DONE

    def _gantt(self, out: Path, output: Output) -> Exit:
        from falsework.viewer.pictures.gantt import draw_gantt

        others = {"step": self.step is not None, "forces": self.forces, "verdicts": self.verdicts}
        others |= {"limits": self.limits, "policy": self.policy is not None}
        if wrong := [f"--{name}" for name, given in others.items() if given]:
            raise InputError(f"a Gantt chart shows no state; leave out {' and '.join(wrong)}, or --gantt")
        subject = self.subject.open()
        if subject.arms is None:
            raise InputError(f"a {subject.kind} has no arms to draw a Gantt chart of; give a robot plan")
        plan = subject.arms.plan
        bars = draw_gantt(plan, out, width=self.width, title=self.title)
        output.record({"out": str(out), "kind": "gantt", "bars": bars, "makespan": round(plan.makespan, 3)})
        output.say(f"{out}: {counted(len(plan.robots), 'arm')} over {plan.makespan:.1f} s")
        return Exit.DONE
