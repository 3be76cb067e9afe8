"""`falsework replan`: new plan from the current state."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import numpy as np
from tyro.conf import arg

from falsework.cli.arguments import parse_parts, parse_state
from falsework.cli.command import UNSET, JudgingCommand, StructureOptions
from falsework.cli.exit_code import Exit
from falsework.cli.output import counted
from falsework.cli.planning import HoldOptions, lacks_reserve, promise_lines, writable
from falsework.errors import InputError

if TYPE_CHECKING:
    from falsework.assembly.model import Assembly
    from falsework.cli.output import Output
    from falsework.replanning.request import Request
    from falsework.replanning.result import ReplanResult
    from falsework.search.plans.plan import Plan
    from falsework.stability import StabilitySettings

SHOWN = 8
"""Number of steps that are printed; `falsework check --steps` shows all."""


@dataclass(frozen=True, kw_only=True)
class MakeReplan(JudgingCommand):
    """Plan again from the current state, for instance when a part is late or a robot has failed.

    STRUCTURE may also be a run, the folder that `falsework train` wrote: its policy then proposes the steps, and
    searches take over where it fails. Every state of the new plan is certified as stable. With --direction assembly the
    plan adds parts to the state, with disassembly it removes them. How the state was reached is not known: it is loaded
    from rest. Exit code 1 if there is no plan, none was found, or none that keeps the reserve.
    """

    examples: ClassVar[tuple[str, ...]] = (
        "falsework replan arch:blocks=5 --state complete --out replan.json",
        "falsework replan arch:blocks=5 --state 1000022 --missing 2 --out replan.json",
    )

    structure: StructureOptions
    state: Annotated[str, arg(metavar="STATE")] = "complete"
    """Current state: `complete`, `empty`, digits such as 2110 (0 removed, 1 installed, 2 held), or a file."""
    target: Annotated[str | None, arg(metavar="STATE", help_behavior_hint="(default: complete or empty)")] = None
    """Target state; if not given, the complete structure in assembly, the empty one in disassembly."""
    direction: Literal["auto", "assembly", "disassembly"] = "auto"
    """`assembly` adds parts, `disassembly` removes them; `auto` follows the target, else assembles if the state lacks
    the missing parts, else disassembles."""
    missing: Annotated[str | None, arg(metavar="PARTS", help_behavior_hint=UNSET)] = None
    """Parts not delivered yet, such as 3,4; assembly does without them as long as possible."""
    fixed: Annotated[str | None, arg(metavar="PARTS", help_behavior_hint=UNSET)] = None
    """Parts that must not be held or removed, such as 7."""
    robots: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: 2, or those of the run)")] = None
    """Number of robots: parts that can be held at a time."""
    holds: HoldOptions
    removable_only_if_clear: bool = False
    """Move a part only if it has a collision-free straight exit; always on for a run trained with this rule."""
    alternatives: int = 1
    """Number of plans, as different from each other as possible."""
    seed: int = 0
    """Random seed; results are reproducible on one machine unless the deadline is reached."""
    deadline: Annotated[float | None, arg(metavar="SECONDS", help_behavior_hint=UNSET)] = None
    """Seconds after which the best certified plan so far is returned, loading not counted."""
    compare: Annotated[Path | None, arg(metavar="PLAN", help_behavior_hint=UNSET)] = None
    """Old plan to compare with."""
    confidences: bool = False
    """Report the action probabilities of the policy, with --json."""
    out: Annotated[Path, arg(metavar="FILE")] = Path("replan.json")
    """File to write; alternatives get -2, -3, ... added to its name."""
    device: Literal["auto", "cpu", "cuda"] = "cpu"
    """Device of the policy; `auto` takes a GPU if there is one."""
    solver: Literal["auto", "cpu", "gpu", "exact", "gurobi"] = "cpu"
    """Solver; `auto` takes a GPU where there is one and it is faster."""

    def run(self, output: Output) -> Exit:
        """Replan, compare, save."""
        from falsework.replanning.plan_diff import difference
        from falsework.replanning.replanner import replan
        from falsework.search.plans.plan_file import load_plan

        writable(self.out)
        old = None if self.compare is None else load_plan(self.compare)
        assembly, policy, source, robots, clear = self._load()
        if old is not None and old.identity != assembly.identity:
            raise InputError(f"{self.compare} is a plan for another structure, {old.name}; compare plans of one")
        if self.confidences and policy is None:
            raise InputError("--confidences needs a policy: give a run, the folder that falsework train wrote")
        request = self._request(assembly, robots, clear)
        request.task(assembly)  # refuse bad input before anything is loaded
        stability = self.holds.settings(self.criterion, solver=self.solver)
        answer = replan(assembly, policy=policy, stability=stability, **vars(request))
        if not answer.found:
            self._refuse(assembly, stability, request, answer, output)
            return Exit.NO
        paths = self._save(answer, source)
        record = {"plan": str(paths[0]), "alternatives": [str(path) for path in paths[1:]], **answer.to_dict()}
        first = answer.plans[0]
        record["criterion"], record["reserve"] = first.claim.criterion, first.claim.reserve
        record["presses"] = sum(map(bool, first.presses))
        if self.confidences:
            record["confidences"] = [_probabilities(row, assembly) for row in answer.confidences[0]]
        changes = None if old is None else difference(old, answer.plans[0])
        output.record(record if changes is None else {**record, "difference": changes.to_dict()})
        self._tell(answer, paths, output)
        if changes is not None:
            output.say(f"compared with {self.compare}: {changes.text}")
        remarks = [_replay_remark(answer), lacks_reserve(answer.plans[0], stability.reserve)]
        for remark in filter(None, remarks):
            output.note(f"falsework: {remark}")
        return Exit.NO if any(remarks) else Exit.DONE

    def _load(self) -> tuple[Assembly, Any, dict[str, Any], int, bool]:
        """Load the structure, its source, the policy if any, the number of robots, and the exit rule."""
        folder = Path(self.structure.spec)
        if not (folder / "run.json").is_file():
            robots = 2 if self.robots is None else self.robots
            return self.structure.load(), None, self.structure.source(self.out), robots, self.removable_only_if_clear
        if self.structure.given():
            option = next(iter(self.structure.given()))
            raise InputError(f"--{option}: a run is for one structure as it was trained; leave the option out")
        from falsework.utils.optional_packages import check_torch

        check_torch()
        import torch

        from falsework.learn.training.checkpoint import load_run

        # Single states make for small matrices, which threads only get in each other's way with.
        torch.set_num_threads(1)
        run = load_run(folder, self.device)
        source = dict(run.metadata["structure"]["source"])
        if "path" in source:
            path = (folder.resolve() / source["path"]).resolve()
            source["path"] = Path(os.path.relpath(path, self.out.resolve().parent)).as_posix()
        robots = run.settings.robots if self.robots is None else self.robots
        clear = self.removable_only_if_clear or run.settings.removable_only_if_clear
        return run.assembly, run.policy, source, robots, clear

    def _request(self, assembly: Assembly, robots: int, clear: bool) -> Request:
        from falsework.replanning.request import Request
        from falsework.search.problem.task import Direction

        return Request(
            parse_state(self.state, "--state", assembly),
            target=None if self.target is None else parse_state(self.target, "--target", assembly),
            direction=None if self.direction == "auto" else Direction(self.direction),
            robots=robots,
            missing=() if self.missing is None else parse_parts(self.missing, "--missing", assembly.names),
            fixed=() if self.fixed is None else parse_parts(self.fixed, "--fixed", assembly.names),
            alternatives=self.alternatives,
            seed=self.seed,
            deadline=self.deadline,
            removable_only_if_clear=clear,
            confidences=self.confidences,
        )

    def _save(self, answer: ReplanResult, source: dict[str, Any]) -> list[Path]:
        from falsework.search.plans.plan_file import save_plan

        paths = []
        for number, plan in enumerate(answer.plans, 1):
            path = self.out if number == 1 else self.out.with_stem(f"{self.out.stem}-{number}")
            save_plan(replace(plan, source=source), path)
            paths.append(path)
        return paths

    def _tell(self, answer: ReplanResult, paths: list[Path], output: Output) -> None:
        plan = answer.plans[0]
        output.say(
            f"{paths[0]}: {counted(len(plan), 'step')} of {answer.direction.value} with "
            f"{counted(plan.robots, 'robot')}, every state proven stable (criterion {plan.claim.criterion}, decided by "
            f"{answer.decided_by.value}, {answer.seconds:.2f} s, {answer.verdicts} verdicts)"
        )
        for line in promise_lines(plan):
            output.say(line)
        output.say(_first_steps(plan))
        for need in plan.needs:
            output.say(f"{plan.part_names[need.part]} is needed after {need.after_parts} other parts are placed")
        if len(paths) > 1:
            least = answer.distance[~np.eye(len(paths), dtype=bool)].min()
            others = ", ".join(str(path) for path in paths[1:])
            output.say(f"alternatives in {others}; the two plans most alike differ by {least:.2f} of 1")
        if len(paths) < self.alternatives:
            output.note(f"only {len(paths)} of the {self.alternatives} requested plans were found")
        if answer.deadline_passed:
            output.note("the deadline ended the search; more time may give more plans, or need missing parts later")

    def _refuse(
        self, assembly: Assembly, stability: StabilitySettings, request: Request, answer: ReplanResult, output: Output
    ) -> None:
        """Report why there is no plan, and which parts move where the search ended."""
        from falsework.cli.failure import explain
        from falsework.cli.velocity_text import describe, motions
        from falsework.search.problem.result import Outcome
        from falsework.stability import Stability
        from falsework.stability.motion import motion_of

        oracle, moving = Stability(assembly, replace(stability, reserve=1.0)), []
        word = "no plan exists" if answer.outcome is Outcome.PROVED_IMPOSSIBLE else "no plan was found"
        text = f"{word}: {answer.reason}"
        if answer.search is None:  # one of the two ends may be unstable, which ends the work before any search
            task = request.task(assembly)
            verdicts = oracle.verdicts(np.stack([task.start, task.target]), require_certificate=True)
            row = int(np.argmin(verdicts.stable))
            motion = motion_of(assembly, verdicts, row)
            moving = [] if motion is None else motions(assembly, motion)
        elif not answer.deadline_passed:
            failure = explain(assembly, oracle, answer.search)
            moving, text = failure.moving, failure.text
        record = {**answer.to_dict(), "plan": None, "criterion": self.criterion}
        record["moving"] = [motion.to_dict(assembly) for motion in moving]
        output.record(record)
        if moving and answer.search is None:
            text = f"{text}; {describe(assembly, moving, limit=3)}"
        output.note(f"falsework: {text}")


def _replay_remark(answer: ReplanResult) -> str:
    """Return what the deadline left open of the replay of the first plan; empty if the replay succeeds."""
    if not answer.replays or answer.replays[0].stands:
        return ""
    replayed = answer.replays[0]
    if replayed.stands is None:
        return f"the deadline left time to replay {replayed.steps} of the {counted(replayed.of, 'step')} of assembly"
    return f"the deadline left no time for another plan; the replay of this one fails at step {replayed.steps + 1}"


def _first_steps(plan: Plan) -> str:
    """Describe the first steps of a plan."""
    if len(plan) == 0:
        return "nothing is left to do"
    words = [plan.describe(step) for step in range(min(len(plan), SHOWN))]
    rest = len(plan) - len(words)
    return f"from here on: {', '.join(words)}{f', and {rest} steps more' if rest else ''}"


def _probabilities(row: Any, assembly: Assembly) -> dict[str, float]:
    """Return actions that a policy may take in a state, with their probabilities."""
    parts = assembly.part_count
    words = ("hold", "remove")
    return {
        f"{words[action >= parts]} {assembly.names[action % parts]}": round(float(row[action]), 6)
        for action in np.argsort(-row, kind="stable").tolist()
        if row[action] > 0
    }
