"""`falsework animate`: video of a plan."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from tyro.conf import arg

from falsework.cli.command import Command, Exit
from falsework.cli.planning import writable
from falsework.cli.subject import SubjectOptions
from falsework.errors import InputError

if TYPE_CHECKING:
    from falsework.cli.output import Output


@dataclass(frozen=True, kw_only=True)
class Animate(Command):
    """Render a plan as a video, MP4 or GIF by the ending of the file.

    Needs no display and no graphics driver. With --verdicts every state is judged anew: parts that slide are marked,
    and states that do not stand are named.
    """

    examples: ClassVar[tuple[str, ...]] = (
        "falsework animate plan.json --out plan.mp4",
        "falsework animate plan.json --width 320 --out plan.gif",
    )

    subject: SubjectOptions
    out: Annotated[Path, arg(metavar="FILE")] = Path("plan.mp4")
    """File to write; it ends in .mp4 or .gif."""
    seconds: float = 0.4
    """Duration of a step."""
    rate: float = 10.0
    """Frame rate."""
    verdicts: bool = False
    """Evaluate the stability of every state, and mark unstable parts."""
    criterion: Literal["contact", "equilibrium"] = "contact"
    """Stability criterion: compliant contacts without prestress bring every part to rest, or (paper) contact forces
    in balance exist."""
    width: int = 800
    """Width, pixels."""
    azimuth: float = -58.0
    """Azimuth of the camera, degrees."""
    elevation: float = 24.0
    """Elevation of the camera, degrees."""

    def run(self, output: Output) -> Exit:
        """Open, draw every picture, write."""
        from falsework.viewer.pictures.render import Camera
        from falsework.viewer.pictures.video import KINDS, frame_places, write_film

        if self.out.suffix.lower() not in KINDS:
            raise InputError(f"{self.out}: films are written as {' or '.join(KINDS)}; name such a file")
        if not 80 <= self.width <= 4000:
            raise InputError(f"a film {self.width} pixels across cannot be drawn; give 80 to 4000")
        frame_places(0, self.seconds, self.rate)  # refuse before anything is loaded
        writable(self.out)
        subject = self.subject.open()
        if len(subject.timeline) == 0:
            raise InputError(f"{self.subject.spec} has no steps to play; give a plan, as `falsework plan` writes it")
        proofs = subject.proofs(range(len(subject.timeline) + 1), self.criterion) if self.verdicts else {}
        camera = Camera(self.azimuth, self.elevation, self.width, 2 * round(0.35 * self.width), 0.95)
        with output.bar("drawing") as show:
            count = write_film(
                self.out,
                subject.timeline,
                seconds=self.seconds,
                rate=self.rate,
                camera=camera,
                arms=subject.arms,
                proofs=proofs,
                progress=lambda done, total: show(done, total, f"picture {done} of {total}"),
            )
        fallen = [place for place, proof in proofs.items() if not proof.stable]
        record = {"out": str(self.out), "pictures": count, "steps": len(subject.timeline)}
        output.record(record | ({"criterion": self.criterion, "not_standing": fallen} if self.verdicts else {}))
        note = f"; {len(fallen)} of {len(proofs)} states do not stand" if self.verdicts else ""
        output.say(f"{self.out}: {len(subject.timeline)} steps in {count} pictures{note}")
        return Exit.DONE
