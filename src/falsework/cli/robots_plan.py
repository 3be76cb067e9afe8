"""`falsework robots plan`: arm motions for a structure in a cell, from the start or from an interruption."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from tyro.conf import Positional, arg

from falsework.cli.arguments import parse_parts, parse_state
from falsework.cli.command import UNSET, Command, CriterionOfPlan, SeedOption, StructureOptions
from falsework.cli.exit_code import Exit
from falsework.cli.hold_options import HoldOptions
from falsework.cli.planning import (
    RareExitOptions,
    lacks_reserve,
    policy_guide,
    press_text,
    refuse_unstable,
    writable_plan,
)
from falsework.cli.robot_arguments import parse_grips, parse_holding, parse_joints, parse_now
from falsework.cli.robot_reports import (
    can_schedule,
    found_texts,
    overloads_of,
    problem_record,
    times_record,
)
from falsework.errors import InputError
from falsework.utils.quantity import counted, format_quantity, parse_quantity

if TYPE_CHECKING:
    from falsework.assembly.model import Assembly
    from falsework.assembly.state import States
    from falsework.cli.output import Output
    from falsework.robots.model.cell import Cell
    from falsework.robots.planning.hybrid_result import HybridResult
    from falsework.robots.plans.robot_plan import RobotPlan
    from falsework.robots.plans.timeline import Interruption
    from falsework.search.problem.task import Task


@dataclass(frozen=True, eq=False)
class InterruptedPlan:
    """Robot plan, its structure and cell, and where it was interrupted."""

    plan: RobotPlan
    file: Path
    assembly: Assembly
    cell: Cell
    now: Interruption

    @property
    def regrasps(self) -> bool:
        """Whether its robots hold parts again, hand them over, or put them down."""
        again = any(step.hands_over is not None or step.put_down is not None for step in self.plan.steps)
        return again or self.plan.plan.allow_regrasp

    @classmethod
    def from_options(
        cls, file: Path, at: str | None, order: str, structure: str | None, cell: str | None, **options: Any
    ) -> InterruptedPlan:
        """Read the plan, and find out where it stands.

        Args:
            at: time of the interruption, such as `7.2s`.
        """
        from falsework.robots.cells.cell_file import load_cell
        from falsework.robots.plans.robot_plan_file import load_robot_plan
        from falsework.robots.plans.timeline import interruption
        from falsework.search.plans.plan_source import structure_of_plan

        if at is None:
            raise InputError(f"--from {file}: name the time of the interruption by --at, such as --at 7.2s")
        seconds = parse_quantity(at, "duration", "--at")
        plan = load_robot_plan(file)
        if seconds >= plan.makespan:
            raise InputError(
                f"--at {at}: {file} ends after {format_quantity(plan.makespan, 'duration')}; give an earlier time"
            )
        if plan.direction != order:
            raise InputError(f"--order {order}: {file} is a plan of {plan.direction}; go on in that order")
        assembly = structure_of_plan(plan.plan, file, structure, **options)
        place = load_cell(cell or plan.cell_place(file))
        plan.check_identity(assembly, place)
        return cls(plan, file, assembly, place, interruption(plan, seconds))


@dataclass(frozen=True, kw_only=True)
class InterruptedStructureOptions(StructureOptions):
    """Options that select the structure, which a plan that was interrupted names itself."""

    spec: Annotated[Positional[str], arg(metavar="STRUCTURE", help_behavior_hint="(default: that of --from)")] = ""
    """Built-in such as `vault` or `arch:blocks=15,thickness=0.2`, or a folder or file of meshes or COMPAS data."""


@dataclass(frozen=True, kw_only=True)
class PlanRobots(Command):
    """Plan arm motions that assemble a structure, or take it apart.

    Actions and motions are planned together: every state is stable, a replay of the assembly succeeds in which
    robots bear and press no more than their grippers allow, every motion is collision-free. Then motions of different
    robots are scheduled to take place at the same time wherever that is proven safe, whatever the delays. Exit code 1
    if no plan was found, or none that keeps the reserve and the limits of grippers; the report lists parts out of
    reach, obstacles, and the progress of the search. A partial plan is saved, except where an assembly is continued.
    """

    rare: ClassVar[tuple[str, ...]] = (
        "seed",
        "target",
        "grips",
        "proofs",
        "criterion",
        "sequential",
    )
    outcomes: ClassVar[tuple[str, str]] = ("found", "not_found")

    examples: ClassVar[tuple[str, ...]] = (
        "falsework robots plan my-folder --cell cell.toml --out robot_plan.json",
        "falsework robots plan my-folder --cell cell.toml --policy my-run --seed 3 --deadline 60",
        "falsework robots plan my-folder --cell cell.toml --order disassembly --state 2210 --joints now.json "
        "--holding left=3 --allow-regrasp",
        "falsework robots plan my-folder --cell cell.toml --state 2110 --joints now.json "
        "--holding left=2,right=3 --grips robot_plan.json --out rest.json",
        "falsework robots plan --from robot_plan.json --at 7.2s --missing 5 --out rest.json",
    )

    structure: InterruptedStructureOptions
    cell: Annotated[str | None, arg(metavar="CELL", help_behavior_hint="(default: that of --from)")] = None
    """Cell file, or the name of a built-in cell such as dome-37."""
    begun: Annotated[Path | None, arg(name="from", metavar="ROBOT_PLAN", help_behavior_hint=UNSET)] = None
    """Robot plan that was interrupted; it says what the structure and the cell are, and with --at what stands, where
    the arms are and what they hold or carry."""
    at: Annotated[str | None, arg(metavar="TIME", help_behavior_hint=UNSET)] = None
    """Time of the interruption from the start of that plan, such as 7.2s; motions that have begun then are finished."""
    out: Annotated[Path, arg(metavar="FILE")] = Path("robot_plan.json")
    """File to write."""
    policy: Annotated[Path | None, arg(metavar="RUN", help_behavior_hint=UNSET)] = None
    """Trained run whose policy proposes the actions."""
    seed: SeedOption = 0
    deadline: Annotated[float | None, arg(metavar="SECONDS", help_behavior_hint=UNSET)] = None
    """Time limit."""
    order: Literal["assembly", "disassembly"] = "assembly"
    """Order in which the motions are executed; the schedule is for it. --state, --joints, --holding and --grips
    describe its start."""
    state: Annotated[str | None, arg(metavar="STATE", help_behavior_hint="(default: empty or complete)")] = None
    """State to start from, such as `empty`, `complete`, plan.json:31, or parts as in 0-16,keystone,held:left."""
    joints: Annotated[str | None, arg(metavar="JOINTS", help_behavior_hint="(default: all at home)")] = None
    """Joint values of the robots in rad at the start, such as left=0,0.1,-0.5,0,1,0;right=home, or a JSON file with
    such lists by robot. An assembly for which nothing of its start is given begins where its first motion does."""
    holding: Annotated[str | None, arg(metavar="PARTS", help_behavior_hint=UNSET)] = None
    """Parts that robots hold at the start, such as left=3,right=keystone; a part that is not in place is carried."""
    grips: Annotated[str | None, arg(metavar="GRIPS", help_behavior_hint=UNSET)] = None
    """For carried parts the joint values with which their robots would hold them at their places, as with --joints, or
    the file of the robot plan that was under way."""
    target: Annotated[str | None, arg(metavar="STATE", help_behavior_hint="(default: complete or empty)")] = None
    """State to end in, as the one to start from."""
    missing: Annotated[str | None, arg(metavar="PARTS", help_behavior_hint=UNSET)] = None
    """Parts not delivered yet, such as 3,keystone; assembly does without them as long as possible."""
    allow_regrasp: bool = False
    """Let arms release parts that stand without them and hold them again with another grasp, hand other parts to
    another arm, and put parts down on the way to grip them in another way, where there is no other way."""
    exits: RareExitOptions
    sequential: bool = False
    """One robot moves at a time; without this, robots move together wherever that is proven safe."""
    proofs: bool = False
    """Write the contact forces that prove each state into the plan."""
    holds: HoldOptions
    criterion: CriterionOfPlan = None

    def run(self, output: Output) -> Exit:
        """Search, save, report."""
        from falsework.robots.model.cell_holds import CellScale, boundless, stability_in
        from falsework.robots.planning.hybrid_planner import plan_robots
        from falsework.robots.planning.hybrid_result import HybridSettings
        from falsework.search.problem.task import Direction
        from falsework.stability.oracle import StabilityOracle

        writable_plan(self.out)
        begun = self._begun()
        if begun is not None:
            assembly, cell = begun.assembly, begun.cell
        else:
            assembly, cell = self._load()
        together = not self.sequential and cell.robot_count > 1 and can_schedule(output)
        order = Direction(self.order)
        settings = HybridSettings(order, seed=self.seed)
        building = order is Direction.ASSEMBLY
        if begun is not None:
            held, joints, grips = [*begun.now.held], [*begun.now.configurations], [*begun.now.gripped]
            task = self._task(assembly, cell, begun.now.state, held, begun)
        else:
            held, joints = parse_holding(self.holding, cell, assembly), parse_joints(self.joints, cell)
            task = self._task(assembly, cell, parse_now(self.state or self._beginning, held, assembly), held)
            grips = parse_grips(self.grips, held, task.target if building else task.start, cell, assembly)
        own, scale = None if begun is None else begun.plan.plan, CellScale.from_cell(assembly, cell)
        stability = self.holds.settings_from(own, assembly, self.criterion, scale=scale)
        oracle = StabilityOracle(assembly, stability_in(cell, assembly, replace(stability, reserve=1.0)))
        if refuse_unstable(assembly, oracle, task, output, tuple(Direction), building=building):
            return Exit.NO
        guide = policy_guide(self.policy, assembly, task)
        given: dict[str, Any] = {
            "task": task,
            "concurrent": together,
            "stability": stability,
            "guide": guide,
            "settings": settings,
            "deadline": self.deadline,
            "forces": self.proofs,
        }
        if not building or begun is not None or {self.state, self.joints, self.holding, self.grips} != {None}:
            given |= {"configurations": joints, "held": held, "gripped": grips}
        if stability.criterion == "contact" and (bear := boundless(cell, stability.holds.force)):
            output.say(bear)
        with output.count("planning motions", "step") as progress:
            given["progress"] = lambda now: progress(now.reached, now.steps)
            result = plan_robots(assembly, cell, **given)
        found = result.partial if result.value is None else result.value  # a plan without steps is false
        done, found = self._report(result, found, begun, output)
        if done is not Exit.DONE or found is None:
            return done
        if text := press_text(found.plan, scale.force):
            output.say(text)
        lost = lacks_reserve(found.plan, stability.reserve, result.unreserved)
        heavy = overloads_of(found, assembly, cell)
        if heavy:
            output.record({"overloads": [problem_record(problem) for problem in heavy]})
        for text in (*([lost] if lost else []), *heavy):
            output.note(f"falsework: {text}")
        return output.outcome("weaker") if lost or heavy else Exit.DONE

    def _begun(self) -> InterruptedPlan | None:
        """Return the plan that was interrupted, if there is one."""
        if self.begun is None:
            return None
        others = {"state": self.state, "joints": self.joints, "holding": self.holding, "grips": self.grips}
        given = [f"--{name}" for name, value in others.items() if value is not None]
        if given:
            raise InputError(f"--from says what stands and where the arms are; leave out {' and '.join(given)}")
        structure, options = self.structure.spec or None, self.structure.given()
        return InterruptedPlan.from_options(self.begun, self.at, self.order, structure, self.cell, **options)

    @property
    def _beginning(self) -> str:
        return "empty" if self.order == "assembly" else "complete"

    def _load(self) -> tuple[Assembly, Cell]:
        from falsework.robots.cells.cell_file import load_cell

        if self.at is not None:
            raise InputError(f"--at {self.at} is a time of a robot plan; name that by --from")
        missing = [name for name, given in (("STRUCTURE", self.structure.spec), ("--cell", self.cell)) if not given]
        if missing:
            raise InputError(f"missing from falsework robots plan: {', '.join(missing)}; or go on by --from and --at")
        cell = load_cell(self.cell or "")
        return self.structure.load(), cell

    def _task(
        self,
        assembly: Assembly,
        cell: Cell,
        now: States,
        held: Sequence[int | None],
        begun: InterruptedPlan | None = None,
    ) -> Task:
        from falsework.search.find import make_task

        building = self.order == "assembly"
        missing = () if self.missing is None else parse_parts(self.missing, "--missing", assembly.names)
        for part in missing if building else ():
            there = part < len(now) and bool(now[part])
            if there or part in held:
                where = "in place" if there else f"in the gripper of {cell.robots[held.index(part)].name}"
                name = assembly.names[part]
                raise InputError(f"part {name} is said to be missing, yet it is {where}; name parts that are not there")
        end = None if self.target is None else parse_state(self.target, "--target", assembly)
        start, target = (end, now) if building else (now, end)  # plans are found as disassembly
        before = [] if begun is None else [begun.plan.plan]  # what it allows goes on
        return make_task(
            assembly,
            cell.robot_count,
            start=start,
            target=target,
            missing=missing,
            removable_only_if_clear=True,
            allow_regrasp=self.allow_regrasp or (begun is not None and begun.regrasps),
            **self.exits.exits(*before),
        )

    def _report(
        self, result: HybridResult, found: RobotPlan | None, begun: InterruptedPlan | None, output: Output
    ) -> tuple[Exit, RobotPlan | None]:
        """Save and report a plan; return the exit code so far and the plan as it is in the file, None without one."""
        saved = None
        if found is not None:
            fails_at = None
            if begun is not None:
                from falsework.robots.plans.continued import continued

                found, fails_at = continued(found, begun.plan, begun.now.done, begun.assembly)
            saved = self._save(found, begun, result.structure)
            output.file(self.out)
            output.record(
                {
                    "steps": saved.executed,
                    "motion_s": round(saved.seconds, 3),
                    **result.statistics,
                    **times_record(saved),
                }
            )
            if result.found:
                for text in found_texts(saved, str(self.out), result.statistics):
                    output.say(text)
                if fails_at is not None:
                    output.note(
                        f"falsework: with the history of the steps that are done the replay fails at step {fails_at}, "
                        "so the new steps are numbered from 1 and proven from rest"
                    )
                    return output.outcome("weaker"), saved
                return Exit.DONE, saved
            output.outcome("partial")
            which = "first" if saved.direction == "disassembly" else "last"
            output.note(f"{self.out} has the {which} {counted(len(saved), 'step')}")
        else:
            why = result.explanation.to_dict() if result.explanation else {}
            output.record({"failure": why, **result.statistics})
        if result.explanation is not None:
            output.note(f"falsework: {result.explanation.text}")
        return Exit.NO, saved

    def _save(self, plan: RobotPlan, begun: InterruptedPlan | None, joined: Assembly | None) -> RobotPlan:
        from falsework.assembly.groups import groups_of
        from falsework.robots.plans.robot_plan_file import save_robot_plan
        from falsework.search.plans.plan_source import moved_source

        if begun is not None and not self.structure.spec:
            source = moved_source(begun.plan.plan, begun.file, self.out)
        else:
            source = self.structure.source(self.out)
        groups = None if joined is None else groups_of(joined)
        if groups is not None:
            source = {**(source or {}), "groups": groups.names}
        place = self.cell if begun is None or self.cell else begun.plan.cell_place(begun.file)
        assert place is not None
        if Path(place).is_file():
            place = Path(os.path.relpath(Path(place).resolve(), self.out.resolve().parent)).as_posix()
        plan = replace(plan, plan=replace(plan.plan, source=source), cell_source=place)
        save_robot_plan(plan, self.out)
        return plan
