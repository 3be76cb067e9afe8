"""`falsework graph`: stable states that searches find, as a graph or as data sets for a policy."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from tyro.conf import arg

from falsework.cli.command import UNSET, JudgingCommand, SeedOption, StructureOptions
from falsework.cli.exit_code import Exit
from falsework.cli.planning import RuleOptions, refuse_unstable, search_directions, writable
from falsework.errors import InputError
from falsework.utils.quantity import counted

if TYPE_CHECKING:
    from falsework.assembly.model import Assembly
    from falsework.cli.output import Output
    from falsework.search.problem.deadline import Deadline
    from falsework.search.problem.task import Task
    from falsework.stability.oracle import StabilityOracle


@dataclass(frozen=True, kw_only=True)
class MakeGraph(JudgingCommand):
    """Search for stable states, and save them with all actions between them.

    States are judged from rest, each by itself, and robots press only with `--presses`. If the search begins at the
    empty structure, the structure can be disassembled from every state of the graph. With --sets the states are saved
    without actions, in disjoint sets for training, validation and test: the training set is that of a narrow search,
    the test set has the states that a wider search finds beyond it, the validation set those of a second wide search.
    Exit code 1 if a search does not reach the other end; the states found are saved in any case.
    """

    rare: ClassVar[tuple[str, ...]] = ("search_from", "seed", "device", "deadline")

    examples: ClassVar[tuple[str, ...]] = (
        "falsework graph bottle --width 64 --robots 2 --out graph.npz",
        "falsework graph arch --sets 64,128 --robots 2 --out data.npz",
    )
    outcomes: ClassVar[tuple[str, str]] = ("complete", "incomplete")

    structure: StructureOptions
    out: Annotated[Path, arg(metavar="FILE")] = Path("graph.npz")
    """File to write, a NumPy archive."""
    task: RuleOptions
    robots: int = 2
    """Number of robots: parts that can be held at a time."""
    width: int = 64
    """States kept at each step; a wider search finds more and takes longer."""
    search_from: Literal["beginning", "end"] = "beginning"
    """End of the assembly from which to search: its beginning, the empty structure, or its end, the complete one."""
    seed: SeedOption = 0
    sets: Annotated[str | None, arg(metavar="WIDTHS", help_behavior_hint=UNSET)] = None
    """Save data sets, from searches of these widths: for training, for the test, and others for more training states,
    such as 64,128 or 64,128,256."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Device of the search; `auto` takes a GPU if there is one. Several processes under torchrun share the work."""
    presses: bool = False
    """Count a state as stable, too, if it stands while robots press parts that they hold; on the CPU, and slower."""
    deadline: Annotated[float | None, arg(metavar="SECONDS", help_behavior_hint=UNSET)] = None
    """Seconds after which the searches of one process end; the states found so far are saved."""

    def run(self, output: Output) -> Exit:
        """Search, connect and save."""
        from falsework.cli.failure import explain
        from falsework.search.beam.settings import BeamSettings
        from falsework.search.device.beam import beam_search
        from falsework.search.find import make_task
        from falsework.search.problem.deadline import Deadline
        from falsework.search.problem.state_graph import StateGraph, save_state_graph
        from falsework.stability import PressOracle
        from falsework.stability.oracle import StabilityOracle
        from falsework.stability.settings import StabilitySettings

        writable(self.out, ".npz")
        clock, shared = Deadline(self.deadline), int(os.environ.get("WORLD_SIZE", "1")) > 1
        if clock.limited and shared:
            raise InputError("processes that share a search cannot end it at a deadline; leave --deadline out")
        widths = None if self.sets is None else self._widths(self.sets)
        if self.presses and shared:
            raise InputError("processes that share a search choose no presses; leave out --presses")
        if self.presses and widths is not None:
            raise InputError("data sets are judged from rest; leave out --presses or --sets")
        assembly = self.structure.load()
        oracle = StabilityOracle(assembly, StabilitySettings(criterion=self.criterion))
        judge, device = (PressOracle(oracle), "cpu") if self.presses else (oracle, self.device)
        if self.presses and self.device == "cuda":
            oracle.use_gpu()  # which answers what stands without presses; these are chosen on the processor
        task = make_task(assembly, self.robots, **self.task.rules(assembly))
        if refuse_unstable(assembly, oracle, task, output, building=True):
            return Exit.NO
        if widths is not None:
            return self._save_sets(assembly, task, oracle, widths, clock, output)
        task = task.judged_by(oracle)
        settings = BeamSettings(self.width, search_directions(self.search_from)[0], seed=self.seed)
        with beam_search(task, judge, settings, device) as (search, first):
            if not first:
                search.run()
                return Exit.DONE
            with output.search_progress() as report:
                result = search.run(progress=report, stop=lambda: clock.passed)
        for note in result.notes:
            output.note(note)
        origin = self.structure.source(self.out)
        graph = StateGraph.from_states(task, search.states(), name=assembly.name, origin=origin)
        save_state_graph(graph, self.out)
        output.file(self.out)
        output.record(
            {
                "criterion": graph.criterion,
                "states": len(graph),
                "actions": len(graph.source),
                "solvable": int(graph.solvable.sum()),
                "presses": self.presses,
                "interrupted": result.interrupted,
                "verdicts": result.counters.asked,
                "seconds": result.seconds,
            }
        )
        output.say(
            f"{counted(len(graph), 'state')} and {counted(len(graph.source), 'action')} between them are in {self.out}"
        )
        if result.interrupted:
            cut = "the deadline ended the search" if clock.passed else "interrupted"
            output.note(f"{cut} at step {result.reached} of {result.steps}; what was found so far is saved")
            return Exit.NO if clock.passed else Exit.INTERRUPTED
        if not result.found:
            output.note(f"falsework: {explain(assembly, oracle, result).text}")
            return Exit.NO
        return Exit.DONE

    def _save_sets(
        self,
        assembly: Assembly,
        task: Task,
        oracle: StabilityOracle,
        widths: tuple[int, ...],
        clock: Deadline,
        output: Output,
    ) -> Exit:
        """Search for solvable states, and save them in disjoint sets for training, validation and test."""
        from falsework.utils.tensors import check_torch

        check_torch()
        from falsework.learn.data.dataset import DataSettings, build_dataset, save_dataset
        from falsework.search.device.oracle import tensor_oracle
        from falsework.utils.distributed import init_distributed

        with init_distributed(self.device) as (shards, chosen), output.bar("searching") as show:
            dataset = build_dataset(
                assembly,
                task,
                DataSettings(widths[0], widths[1], widths[2:], self.seed),
                oracle=tensor_oracle(oracle, chosen),
                device=str(chosen),
                shards=shards,
                report=lambda text: show(0, 0, text),
                stop=(lambda: clock.passed) if clock.limited else None,
            )
            first = shards.is_main_process
        if not first:
            return Exit.DONE
        save_dataset(dataset, self.out)
        output.file(self.out)
        sets = {name: len(getattr(dataset, name)) for name in ("train", "test", "validation", "more")}
        output.record({"criterion": dataset.criterion, "states": sum(sets.values()), "sets": sets})
        output.record({"levels": dataset.levels(), "search_seconds": dataset.seconds})
        more = f" and {sets['more']} more" if sets["more"] else ""
        output.say(
            f"{self.out}: {counted(sets['train'], 'state')} to train on{more}, {sets['test']} to test on, "
            f"{sets['validation']} to validate on"
        )
        if dataset.complete:
            return Exit.DONE
        late = "the deadline ended the search; what was found so far is saved"
        wider = "falsework: not every search reached the complete structure; wider ones may"
        output.note(late if clock.limited and clock.passed else wider)
        return Exit.NO

    def _widths(self, text: str) -> tuple[int, ...]:
        """Return the widths of `--sets`, and refuse options that searches for data sets do not have."""
        others = {"begin": self.task.begin, "end": self.task.end, "missing": self.task.missing}
        given = [name for name, value in others.items() if value is not None]
        given += [name for name in ("width", "search_from") if getattr(self, name) != getattr(type(self), name)]
        if given:
            raise InputError(
                "data sets come from whole searches that begin at the empty structure; "
                f"leave out {' and '.join(f'--{name}'.replace('_', '-') for name in given)}, or --sets"
            )
        try:
            widths = tuple(int(item) for item in text.split(","))
        except ValueError:
            widths = ()
        if len(widths) < 2:
            raise InputError(f"--sets {text}: give the widths of two searches or more, such as 64,128")
        return widths
