"""`falsework graph`: state graph with the stable states that a search finds and all actions between them."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from tyro.conf import arg

from falsework.cli.command import UNSET, JudgingCommand, StructureOptions
from falsework.cli.exit_code import Exit
from falsework.cli.planning import SearchOptions, TaskOptions, refuse_unstable, writable
from falsework.errors import InputError

if TYPE_CHECKING:
    from falsework.cli.output import Output


@dataclass(frozen=True, kw_only=True)
class MakeGraph(JudgingCommand):
    """Search for stable states, and save them with all actions between them.

    States are judged from rest, each by itself, and robots press only with `--presses`. If the search begins at the
    empty structure, the structure can be disassembled from every state of the graph. Exit code 1 if the search does not
    reach the other end; the states found are saved in any case.
    """

    examples: ClassVar[tuple[str, ...]] = ("falsework graph bottle --width 64 --robots 2 --out graph.npz",)

    structure: StructureOptions
    out: Annotated[Path, arg(metavar="FILE")] = Path("graph.npz")
    """File to write, a NumPy archive."""
    task: TaskOptions
    search: SearchOptions
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Device of the search; `auto` takes a GPU if there is one. Several processes under torchrun share the work."""

    presses: bool = False
    """Count a state as stable, too, if it stands while robots press parts that they hold; on the CPU, and slower."""
    deadline: Annotated[float | None, arg(metavar="SECONDS", help_behavior_hint=UNSET)] = None
    """Seconds after which the search of one process ends; the states found so far are saved."""

    def run(self, output: Output) -> Exit:
        """Search, connect and save."""
        from falsework.cli.failure import explain
        from falsework.search.backend import beam_search
        from falsework.search.problem.deadline import Deadline
        from falsework.search.problem.state_graph import StateGraph, save_state_graph
        from falsework.stability import PressingStability, Stability, StabilitySettings

        writable(self.out, ".npz")
        clock = Deadline(self.deadline)
        if clock.limited and int(os.environ.get("WORLD_SIZE", "1")) > 1:
            raise InputError("processes that share a search cannot end it at a deadline; leave --deadline out")
        if self.presses and self.device == "cuda":
            raise InputError("presses are chosen on the CPU; leave out --presses or --device cuda")
        if self.presses and int(os.environ.get("WORLD_SIZE", "1")) > 1:
            raise InputError("processes that share a search choose no presses; leave out --presses")
        assembly = self.structure.load()
        oracle = Stability(assembly, StabilitySettings(criterion=self.criterion))
        judge, device = (PressingStability(oracle), "cpu") if self.presses else (oracle, self.device)
        task = self.task.task(assembly).judged_by(oracle)
        if refuse_unstable(assembly, oracle, task, output):
            return Exit.NO
        with beam_search(task, judge, self.search.settings(), device) as (search, first):
            if not first:
                search.run()
                return Exit.DONE
            with output.search_progress() as report:
                result = search.run(progress=report, stop=lambda: clock.passed)
        for note in result.notes:
            output.note(note)
        graph = StateGraph.build(task, search.states(), name=assembly.name)
        save_state_graph(graph, self.out)
        output.record(
            {
                "out": str(self.out),
                "criterion": graph.criterion,
                "states": len(graph),
                "actions": len(graph.source),
                "solvable": int(graph.solvable.sum()),
                "presses": self.presses,
                "found": result.found,
                "interrupted": result.interrupted,
                "asked": result.counters.asked,
                "seconds": result.seconds,
            }
        )
        output.say(f"{len(graph)} states and {len(graph.source)} actions between them are in {self.out}")
        if result.interrupted:
            cut = "the deadline ended the search" if clock.passed else "interrupted"
            output.note(f"{cut} at step {result.reached} of {result.steps}; what was found so far is saved")
            return Exit.NO if clock.passed else Exit.INTERRUPTED
        if not result.found:
            output.note(f"falsework: {explain(assembly, oracle, result).text}")
            return Exit.NO
        return Exit.DONE
