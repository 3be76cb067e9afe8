"""`falsework animate`: video of a plan."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar

from tyro.conf import arg

from falsework.cli.command import JudgingCommand
from falsework.cli.exit_code import Exit
from falsework.cli.planning import writable
from falsework.cli.subject import ViewableOptions
from falsework.errors import InputError

if TYPE_CHECKING:
    from falsework.cli.output import Output


@dataclass(frozen=True, kw_only=True)
class Animate(JudgingCommand):
    """Render a plan as a video, MP4 or GIF by file suffix.

    Needs no display and no graphics driver. --verdicts computes the verdict of every state, marks parts that slide,
    and labels states that are not stable.
    """

    examples: ClassVar[tuple[str, ...]] = (
        "falsework animate plan.json --out plan.mp4",
        "falsework animate plan.json --width 320 --out plan.gif",
    )

    subject: ViewableOptions
    out: Annotated[Path, arg(metavar="FILE")] = Path("plan.mp4")
    """File to write; it ends in .mp4 or .gif."""
    seconds: float = 0.4
    """Duration of a step; a robot plan with a schedule is shown in its own time instead."""
    rate: float = 10.0
    """Frame rate."""
    speed: float = 1.0
    """Seconds of a schedule that pass in a second of the video."""
    verdicts: bool = False
    """Evaluate the stability of every state, and mark unstable parts."""
    width: int = 800
    """Width, pixels."""
    azimuth: float = -58.0
    """Azimuth of the camera, degrees."""
    elevation: float = 24.0
    """Elevation of the camera, degrees."""

    def run(self, output: Output) -> Exit:
        """Open the plan, draw every picture, and write the video."""
        from falsework.viewer.pictures.video import KINDS
        from falsework.viewer.show import animate, check_film

        if self.out.suffix.lower() not in KINDS:
            raise InputError(f"{self.out}: videos are written as {' or '.join(KINDS)}; name such a file")
        check_film(self.width, self.seconds, self.rate, self.speed)
        writable(self.out)
        subject = self.subject.open()
        with output.bar("drawing") as show:
            video = animate(
                subject,
                self.out,
                seconds=self.seconds,
                rate=self.rate,
                speed=self.speed,
                verdicts=self.verdicts,
                criterion=self.criterion,
                width=self.width,
                azimuth=self.azimuth,
                elevation=self.elevation,
                progress=lambda done, total: show(done, total, f"picture {done} of {total}"),
            )
        record = {"out": str(self.out), "pictures": video.pictures, "steps": len(subject.timeline)}
        if video.unstable is not None:
            record |= {"criterion": self.criterion, "not_standing": list(video.unstable)}
        output.record(record)
        output.say(f"{self.out}: {video.shows}")
        return Exit.DONE
