"""`falsework evaluate`: success rate of a policy on training states and on unseen states."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from tyro.conf import Positional, arg

from falsework.cli.command import UNSET, Command, DeviceOption
from falsework.cli.exit_code import Exit

if TYPE_CHECKING:
    from falsework.cli.output import Output


@dataclass(frozen=True, kw_only=True)
class Evaluate(Command):
    """Evaluate a policy: follow its most probable actions from many states, and count how often they succeed.

    A rollout succeeds only if every state on its path is certified as stable. The training set is that of a narrow
    search; the test set has the states that a wider search finds beyond it, which training never uses.
    """

    rare: ClassVar[tuple[str, ...]] = ("device", "seed")

    examples: ClassVar[tuple[str, ...]] = (
        "falsework evaluate run",
        "falsework evaluate run --search --states 100 --json",
    )

    folder: Annotated[Positional[Path], arg(metavar="RUN")]
    """Folder that `falsework train` wrote; of a policy for any structure, or `general` for the one that comes with this
    program, with --structure."""
    structure: Annotated[str | None, arg(metavar="STRUCTURE", help_behavior_hint=UNSET)] = None
    """Evaluate the policy on a structure other than the one that it was trained for."""
    robots: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: that of the run)")] = None
    """Number of robots; with another number than that of the run, evaluate on states of new searches."""
    search: bool = False
    """Search where the policy fails, and report the share of test states with a proven plan."""
    targets: bool = False
    """Evaluate pairs of start and goal instead of complete disassembly. A policy trained without goals does not see
    the goal; the rules then protect its parts."""
    criterion: Annotated[
        Literal["contact", "equilibrium"] | None, arg(help_behavior_hint="(default: that of the run)")
    ] = None
    """Stability criterion. With another criterion than that of the run, evaluate on states of new searches."""
    states: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: all)")] = None
    """States of each set, a fixed sample."""
    device: DeviceOption = "auto"
    seed: int = 0
    """Random seed of samples and of rollouts in a search."""

    def run(self, output: Output) -> Exit:
        """Load, roll out, count."""
        from falsework.utils.tensors import check_torch

        check_torch()
        from falsework.learn.evaluate import evaluate

        with output.bar("evaluating") as show:
            names = ("robots", "criterion", "targets", "search", "states", "device", "seed")
            options = {name: getattr(self, name) for name in names}
            record = evaluate(self.folder, self.structure, progress=show, **options)
        if record is None:
            return Exit.DONE
        output.record(record)
        for name in ("train", "validation", "test"):
            result = record.get(name, {"states": 0})
            states = result["states"]
            share = (
                f"{100 * result['success']:.1f} % of {states} states succeed" if states else "there are no such states"
            )
            output.say(f"{name}: {share}")
        if self.search and record["test"]["states"]:
            searched = record["test"]["search"]
            output.say(f"with search: {100 * searched['share']:.2f} % of the test states have a proven plan")
        return Exit.DONE
