"""`falsework check`: verification of every step of a plan under a chosen criterion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from tyro.conf import Positional, arg

from falsework.cli.arguments import parse_limits, spell_options
from falsework.cli.claim_options import ClaimOptions
from falsework.cli.command import UNSET, Command, LoadOptions
from falsework.cli.exit_code import Exit
from falsework.cli.output import exit_of_good
from falsework.cli.planning import judge_text, load_record, load_text
from falsework.errors import InputError
from falsework.utils.quantity import counted, format_bound, format_quantity

if TYPE_CHECKING:
    from falsework.assembly.model import Assembly
    from falsework.cli.output import Output
    from falsework.search.plans.plan import Plan
    from falsework.search.plans.plan_report import CheckedPlan, PlanReport
    from falsework.stability.contact.history import Replay
    from falsework.stability.settings import StabilitySettings

_NAMED = 4
"""Boundary parts that are named; the rest is counted."""


def _state_words(state: Sequence[int], assembly: Assembly) -> str:
    """Describe a state: `complete`, `empty`, or how many parts are in place and held."""
    free = [value for value, fixed in zip(state, assembly.immovable.tolist(), strict=True) if not fixed]
    if all(value == 1 for value in free):
        return "complete"
    if not any(free):
        return "empty"
    held = f", {free.count(2)} held" if 2 in free else ""
    return f"{len(free) - free.count(0)} of {len(free)} parts{held}"


@dataclass(frozen=True, kw_only=True)
class CheckPlan(Command):
    """Verify every step of a plan, up to the first that fails.

    The options, not the file, set the criterion; a plan that claims less is refused. A checker that shares no code with
    the solvers evaluates the certificates that the plan carries (`plan --proofs`). Other states are solved: under
    `contact` by displacements from rest, or from those of neighbouring states, which the checker verifies; under
    `equilibrium` by the exact solver. The structure is the one that the plan names; a plan for another structure is
    refused. Options of the structure that the plan records, such as its friction, count only if they are given here
    too. Exit code 1 at the first step that fails; 3 if all is well, but only with such options of the plan.
    """

    rare: ClassVar[tuple[str, ...]] = ("hold_force",)

    examples: ClassVar[tuple[str, ...]] = (
        "falsework check plan.json",
        "falsework check plan.json --replay",
        "falsework check plan.json --structure my-folder --steps",
        "falsework check plan.json --accept-overrides",
    )

    outcomes: ClassVar[tuple[str, str]] = ("verified", "refuted")

    plan: Annotated[Positional[Path], arg(metavar="PLAN")]
    """Plan to check, as `falsework plan` wrote it."""
    structure: Annotated[str | None, arg(metavar="STRUCTURE", help_behavior_hint=UNSET)] = None
    """Structure to check it on, instead of the one that the plan names."""
    reading: LoadOptions
    accept_overrides: bool = False
    """Accept the options of the structure that the plan records, as if all were given."""
    claim: ClaimOptions
    hold_force: Annotated[str | None, arg(metavar="FORCE", help_behavior_hint="(default: that of the plan)")] = None
    """Largest force of a robot on a part that it holds, such as 300N; no robot may bear more in any state."""
    hold_moment: Annotated[str | None, arg(metavar="MOMENT", help_behavior_hint="(default: that of the plan)")] = None
    """Largest moment of a robot about the centre of mass of a part that it holds, such as 40Nm."""
    replay: bool = False
    """Also replay the plan with contact history, and print one line per step. A plan that
    fails with another stiffness ratio, release increment or initial friction is reported as marginal, and fails the
    check if it says that it does not."""
    judge: bool = False
    """Also build the plan by an independent method, with its presses, under the true friction: discrete elements on
    springs as stiff as the contacts of the criterion, as `falsework plan --judge` does. It takes seconds to minutes."""
    steps: bool = False
    """Print the steps too."""
    order: Literal["assembly", "disassembly"] = "assembly"
    """Order in which the steps are printed; they keep their numbers."""

    def run(self, output: Output) -> Exit:
        """Load, compare, verify, replay."""
        from falsework.search.plans.plan_check import validate_plan
        from falsework.search.plans.plan_file import load_plan
        from falsework.search.plans.plan_source import structure_to_check
        from falsework.stability.holds import HoldSettings

        if self.replay and self.claim.criterion != "contact":
            raise InputError("the criterion equilibrium has no contact history; leave out --replay or --criterion")
        limits = parse_limits(self.hold_force, self.hold_moment)
        for name, limit in zip(("--hold-force", "--hold-moment"), limits, strict=True):
            if limit == 0:
                raise InputError(f"{name} is 0, which limits nothing; give more than 0, or leave it out")
        settings = self.claim.settings(holds=HoldSettings(float("inf"), *limits))
        demands = self.claim.demands()
        plan = load_plan(self.plan)
        assembly, overrides = structure_to_check(plan, self.plan, self.structure, **self.reading.given())
        with output.count("checking", "state") as progress:
            found = validate_plan(plan, assembly, settings, demands=demands, progress=progress)
        self._report(plan, assembly, found, overrides, output)
        if not found.good:
            return Exit.NO
        if self.replay and not self._replay(plan, assembly, settings, output):
            return Exit.NO
        if self.judge and not self._build(plan, assembly, output):
            return Exit.NO
        return exit_of_good(self.plan, overrides, output, accepted=self.accept_overrides)

    def _report(
        self, plan: Plan, assembly: Assembly, found: PlanReport, overrides: dict[str, Any], output: Output
    ) -> None:
        from falsework.cli.velocity_text import describe, motions_at
        from falsework.search.plans.plan_report import JUDGEMENT, REPLAY
        from falsework.search.problem.task import Direction
        from falsework.stability.holds import describe_loads

        verified = {REPLAY} if self.replay else set()
        verified |= {JUDGEMENT} if self.judge else set()
        unverified = [claim for claim in found.unverified if claim not in verified]
        moving = [] if found.verdict is None else motions_at(assembly, found.verdict, 0)
        output.record(
            {
                "states": found.states,
                "checked": found.checked,
                "residual": found.residual,
                "bad_step": found.bad_step,
                "reason": found.reason,
                "moving": [motion.to_dict(assembly) for motion in moving],
                "seconds": found.seconds,
                "claim": found.claim.to_dict(),
                "about": None if found.about is None else asdict(found.about),
                "overrides": overrides,
                "certified": found.certified,
                **load_record(found.loads),
                "unverified": unverified,
            }
        )
        if self.steps:
            for step in plan.in_order(Direction(self.order)):
                loads = found.loads[step.number] if found.loads else ()
                borne = describe_loads(loads, plan.part_names, plan.holders[step.number])
                output.say("; ".join(filter(None, (f"{step.number:4d}  {step}", borne))))
        if found.good:
            claim = found.claim
            output.say(
                f"{self.plan}: all {found.states} states are {claim.proves} by the criterion {claim.criterion} "
                f"({claim.cone} cone, tolerance {format_quantity(claim.tolerance, 'share')}, "
                f"gravity {claim.gravity:g} m/s2, "
                f"force bound "
                f"{claim.force_bound:g}); no part is out of balance by more than "
                f"{format_quantity(found.residual, 'share')} of its weight"
            )
            demanded = self.claim.margin or (plan.margins and str(plan.margins.demands))
            if demanded:
                output.say(f"every state keeps {demanded}")
            if plan.margins is not None and plan.margins.measured:
                output.say(f"every state keeps its recorded margins of {', '.join(plan.margins.measured)}")
        if found.checked and found.about is not None:
            output.say(self._about(found.about, plan, assembly))
            if overrides:
                output.say(f"options of the structure that the plan sets: {spell_options(overrides)}")
        if borne := load_text(plan, found.loads):
            output.say(borne)
        if found.certified:
            output.say(f"certificates in the plan prove {counted(found.certified, 'state')}")
        if found.good and unverified:
            output.say(f"not verified: {', '.join(unverified)}")
        if not found.good:
            output.note(
                f"falsework: {self.plan}: {found.reason}{'; ' if moving else ''}{describe(assembly, moving, limit=3)}"
            )

    def _about(self, about: CheckedPlan, plan: Plan, assembly: Assembly) -> str:
        """Describe what was checked on one line."""
        source = plan.source or {}
        place = self.structure or source.get("built_in") or source.get("path")
        named = about.structure if place in (None, about.structure) else f"{about.structure} ({place})"
        fixed = [assembly.names[part] for part in about.boundary[:_NAMED]]
        more = ["..."] if len(about.boundary) > _NAMED else []
        props = f" and {counted(about.prop_limit, 'prop')}" if about.props else ""
        several = f", up to {about.parts_at_once} parts in one step" if about.parts_at_once > 1 else ""
        start, end = (_state_words(state, assembly) for state in (about.start, about.end))
        several += f", ways out of up to {about.moves} moves" if about.moves > 1 else ""
        return (
            f"checked: {named}, digest {about.identity[:12]}, {assembly.part_count} parts, {len(about.boundary)} "
            f"boundary ({', '.join([*fixed, *more])}); {counted(about.steps, 'step')} with "
            f"{counted(about.robots, 'robot')}{props}{several}, from {start} to {end}"
        )

    def _replay(self, plan: Plan, assembly: Assembly, settings: StabilitySettings, output: Output) -> bool:
        """Replay under the settings, then under varied ones; return whether the plan succeeds."""
        from falsework.search.plans.plan_report import describe_place
        from falsework.stability.contact.replay import Replayer
        from falsework.stability.contact.varied_replay import FEW, replay_varied, variations

        settings = replace(settings, reserve=plan.claim.reserve, holds=plan.claim.holds.within(settings.holds))
        replayer = Replayer(assembly, settings)
        replay = replayer.replay(plan.states, presses=plan.presses_before)
        for row in range(len(plan.states)):
            self._line(row, plan, assembly, replay, output)
            if replay.falls_at == row:
                break
        if not replay.good:
            output.note(f"falsework: {self.plan}: the replay fails {describe_place(plan, replay.falls_at or 0)}")
            return False
        varied = replay_varied(replayer, plan.states, plan.presses_before, changes=variations(FEW))
        failed = [case for case in varied if not case.good]
        output.record(
            {
                "replay": "stands" if not failed else "marginal",
                "moved_mm": replay.largest * 1e3,
                "variations": [asdict(case) for case in varied],
            }
        )
        most = f"parts move by {format_bound(replay.largest, 'length')}"
        if not failed:
            output.say(f"the replay succeeds, and under {counted(len(varied), 'change')} of settings too; {most}")
        else:
            output.say(
                f"the replay succeeds under the given settings only, and fails under {len(failed)} of "
                f"{counted(len(varied), 'change')} of them; {most}"
            )
            names = "; ".join(f"{case.name} (fails {describe_place(plan, case.falls_at or 0)})" for case in failed)
            output.note(f"falsework: warning: the plan is marginal: its replay fails under {names}")
        denied = "" if plan.replay is None else plan.replay.denied_by(replay, marginal=bool(failed))
        if denied:
            output.note(f"falsework: {self.plan}: the plan says of its replay {denied}, which is not so; plan again")
        return not denied

    def _line(self, row: int, plan: Plan, assembly: Assembly, replay: Replay, output: Output) -> None:
        """Print one step of a replay."""
        import numpy as np

        part, moved = int(replay.part[row]), float(replay.moved[row])
        size = float(np.ptp(assembly.meshes[part].vertices, axis=0).max()) if part >= 0 else 1.0
        word = {1: "stands", -1: "falls", -2: "a robot bears more than it can", 0: "open"}[int(replay.stands[row])]
        record: dict[str, Any] = {"step": row, "replay": word, "moved_mm": moved * 1e3}
        record |= {"part": assembly.names[part] if part >= 0 else None, "share_of_part": moved / size}
        output.row("steps", record)
        mover = (
            f"{assembly.names[part]} moved {format_quantity(moved, 'length')}, "
            f"{format_quantity(moved / size, 'share')} of its size"
            if part >= 0
            else ""
        )
        output.say(f"{plan.line(row)}: {word}{'; ' if mover else ''}{mover}")

    def _build(self, plan: Plan, assembly: Assembly, output: Output) -> bool:
        """Build the plan by discrete elements; return whether no state collapses."""
        from falsework.search.plans.plan_report import describe_place
        from falsework.stability.judges.discrete_elements import BuildJudge

        judge = BuildJudge(assembly, plan.claim.holds, plan.claim.gravity)
        judgement = judge.judge(plan.states, plan.presses_before)
        output.record({"judgement": judgement.to_dict()})
        if judgement.falls_at is not None:
            where = describe_place(plan, judgement.falls_at)
            name = assembly.names[judgement.part]
            output.note(f"falsework: {self.plan}: {name} falls when discrete elements build the plan, {where}")
            return False
        output.say(judge_text(judgement))
        return True
