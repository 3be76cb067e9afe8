"""`falsework replan`: new plan from the current state."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import numpy as np
from tyro.conf import arg

from falsework.cli.arguments import parse_parts, parse_state
from falsework.cli.command import UNSET, Command, CriterionOfPlan, SolverOption, StructureOptions
from falsework.cli.exit_code import Exit
from falsework.cli.hold_options import HoldOptions
from falsework.cli.planning import (
    PartRuleOptions,
    RareExitOptions,
    first_steps,
    lacks_reserve,
    need_text,
    reserve_lines,
    save_plans,
    say_alternatives,
    untried_changes,
    writable_plan,
)
from falsework.errors import InputError
from falsework.utils.quantity import counted

if TYPE_CHECKING:
    from falsework.assembly.model import Assembly
    from falsework.cli.output import Output
    from falsework.learn.training.checkpoint import Run
    from falsework.replanning.request import Request
    from falsework.replanning.result import ReplanResult
    from falsework.replanning.since import SiteSteps
    from falsework.search.plans.plan import Plan
    from falsework.stability.settings import StabilitySettings


@dataclass(frozen=True, kw_only=True)
class MakeReplan(Command):
    """Plan again from the current state, for instance when a part is late or a robot has failed.

    STRUCTURE is the plan that is being carried out, with its last step that is done: the new plan begins with the steps
    that are done, so that steps keep their numbers, and keeps the criterion, reserve and robots of the old one unless
    others are given. Or it is a structure, in a state that is given by --state. It may also be a run, the folder that
    `falsework train` wrote: its policy then proposes the steps, and searches take over where it fails. Every state of
    the new plan is certified as stable. With --order assembly the plan adds parts to the state, with disassembly it
    removes them. How a state that is given by itself was reached is not known: it is loaded from rest. As deadlines are
    short, the new plan is not tried under changes of settings; `falsework check --replay` does that. Exit code 1 if
    there is no plan, none was found, or none that keeps the reserve.
    """

    rare: ClassVar[tuple[str, ...]] = (
        "of",
        "alternatives",
        "seed",
        "policy",
        "confidences",
        "device",
        "solver",
        "prop",
    )

    examples: ClassVar[tuple[str, ...]] = (
        "falsework replan plan.json --step 4 --missing 3 --out replan.json",
        "falsework replan plan.json --step 5 --hold voussoir-0 --out replan.json",
        "falsework replan arch:blocks=5 --state voussoir-0,voussoir-4 --missing 2 --order assembly --out replan.json",
    )

    outcomes: ClassVar[tuple[str, str]] = ("found", "not_found")

    structure: StructureOptions
    step: Annotated[int | None, arg(metavar="N", help_behavior_hint=UNSET)] = None
    """Last step of the plan that is done; 0 for none."""
    state: Annotated[str | None, arg(metavar="STATE", help_behavior_hint="(default: complete)")] = None
    """Current state: `complete`, `empty`, a plan and its step such as plan.json:31, parts that stand and that are held
    such as 0-16,keystone,held:left, digits such as 2110 (0 removed, 1 installed, 2 held), or a file."""
    target: Annotated[str | None, arg(metavar="STATE", help_behavior_hint="(default: complete or empty)")] = None
    """Target state; if not given, the complete structure in assembly, the empty one in disassembly."""
    of: Annotated[str | None, arg(name="structure", metavar="STRUCTURE", help_behavior_hint=UNSET)] = None
    """Structure of the plan, instead of the one that the plan names."""
    order: Literal["auto", "assembly", "disassembly"] = "auto"
    """Order of the plan: `assembly` adds parts, `disassembly` removes them; `auto` follows the target, else assembles
    if the state lacks the missing parts, else disassembles."""
    prop: Annotated[str | None, arg(metavar="PARTS", help_behavior_hint=UNSET)] = None
    """Parts under which props have been placed since the step of the plan; the plan goes on with these props."""
    hold: Annotated[str | None, arg(metavar="PARTS", help_behavior_hint=UNSET)] = None
    """Parts of which robots have taken hold since the step of the plan."""
    release: Annotated[str | None, arg(metavar="PARTS", help_behavior_hint=UNSET)] = None
    """Parts of which robots have let go since the step of the plan."""
    rules: PartRuleOptions
    robots: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: 2, or those of the plan or run)")] = (
        None
    )
    """Number of robots: parts that can be held at a time."""
    exits: RareExitOptions
    holds: HoldOptions
    criterion: CriterionOfPlan = None
    alternatives: int = 1
    """Number of plans, as different from each other as possible."""
    seed: int = 0
    """Random seed; results are reproducible on one machine unless the deadline is reached."""
    deadline: Annotated[float | None, arg(metavar="SECONDS", help_behavior_hint=UNSET)] = None
    """Seconds after which the best certified plan so far is returned, loading not counted."""
    compare: Annotated[Path | None, arg(metavar="PLAN", help_behavior_hint=UNSET)] = None
    """Old plan to compare with."""
    policy: Annotated[Path | None, arg(metavar="RUN", help_behavior_hint=UNSET)] = None
    """Trained run whose policy proposes the steps, of this structure or of a policy for any, or `general` for the one
    that comes with this program; for a run in place of the structure that is its own."""
    confidences: bool = False
    """Report the action probabilities of the policy, with --json."""
    out: Annotated[Path, arg(metavar="FILE")] = Path("replan.json")
    """File to write; alternatives get -2, -3, ... added to its name."""
    device: Literal["auto", "cpu", "cuda"] = "cpu"
    """Device of the policy; `auto` takes a GPU if there is one."""
    solver: SolverOption = "cpu"

    def run(self, output: Output) -> Exit:
        """Replan, compare, save."""
        from falsework.replanning.plan_diff import difference
        from falsework.replanning.replanner import replan
        from falsework.replanning.since import with_places
        from falsework.search.plans.plan_file import load_plan

        writable_plan(self.out)
        plan, assembly, policy, source, robots, clear = self._load()
        before, since, step = plan, self._since(assembly), self.step
        if since:
            if before is None or step is None:
                raise InputError("--prop, --hold and --release are about a step of a plan; give the plan and --step")
            plan, assembly = since.after(before, step, assembly, robots)
            before, step = with_places(before, assembly), len(plan)
        if self.policy is not None:
            if policy is not None:
                raise InputError(f"{self.structure.spec} is a run already; leave --policy out, or name the structure")
            policy = self._load_run(self.policy, assembly).policy
        old = before if self.compare is None else load_plan(self.compare)
        if old is not None and old.identity != assembly.identity:
            raise InputError(f"{self.compare} is a plan for another structure, {old.name}; compare plans of one")
        if self.confidences and policy is None:
            raise InputError(
                "--confidences needs a policy: give a run, the folder that falsework train wrote, or --policy"
            )
        request = self._request(plan, step, assembly, robots, clear)
        request.task(assembly)  # refuse bad input before anything is loaded
        stability = self.holds.settings_from(plan, assembly, self.criterion, self.solver)
        options = {name: value for name, value in vars(request).items() if name != "plan"}
        subject, structure = (assembly, None) if plan is None or self.step is None else (plan, assembly)
        answer = replan(subject, structure=structure, policy=policy, stability=stability, **options)
        if not answer.found:
            self._refuse(assembly, stability, request, answer, output)
            return Exit.NO
        paths = [path for path, _ in save_plans(answer.plans, self.out, lambda _: source)]
        for path in paths:
            output.file(path)
        record = _record(answer)
        first = answer.plans[0]
        record["criterion"], record["reserve"] = first.claim.criterion, first.claim.reserve
        record["presses"] = sum(map(bool, first.presses))
        record["varied"] = None if first.replay is None else first.replay.varied
        if self.confidences:
            record["confidences"] = [_probabilities(row, assembly) for row in answer.confidences[0]]
        changes = None if old is None else difference(old, answer.plans[0], answer.direction, answer.built)
        output.record(record if changes is None else {**record, "difference": changes.to_dict()})
        self._tell(answer, paths, output)
        if changes is not None:
            output.say(f"compared with {self.compare or self.structure.spec}: {changes.text}")
        for text in () if plan is None else _not_asked(plan):
            output.note(f"falsework: {text}")
        remarks = [answer.open_replay, lacks_reserve(answer.plans[0], stability.reserve, answer.unreserved)]
        for remark in filter(None, remarks):
            output.note(f"falsework: {remark}")
        return output.outcome("weaker") if any(remarks) else Exit.DONE

    def _load(self) -> tuple[Plan | None, Assembly, Any, Mapping[str, Any] | None, int, bool]:
        """Load the plan if any, the structure, policy and source, the number of robots, and the exit rule."""
        from falsework.search.plans.plan_file import is_plan_file

        file = Path(self.structure.spec)
        if is_plan_file(file) or (self.step is not None and file.suffix == ".json" and not file.exists()):
            return self._load_plan(file)
        for name, given in (("--step", self.step), ("--structure", self.of)):
            if given is not None:
                raise InputError(
                    f"{name} {given} is of a plan, which {self.structure.spec} is not; give the plan, or --state"
                )
        return (None, *self._load_structure())

    def _load_plan(self, file: Path) -> tuple[Plan, Assembly, None, Mapping[str, Any] | None, int, bool]:
        from falsework.search.plans.plan_check import check_identity
        from falsework.search.plans.plan_file import load_plan
        from falsework.search.plans.plan_source import moved_source, structure_of_plan

        plan = load_plan(file)
        assembly = structure_of_plan(plan, file, self.of, **self.structure.given())
        check_identity(plan, assembly)
        if self.step is None and self.state is None:
            raise InputError(f"{file} has {len(plan)} steps; name the last one that is done by --step, 0 for none")
        source = moved_source(plan, file, self.out)
        if self.of is not None:
            source = replace(self.structure, spec=self.of).source(self.out)
        robots = plan.robots if self.robots is None else self.robots
        return plan, assembly, None, source, robots, self.rules.removable_only_if_clear or plan.removable_only_if_clear

    def _load_run(self, folder: Path, assembly: Assembly | None = None) -> Run:
        from falsework.utils.tensors import check_torch

        check_torch()
        import torch

        from falsework.learn.training.checkpoint import load_run

        # Single states make for small matrices, which threads only get in each other's way with.
        torch.set_num_threads(1)
        return load_run(folder, self.device, assembly=assembly)

    def _load_structure(self) -> tuple[Assembly, Any, Mapping[str, Any], int, bool]:
        folder = Path(self.structure.spec)
        if not (folder / "run.json").is_file():
            robots = 2 if self.robots is None else self.robots
            return (
                self.structure.load(),
                None,
                self.structure.source(self.out),
                robots,
                self.rules.removable_only_if_clear,
            )
        if self.structure.given():
            option = next(iter(self.structure.given()))
            raise InputError(f"--{option}: a run is for one structure as it was trained; leave the option out")
        run = self._load_run(folder)
        source = dict(run.metadata["structure"]["source"])
        if "path" in source:
            path = (folder.resolve() / source["path"]).resolve()
            source["path"] = Path(os.path.relpath(path, self.out.resolve().parent)).as_posix()
        robots = run.settings.robots if self.robots is None else self.robots
        clear = self.rules.removable_only_if_clear or run.settings.removable_only_if_clear
        return run.assembly, run.policy, source, robots, clear

    def _since(self, assembly: Assembly) -> SiteSteps:
        from falsework.replanning.since import SiteSteps

        options = (("--prop", self.prop), ("--hold", self.hold), ("--release", self.release))
        return SiteSteps(*(() if text is None else parse_parts(text, name, assembly.names) for name, text in options))

    def _request(self, plan: Plan | None, step: int | None, assembly: Assembly, robots: int, clear: bool) -> Request:
        from falsework.replanning.request import Request
        from falsework.search.problem.task import Direction

        parts = self.rules.parts(assembly)
        return Request(
            None if self.state is None else parse_state(self.state, "--state", assembly),
            plan=None if step is None else plan,
            step=step,
            target=None if self.target is None else parse_state(self.target, "--target", assembly),
            direction=None if self.order == "auto" else Direction(self.order),
            robots=robots,
            missing=parts["missing"],
            fixed=parts["fixed"],
            alternatives=self.alternatives,
            seed=self.seed,
            deadline=self.deadline,
            removable_only_if_clear=clear,
            confidences=self.confidences,
            **self.exits.exits(*([] if plan is None else [plan])),
        )

    def _tell(self, answer: ReplanResult, paths: list[Path], output: Output) -> None:
        plan, fewer = answer.plans[0], ""
        if answer.built and self.robots is not None and self.robots < plan.robots:
            fewer = f", {self.robots} from step {answer.built + 1} on"
        whole = not answer.replays or answer.replays[0].stands
        proven = plan.claim.proves if whole else "stable, though not all as built"
        output.say(
            f"{paths[0]}: {counted(len(plan), 'step')} of {answer.direction.value} with "
            f"{counted(plan.robots, 'robot')}{fewer}, every state proven {proven} "
            f"(criterion {plan.claim.criterion}, decided by {answer.decided_by.value}, {answer.seconds:.2f} s, "
            f"{counted(answer.verdicts, 'verdict')})"
        )
        for line in filter(None, (*reserve_lines(plan), untried_changes(plan))):
            output.say(line)
        since = f"from step {answer.built + 1} on" if answer.built else "from here on"
        output.say(f"{since}: {first_steps(plan, answer.direction, answer.built)}")
        for need in plan.needs:
            output.say(need_text(plan, need, answer.built))
        least = float(answer.distance[~np.eye(len(paths), dtype=bool)].min(initial=1.0))
        say_alternatives(paths, least, self.alternatives, output)
        if answer.deadline_passed:
            output.note("the deadline ended the search; more time may give more plans, or need missing parts later")

    def _refuse(
        self, assembly: Assembly, stability: StabilitySettings, request: Request, answer: ReplanResult, output: Output
    ) -> None:
        """Report why there is no plan, and which parts move where the search ended."""
        from falsework.cli.failure import explain
        from falsework.cli.velocity_text import describe, motions_at
        from falsework.search.problem.result import Outcome
        from falsework.stability.oracle import StabilityOracle

        oracle, moving = StabilityOracle(assembly, replace(stability, reserve=1.0)), []
        word = "no plan exists" if answer.outcome is Outcome.PROVED_IMPOSSIBLE else "no plan was found"
        text = f"{word}: {answer.reason}"
        if answer.search is None:  # one of the two ends may be unstable, which ends the work before any search
            task = request.task(assembly)
            verdicts = oracle.verdicts(np.stack([task.start, task.target]), require_certificate=True)
            moving = motions_at(assembly, verdicts, int(np.argmin(verdicts.stable)))
        elif not answer.deadline_passed:
            failure = explain(assembly, oracle, answer.search)
            moving, text = failure.moving, failure.text
        output.outcome("impossible" if answer.outcome is Outcome.PROVED_IMPOSSIBLE else "not_found")
        record = {**_record(answer), "criterion": stability.criterion}
        record["moving"] = [motion.to_dict(assembly) for motion in moving]
        output.record(record)
        if moving and answer.search is None:
            text = f"{text}; {describe(assembly, moving, limit=3)}"
        output.note(f"falsework: {text}")


def _not_asked(plan: Plan) -> list[str]:
    """Return what a plan was made to keep that is not asked of one that goes on with it."""
    found = []
    if plan.margins is not None and plan.margins.demands:
        found.append(f"the margins that the old plan keeps ({plan.margins.demands}) are not asked of this one")
    if plan.replay is not None and plan.replay.judgement is not None and plan.replay.judgement.stands:
        found.append(
            "discrete elements build the old plan, but were not asked about this one; falsework check --judge does"
        )
    return found


def _record(answer: ReplanResult) -> dict[str, Any]:
    """Return the result as fields of the JSON answer, which has the outcome itself."""
    return {name: value for name, value in answer.to_dict().items() if name != "outcome"}


def _probabilities(row: Any, assembly: Assembly) -> dict[str, float]:
    """Return actions that a policy may take in a state, with their probabilities."""
    parts = assembly.part_count
    words = ("hold", "remove")
    return {
        f"{words[action >= parts]} {assembly.names[action % parts]}": round(float(row[action]), 6)
        for action in np.argsort(-row, kind="stable").tolist()
        if row[action] > 0
    }
