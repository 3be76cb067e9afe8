"""`falsework dataset`: training, validation and test states for a policy."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from tyro.conf import arg

from falsework.cli.command import UNSET, JudgingCommand, StructureOptions
from falsework.cli.exit_code import Exit
from falsework.cli.planning import refuse_unstable, writable
from falsework.errors import InputError

if TYPE_CHECKING:
    from falsework.cli.output import Output


@dataclass(frozen=True, kw_only=True)
class MakeDataset(JudgingCommand):
    """Search for solvable states: disjoint sets for training, validation and test.

    They come from searches that begin at the empty structure, so that each state can be disassembled completely. The
    training set is that of a narrow search; the test set has the states that a wider search finds beyond it, the
    validation set those of a second wide search. Exit code 1 if no search reached the complete structure; the states
    are saved in any case.
    """

    examples: ClassVar[tuple[str, ...]] = ("falsework dataset arch --robots 2 --out data.npz",)

    structure: StructureOptions
    out: Annotated[Path, arg(metavar="FILE")] = Path("data.npz")
    """File to write, a NumPy archive."""
    robots: int = 2
    """Number of robots: parts that can be held at a time."""
    fixed: Annotated[str | None, arg(metavar="PARTS", help_behavior_hint=UNSET)] = None
    """Parts that are neither held nor removed, such as 7."""
    removable_only_if_clear: bool = False
    """Remove a part only if it has a collision-free straight exit."""
    train_width: int = 64
    """Width of the search for the training set."""
    test_width: int = 128
    """Width of the search for the test set."""
    widths: tuple[int, ...] = ()
    """Widths of further searches for training states; test states are excluded."""
    seed: int = 0
    """Random seed; the states are the same on every device."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Device of the search; `auto` takes a GPU if there is one. Several processes under torchrun share the work."""
    deadline: Annotated[float | None, arg(metavar="SECONDS", help_behavior_hint=UNSET)] = None
    """Seconds after which the searches of one process end; the states found so far are saved."""

    def run(self, output: Output) -> Exit:
        """Search, compare and save."""
        from falsework.cli.arguments import parse_parts
        from falsework.learn.data.dataset import save_dataset
        from falsework.search.device.oracle import tensor_oracle
        from falsework.search.problem.deadline import Deadline
        from falsework.stability import Stability, StabilitySettings
        from falsework.utils.distributed import init_distributed
        from falsework.utils.optional_packages import check_torch

        check_torch()
        from falsework.learn.data.dataset import DataSettings, build_dataset, task_for

        writable(self.out, ".npz")
        clock = Deadline(self.deadline)
        if clock.limited and int(os.environ.get("WORLD_SIZE", "1")) > 1:
            raise InputError("processes that share a search cannot end it at a deadline; leave --deadline out")
        settings = DataSettings(self.train_width, self.test_width, self.widths, self.seed)
        assembly = self.structure.load()
        fixed = () if self.fixed is None else parse_parts(self.fixed, "--fixed", assembly.names)
        task = task_for(assembly, self.robots, self.removable_only_if_clear, fixed)
        oracle = Stability(assembly, StabilitySettings(criterion=self.criterion))
        if refuse_unstable(assembly, oracle, task, output):
            return Exit.NO
        with init_distributed(self.device) as (shards, device), output.bar("searching") as show:
            dataset = build_dataset(
                assembly,
                task,
                settings,
                oracle=tensor_oracle(oracle, device),
                device=str(device),
                shards=shards,
                report=lambda text: show(0, 0, text),
                stop=(lambda: clock.passed) if clock.limited else None,
            )
            first = shards.is_main_process
        if not first:
            return Exit.DONE
        save_dataset(dataset, self.out)
        output.record(
            {
                "out": str(self.out),
                "structure": assembly.name,
                "robots": task.robots,
                "criterion": dataset.criterion,
                "train": len(dataset.train),
                "test": len(dataset.test),
                "validation": len(dataset.validation),
                "more": len(dataset.more),
                "levels": dataset.levels(),
                "complete": dataset.complete,
                "seconds": dataset.seconds,
            }
        )
        more = f" and {len(dataset.more)} more" if len(dataset.more) else ""
        output.say(
            f"{self.out}: {len(dataset.train)} states to train on{more}, {len(dataset.test)} to test on, "
            f"{len(dataset.validation)} to validate on"
        )
        if not dataset.complete and clock.limited and clock.passed:
            output.note("the deadline ended the search; what was found so far is saved")
            return Exit.NO
        if not dataset.complete:
            output.note("falsework: not every search reached the complete structure; wider ones may")
            return Exit.NO
        return Exit.DONE
