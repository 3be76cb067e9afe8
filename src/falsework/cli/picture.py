"""`falsework picture`: picture or video of a plan, a structure or a state graph without a display."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar

from tyro.conf import arg

from falsework.cli.command import UNSET, JudgingCommand, ViewableOptions
from falsework.cli.exit_code import Exit
from falsework.cli.planning import writable
from falsework.errors import InputError
from falsework.utils.quantity import counted

if TYPE_CHECKING:
    from falsework.cli.output import Output
    from falsework.viewer.show import PictureReport

_STATE = ("forces", "verdicts", "limits", "policy")
"""Options that show something of states."""
_STILLS = ("step", "gantt", "joints", "forces", "limits", "policy", "frames", "columns", "title")
"""Options that videos do not have."""
_MOVING = ("step_seconds", "rate", "speed")
"""Options that only videos have."""
_VIEW = ("azimuth", "elevation")
_DRAWN = ("step", "forces", "verdicts", "limits", "criterion", "frames", "columns", "width", "title", *_VIEW)
"""Options that are arguments of `falsework.picture`."""
_VIDEO_WIDTH = 800
"""Width of videos where none is given, pixels."""


@dataclass(frozen=True, kw_only=True)
class MakePicture(JudgingCommand):
    """Draw a contact sheet or a video of a plan, one step of it, a structure, a state graph, or a cell.

    The name of the file says what is drawn: PNG, a line drawing of a two-dimensional structure or a state graph as SVG,
    a video as MP4 or GIF. Needs no display and no graphics driver. --forces draws the certificate of a state: contact
    forces in blue, friction in red, gravity in orange and, if the state is not stable, the motion of the parts.
    --verdicts computes the verdict of every state drawn, marks parts that slide, and labels states that are not stable.
    """

    rare: ClassVar[tuple[str, ...]] = ("policy", "frames", "columns", "rate", "speed", "azimuth", "elevation", "title")

    examples: ClassVar[tuple[str, ...]] = (
        "falsework picture plan.json --out sheet.png",
        "falsework picture plan.json --step 4 --out step.png",
        "falsework picture plan.json --out plan.mp4",
        "falsework picture arch:blocks=9 --forces --out arch.svg",
        "falsework picture plan.json --step 4 --limits --out limits.png",
    )

    subject: ViewableOptions
    out: Annotated[Path, arg(metavar="FILE")] = Path("picture.png")
    """File to write; it ends in .png, .svg, .mp4 or .gif."""
    step: Annotated[int | None, arg(metavar="N", help_behavior_hint=UNSET)] = None
    """Draw the state after this step alone; 0 is the beginning."""
    gantt: bool = False
    """Draw when each arm of a robot plan moves, holds and waits, as PNG or SVG."""
    joints: bool = False
    """Draw position and velocity of each joint of a robot plan over time, with their limits, as PNG or SVG."""
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
    step_seconds: Annotated[float, arg(metavar="S")] = 0.4
    """Duration of a step in a video; a robot plan is shown in its own time instead."""
    rate: float = 10.0
    """Frame rate of a video."""
    speed: float = 1.0
    """Seconds of a robot plan that pass in a second of the video."""
    width: int = 0
    """Width of a picture, pixels; 0: automatic."""
    azimuth: float = -58.0
    """Azimuth of the camera, degrees."""
    elevation: float = 24.0
    """Elevation of the camera, degrees."""
    title: str = ""
    """Title line of a picture."""

    def run(self, output: Output) -> Exit:
        """Open, draw, write."""
        from falsework.viewer.cells.cell_model import is_cell
        from falsework.viewer.pictures.contact_sheet import check_suffix
        from falsework.viewer.pictures.video import KINDS
        from falsework.viewer.show import check_sizes

        writable(self.out)
        video = self.out.suffix.lower() in KINDS
        if video:
            self._refuse(_STILLS, f"a video such as {self.out}")
        else:
            self._refuse(_MOVING, f"a picture such as {self.out}")
            check_suffix(self.out, ".png", ".svg", *KINDS)
            check_sizes(self.width, self.frames, self.columns)
        if self.gantt or self.joints:
            return self._chart(output)
        if is_cell(self.subject.spec) and not video:
            return self._cell(output)
        return self._animate(output) if video else self._draw(output)

    def _refuse(self, options: tuple[str, ...], what: str) -> None:
        """Refuse options that what is drawn does not have."""
        given = [f"--{name.replace('_', '-')}" for name in options if getattr(self, name) != getattr(type(self), name)]
        if given:
            them = "it" if len(given) == 1 else "them"
            raise InputError(f"{what} has no {' and '.join(given)}; leave {them} out, or draw something else")

    def _draw(self, output: Output) -> Exit:
        from falsework.viewer.show import picture

        subject = self.subject.open().with_policy(self.policy)
        drawn = picture(subject, self.out, **{name: getattr(self, name) for name in _DRAWN})
        output.record({"kind": subject.kind, "shows": drawn.shows})
        if subject.graph is None or self.step is not None:
            output.record({"steps": list(drawn.places)})
        if drawn.visited is not None:
            output.record({"visited": drawn.visited})
        return self._tell(drawn, output)

    def _animate(self, output: Output) -> Exit:
        from falsework.viewer.show import animate, check_film

        width = self.width or _VIDEO_WIDTH
        check_film(width, self.step_seconds, self.rate, self.speed)
        subject = self.subject.open()
        with output.count("drawing", "picture") as progress:
            drawn = animate(
                subject,
                self.out,
                **{name: getattr(self, name) for name in ("rate", "speed", "verdicts", "criterion", *_VIEW)},
                seconds=self.step_seconds,
                width=width,
                progress=progress,
            )
        output.record({"kind": subject.kind, "shows": drawn.shows})
        output.record({"pictures": drawn.pictures, "steps": list(drawn.places)})
        return self._tell(drawn, output)

    def _tell(self, drawn: PictureReport, output: Output) -> Exit:
        output.file(self.out)
        if drawn.unstable is not None:
            output.record({"criterion": self.criterion, "not_standing": list(drawn.unstable)})
        output.say(f"{self.out}: {drawn.shows}")
        return Exit.DONE

    def _cell(self, output: Output) -> Exit:
        from falsework.viewer.cells.cell_picture import picture_cell

        self._refuse(("step", *_STATE), "a picture of a cell")
        look = {name: getattr(self, name) for name in ("width", "title", *_VIEW)}
        drawn = picture_cell(self.subject.spec, self.out, self.subject.structure, **look, **self.subject.given())
        output.file(self.out)
        output.record({"kind": "cell", "shows": drawn.shows, "faults": drawn.faults, "too_near": drawn.pairs})
        output.say(f"{self.out}: {drawn.shows}")
        for fault in drawn.faults:
            output.note(f"falsework: {fault}")
        return Exit.DONE

    def _chart(self, output: Output) -> Exit:
        from falsework.viewer.pictures.gantt import draw_gantt
        from falsework.viewer.pictures.joint_plot import draw_joints

        what = "a Gantt chart" if self.gantt else "a plot of joints"
        self._refuse(("step", *_STATE, *(("joints",) if self.gantt else ())), what)
        subject = self.subject.open()
        if subject.arms is None:
            raise InputError(f"a {subject.kind} has no arms to draw {what} of; give a robot plan")
        plan = subject.arms.plan
        text, seconds = f"{self.out}: {counted(len(plan.robots), 'arm')} over {plan.makespan:.1f} s", plan.makespan
        if self.gantt:
            bars = draw_gantt(plan, self.out, width=self.width, title=self.title)
            output.record({"kind": "gantt", "bars": bars})
        else:
            fastest = draw_joints(plan, subject.arms.cell, self.out, width=self.width, title=self.title)
            output.record({"kind": "joints", "velocity_share": round(fastest, 4)})
            text += f", joints at up to {fastest:.0%} of their largest speed"
        output.file(self.out)
        output.record({"makespan_s": round(seconds, 3)})
        output.say(text)
        return Exit.DONE
