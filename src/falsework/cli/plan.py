"""`falsework plan`: sequence of hold and remove actions in which every state is proven stable."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from tyro.conf import arg

from falsework.cli.command import (
    UNSET,
    Command,
    ConeOption,
    CriterionOption,
    SeedOption,
    SolverOption,
    StructureOptions,
    settlement_record,
)
from falsework.cli.exit_code import Exit
from falsework.cli.hold_options import HoldOptions
from falsework.cli.planning import (
    RegraspOptions,
    first_steps,
    lacks_of,
    load_record,
    need_text,
    policy_guide,
    refuse_unstable,
    reserve_lines,
    save_plans,
    say_alternatives,
    search_directions,
    writable_plan,
)
from falsework.errors import InputError
from falsework.utils.quantity import check_deadline, counted

if TYPE_CHECKING:
    from falsework.cli.output import Output
    from falsework.search.margins.demands import Demands
    from falsework.search.plans.alternatives import Alternatives
    from falsework.search.plans.plan import Plan
    from falsework.search.settings import PlannerSettings


_COMPARED = ("maximise_margin", "resume", "guide", "robust", "judge")
_WIDER = ("--allow-regrasp", "--props")
_EXCLUDED: dict[str, tuple[str, ...]] = {
    "--robots auto": ("--alternatives", "--resume", "--maximise-margin", "--guide"),
    "--parts-at-once": ("--resume",),
    "--allow-regrasp": ("--missing", "--alternatives", "--resume"),
    "--props": ("--missing", "--alternatives", "--resume"),
    "--maximise-margin": ("--alternatives", "--resume"),
    "--guide": (*_WIDER, "--maximise-margin"),
    "--robust": ("--criterion equilibrium",),
    "--judge": ("--criterion equilibrium",),
}
"""Options that exclude others."""


@dataclass(frozen=True, kw_only=True)
class MakePlan(Command):
    """Plan the assembly of a structure by robots; undone from the last step on, a plan takes it apart.

    Quick narrow searches come first, wider ones if they fail. Every state of the plan is certified as stable, and the
    whole plan is replayed with contact history. Exit code 1 if there is no plan or none was found; the report states
    which, the progress of the search, and the parts that would move there. An interrupted search is saved beside the
    plan; the same command with --resume continues it.
    """

    rare: ClassVar[tuple[str, ...]] = (
        "width",
        "search_from",
        "guide",
        "seed",
        "cone",
        "solver",
        "maximise_margin",
        "robust",
        "judge",
        "proofs",
    )

    outcomes: ClassVar[tuple[str, str]] = ("found", "not_found")
    examples: ClassVar[tuple[str, ...]] = (
        "falsework plan vault --robots 2 --out plan.json",
        "falsework plan arch --robots auto --deadline 120 --out plan.json",
        "falsework plan my-folder --missing 3,4 --alternatives 5 --out plan.json",
        "falsework plan arch --margin friction=1.25,tilt=1deg --out safe.json",
        "falsework plan arch --maximise-margin friction --out strong.json",
        "falsework plan arch:blocks=7 --ground --robots 1 --props 3 --out propped.json",
        "falsework plan shelf --robots 2 --parts-at-once 2 --out shelf.json",
    )

    structure: StructureOptions
    out: Annotated[Path, arg(metavar="FILE")] = Path("plan.json")
    """File to write; alternatives get -2, -3, ... added to its name."""
    task: RegraspOptions
    holds: HoldOptions
    robots: Annotated[str, arg(metavar="NUMBER")] = "2"
    """Number of robots: parts that can be held at a time; `auto` for the fewest with which a plan is found."""
    alternatives: int = 1
    """Number of plans, as different from each other as possible."""
    width: int = 1024
    """Widest search that is tried, in states kept at each step."""
    search_from: Literal["both", "beginning", "end"] = "both"
    """Ends of the assembly from which to search: its beginning, the empty structure; its end, the complete one; or both
    in turn."""
    guide: Annotated[Path | None, arg(metavar="RUN", help_behavior_hint="(default: support first)")] = None
    """Trained run, of this structure or of a policy for any, or `general` for the one that comes with this program: its
    policy says which actions a search tries first. Without it, parts with much support are inserted first."""
    seed: SeedOption = 0
    criterion: CriterionOption = "contact"
    cone: ConeOption = None
    solver: SolverOption = "cpu"
    margin: Annotated[str | None, arg(metavar="MARGINS", help_behavior_hint=UNSET)] = None
    """Margins that every state must keep: friction=1.25 (factor of safety), tilt=2deg, horizontal=0.05g, push=20N (on
    any free face), load=1kN (on any installed part), placement=1mm; several are separated by commas."""
    maximise_margin: Annotated[Literal["friction", "tilt", "push"] | None, arg(help_behavior_hint=UNSET)] = None
    """Search for the plan whose weakest step has the largest margin of this kind, and report an upper bound."""
    robust: bool = False
    """Accept only a plan whose replay also succeeds under 16 changes of settings (stiffness ratio, damping, release,
    stiffness of holds, initial friction, errors of presses), in place of the four of plans with a reserve."""
    judge: bool = False
    """Accept only a plan that an independent method builds too, with its presses, under the true friction: discrete
    elements on springs as stiff as the contacts of the criterion. It takes seconds to minutes for each plan that the
    search finds. Where it accepts none, the one that it builds farthest is written, with exit code 1."""
    proofs: bool = False
    """Write the proof of each state into the plan: displacements, or contact forces under `equilibrium`."""
    deadline: Annotated[float | None, arg(metavar="SECONDS", help_behavior_hint=UNSET)] = None
    """Seconds after which the search ends with the best it has, and is saved like an interrupted one. Without it, that
    for --robots auto ends after as many verdicts as take about a minute."""
    resume: bool = False
    """Resume the interrupted search."""

    def run(self, output: Output) -> Exit:
        """Search, prove and save."""
        from falsework.cli.demands import explain_shortfall, refuse_weak_end
        from falsework.cli.failure import explain
        from falsework.search.find import find_plans, make_task
        from falsework.search.margins.demands import Demands, MarginOracle
        from falsework.search.maximise import maximise_margin
        from falsework.search.problem.deadline import Deadline
        from falsework.stability.oracle import StabilityOracle

        self._refuse_pairs()
        saves = not self.task.wider and self.task.parts_at_once == 1
        demands = Demands() if self.margin is None else Demands.from_text(self.margin)

        writable_plan(self.out)
        check_deadline(self.deadline)
        if self.robots == "auto":
            return self._with_fewest_robots(demands, output)
        settings, checkpoint = self._settings(), self._checkpoint() if saves else None
        assembly = self.task.with_places(self.structure.load())
        output.record(settlement_record(assembly))
        if assembly.boundary.all():
            raise InputError(f"every part of {assembly.name} is boundary, so there is nothing to plan; fix fewer parts")
        clock = Deadline(self.deadline)
        task = make_task(assembly, self._robot_count(), **self.task.rules(assembly))
        stability = self.holds.settings(self.criterion, self.cone, self.solver)
        plain = StabilityOracle(assembly, replace(stability, reserve=1.0))
        directions = settings.directions if self.maximise_margin is None else ()
        if refuse_unstable(assembly, plain, task, output, directions, building=True):
            return Exit.NO
        demanding = MarginOracle(assembly, stability, demands) if demands else None
        oracle = demanding or plain
        guide = policy_guide(self.guide, assembly, task.judged_by(oracle))
        if demanding is not None and refuse_weak_end(demanding, task, output):
            return Exit.NO
        with output.search_progress() as report:
            if self.maximise_margin is not None:
                planning = maximise_margin(
                    assembly,
                    task,
                    self.maximise_margin,
                    stability=stability,
                    demands=demands,
                    settings=settings,
                    progress=report,
                    stop=lambda: clock.passed,
                    forces=self.proofs,
                )
                planning = replace(planning, deadline_passed=clock.passed)
            else:
                planning = find_plans(
                    assembly,
                    task,
                    oracle=oracle if demanding is not None or stability.reserve == 1 else None,
                    stability=stability,
                    settings=settings,
                    guide=guide,
                    progress=report,
                    deadline=clock.rest,
                    checkpoint=checkpoint,
                    forces=self.proofs,
                )
        result = planning.result
        cut = "the deadline ended the search" if planning.deadline_passed else "interrupted"
        saved = f"it is saved in {checkpoint}, the same command with --resume continues it"
        if self.maximise_margin is not None or checkpoint is None or not checkpoint.is_file():
            stronger = self.maximise_margin is not None and planning.found
            saved = f"{'a stronger plan may exist; ' * stronger}the same command begins anew"
        if planning.found:
            seconds, asked = result.seconds, result.counters.asked
            output.record({"verdicts": asked, "seconds": seconds})
            self._report(self._save(planning.plans), planning.alternatives, seconds, asked, output)
            if result.interrupted:
                output.note(f"{cut}; {saved}")
            first = planning.plans[0]
            lacking = lacks_of(first, stability.reserve, planning.unreserved, robust=self.robust, judged=self.judge)
            for lack in lacking:
                output.note(f"falsework: {lack}")
            if lacking:
                return output.outcome("weaker")
        else:
            failure = explain(assembly, oracle, result)
            lacks, words = ({}, "") if demanding is None else explain_shortfall(demanding, result)
            output.outcome(failure.outcome)
            output.record(failure.to_dict(assembly) | ({"shortfall": lacks} if demanding is not None else {}))
            reason = f"{failure.in_which(f'every state keeps {demands}') if lacks else failure.text}{words}"
            if failure.proven and self.task.moves > 1 and not self.task.turns:
                reason += "; that holds for any number of straight moves, turns were not allowed"
            output.note(f"{cut}: {reason}; {saved}" if result.interrupted else f"falsework: {reason}")
            if planning.fallen is not None:
                self._show_fallen(planning.fallen, output)
        if result.interrupted and not planning.deadline_passed:
            return Exit.INTERRUPTED
        return Exit.DONE if planning.found else Exit.NO

    def _refuse_pairs(self) -> None:
        """Refuse options that exclude each other."""
        given = {
            "--allow-regrasp": self.task.allow_regrasp,
            "--props": self.task.props > 0,
            "--missing": self.task.missing is not None,
            "--parts-at-once": self.task.parts_at_once > 1,
            "--robots auto": self.robots == "auto",
            "--criterion equilibrium": self.criterion == "equilibrium",
            "--margin": self.margin is not None,
        }
        given |= {f"--{name.replace('_', '-')}": bool(getattr(self, name)) for name in _COMPARED}
        given["--alternatives"] = self.alternatives > 1
        for option, others in _EXCLUDED.items():
            wrong = [other for other in others if given[option] and given[other]]
            if wrong:
                raise InputError(f"{option} takes no {' and no '.join(wrong)} yet; leave one of the two out")

    def _with_fewest_robots(self, demands: Demands, output: Output) -> Exit:
        """Search for the fewest robots, and save the plan found with them."""
        from falsework.cli.demands import refuse_weak_end
        from falsework.cli.min_robots import report
        from falsework.search.find import make_task
        from falsework.search.margins.demands import MarginOracle
        from falsework.search.min_robots import min_robots

        assembly = self.task.with_places(self.structure.load())
        output.record(settlement_record(assembly))
        stability = self.holds.settings(self.criterion, self.cone, self.solver)
        demanding, rules = MarginOracle(assembly, stability, demands) if demands else None, self.task.rules(assembly)
        if demanding is not None:
            task = make_task(assembly, max(assembly.part_count, 1), **rules)
            if refuse_weak_end(demanding, task, output):
                return Exit.NO
        with output.search_progress() as show:
            answer = min_robots(
                assembly,
                oracle=demanding,
                stability=stability,
                settings=self._settings(),
                deadline=self.deadline,
                progress=show,
                forces=self.proofs,
                **rules,
            )
        code = report(answer, stability.reserve, output, judged=self.judge)
        if answer.plan is not None:
            self._report(self._save([answer.plan]), None, answer.seconds, answer.verdicts, output)
        return code

    def _robot_count(self) -> int:
        try:
            return int(self.robots)
        except ValueError:
            raise InputError(f"--robots is {self.robots!r}; give a number, or auto") from None

    def _settings(self) -> PlannerSettings:
        from falsework.search.settings import PlannerSettings

        directions = search_directions(self.search_from)
        return PlannerSettings(
            self.width, directions, self.alternatives, self.seed, robust=self.robust, judge=self.judge
        )

    def _checkpoint(self) -> Path:
        """Return the path of the search checkpoint; an old one is refused unless the search resumes."""
        path = self.out.with_name(f"{self.out.name}.search")
        if not self.resume:
            path.unlink(missing_ok=True)
        elif not path.is_file():
            raise InputError(f"there is no interrupted search {path}; leave --resume out")
        return path

    def _save(self, plans: Sequence[Plan]) -> list[tuple[Path, Plan]]:
        return save_plans(plans, self.out, self.structure.source, proofs=self.proofs)

    def _show_fallen(self, plan: Plan, output: Output) -> None:
        """Save the plan whose replay gets farthest, and report where it fails."""
        from falsework.search.plans.plan_report import describe_place

        (path, saved), *_ = self._save([plan])
        assert saved.replay is not None
        assert saved.replay.falls_at is not None
        output.file(path)
        output.record({"best": _replay_record(saved)})
        where = describe_place(saved, saved.replay.falls_at)
        output.note(f"falsework: the best plan is in {path}: its replay fails {where}")

    def _report(
        self,
        plans: list[tuple[Path, Plan]],
        alternatives: Alternatives | None,
        seconds: float,
        asked: int,
        output: Output,
    ) -> None:
        """Print saved plans, the first in full, and the effort of the search."""
        from msgspec import to_builtins

        from falsework.cli.demands import margin_lines
        from falsework.interop.instruction_table import describe_path
        from falsework.search.problem.task import Direction

        for number, (path, plan) in enumerate(plans):
            output.file(path)
            record: dict[str, Any] = {"file": str(path), "steps": len(plan), "robots": plan.robots}
            record["needs"] = to_builtins(plan.needs)
            record["criterion"] = plan.claim.criterion
            record["replay"] = _replay_record(plan)
            record["reserve"] = plan.claim.reserve
            record["presses"] = sum(map(bool, plan.presses))
            record |= load_record(plan.loads)
            together = [step for step in plan if len(step.parts) > 1]
            if together:
                record["together"] = [
                    {"step": step.number, "parts": list(step.parts), "held": len(step.robots)} for step in together
                ]
            if plan.props:
                record["props"] = to_builtins(plan.props)
            if plan.margins is not None:
                record["margins"] = plan.margins.to_dict()
            if alternatives is not None and self.alternatives > 1:
                record["distances"] = [round(float(distance), 4) for distance in alternatives.distance[number]]
            output.row("plans", record)
        path, first = plans[0]
        output.say(
            f"{path}: {counted(len(first), 'step')} with {counted(first.robots, 'robot')}, every state proven "
            f"{first.claim.proves} (criterion {first.claim.criterion}, {seconds:.1f} s, {counted(asked, 'verdict')})"
        )
        for line in reserve_lines(first):
            output.say(line)
        output.say(f"first steps: {first_steps(first, Direction.ASSEMBLY)}")
        for step in first:
            if len(step.parts) > 1:
                output.say(f"step {step.number} inserts {len(step.parts)} parts at once: {step}")
        for step, path in zip(first, first.exit_paths, strict=False):
            if path:
                moves = counted(len(path), "move")
                output.say(
                    f"step {step.number} inserts {step.name} in {moves}: {describe_path(path, first.part_names)}"
                )
        for prop in first.props:
            place = ", ".join(f"{value:.3f}" for value in prop.at)
            name = first.part_names[prop.part]
            output.say(f"a prop under {name}: from the floor at {prop.floor:.3f} to its head at ({place}), metres")
        for line in margin_lines(first):
            output.say(line)
        for need in first.needs:
            output.say(need_text(first, need))
        if alternatives is not None:
            say_alternatives([path for path, _ in plans], alternatives.least_distance, self.alternatives, output)


def _replay_record(plan: Plan) -> dict[str, Any] | None:
    """Return the result of the replay of a plan; None if it has none."""
    if plan.replay is None:
        return None
    judgement = plan.replay.judgement
    record: dict[str, Any] = {"stands": plan.replay.stands, "falls_at": plan.replay.falls_at}
    record |= {"moved_mm": plan.replay.moved * 1e3, "varied": plan.replay.varied}
    return record | ({} if judgement is None else {"judgement": judgement.to_dict()})
