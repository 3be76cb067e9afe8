"""Part of `falsework graph --sets`: training, validation and test states for a policy."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from falsework.cli.exit_code import Exit
from falsework.utils.quantity import counted

if TYPE_CHECKING:
    from falsework.assembly.model import Assembly
    from falsework.cli.output import Output
    from falsework.search.problem.deadline import Deadline
    from falsework.search.problem.task import Task
    from falsework.stability.oracle import StabilityOracle


def save_sets(
    assembly: Assembly,
    task: Task,
    oracle: StabilityOracle,
    widths: tuple[int, ...],
    seed: int,
    device: str,
    clock: Deadline,
    out: Path,
    output: Output,
) -> Exit:
    """Search for solvable states, and save them in disjoint sets.

    Args:
        widths: of the searches for the training set, for the test set, and for further training states.
        output: where to report.
    """
    from falsework.utils.optional_packages import check_torch

    check_torch()
    from falsework.learn.data.dataset import DataSettings, build_dataset, save_dataset
    from falsework.search.device.oracle import tensor_oracle
    from falsework.utils.distributed import init_distributed

    settings = DataSettings(widths[0], widths[1], widths[2:], seed)
    with init_distributed(device) as (shards, chosen), output.bar("searching") as show:
        dataset = build_dataset(
            assembly,
            task,
            settings,
            oracle=tensor_oracle(oracle, chosen),
            device=str(chosen),
            shards=shards,
            report=lambda text: show(0, 0, text),
            stop=(lambda: clock.passed) if clock.limited else None,
        )
        first = shards.is_main_process
    if not first:
        return Exit.DONE
    save_dataset(dataset, out)
    output.file(out)
    sets = {name: len(getattr(dataset, name)) for name in ("train", "test", "validation", "more")}
    output.record({"criterion": dataset.criterion, "states": sum(sets.values()), "sets": sets})
    output.record({"levels": dataset.levels(), "search_seconds": dataset.seconds})
    more = f" and {len(dataset.more)} more" if len(dataset.more) else ""
    output.say(
        f"{out}: {counted(len(dataset.train), 'state')} to train on{more}, {len(dataset.test)} to test on, "
        f"{len(dataset.validation)} to validate on"
    )
    if dataset.complete:
        return Exit.DONE
    if clock.limited and clock.passed:
        output.note("the deadline ended the search; what was found so far is saved")
    else:
        output.note("falsework: not every search reached the complete structure; wider ones may")
    return Exit.NO
