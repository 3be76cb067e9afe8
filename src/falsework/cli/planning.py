"""Options of rules, texts about plans, and the checks before a search, which several commands share."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from tyro.conf import arg

from falsework.cli.arguments import parse_parts, parse_state
from falsework.cli.command import UNSET
from falsework.errors import InputError
from falsework.utils.files.output_file import check_writable
from falsework.utils.quantity import counted, format_bound, format_quantity, listed

if TYPE_CHECKING:
    from falsework.assembly.model import Assembly
    from falsework.cli.output import Output
    from falsework.search.plans.plan import PartDeadline, Plan
    from falsework.search.problem.guide import Guide
    from falsework.search.problem.task import Direction, Task
    from falsework.search.task_rules import AllowsExits, ExitRules, TaskRules
    from falsework.stability.contact.hold_loads import Loads
    from falsework.stability.judges.judgement import Judgement
    from falsework.stability.oracle import StabilityOracle

SHOWN = 8
"""First steps of a plan that are printed."""


@dataclass(frozen=True, kw_only=True)
class PartRuleOptions:
    """Rules on parts that a plan must obey."""

    rare: ClassVar[tuple[str, ...]] = ("fixed", "removable_only_if_clear")

    missing: Annotated[str | None, arg(metavar="PARTS", help_behavior_hint=UNSET)] = None
    """Parts not delivered yet, such as 3,keystone; assembly does without them as long as possible."""
    fixed: Annotated[str | None, arg(metavar="PARTS", help_behavior_hint=UNSET)] = None
    """Parts that are neither held nor removed, such as 7."""
    removable_only_if_clear: bool = False
    """Remove a part only if it has a collision-free straight exit in some direction."""

    def parts(self, assembly: Assembly) -> dict[str, tuple[int, ...]]:
        """Return the missing and the fixed parts by the names of the options."""
        given = {"missing": self.missing, "fixed": self.fixed}
        return {
            name: () if text is None else parse_parts(text, f"--{name}", assembly.names) for name, text in given.items()
        }


@dataclass(frozen=True, kw_only=True)
class RuleOptions(PartRuleOptions):
    """Rules that a plan must obey in addition to the number of robots."""

    rare: ClassVar[tuple[str, ...]] = (*PartRuleOptions.rare, "begin", "end")

    begin: Annotated[str | None, arg(metavar="STATE", help_behavior_hint="(default: empty)")] = None
    """State in which the assembly begins, such as `empty`, plan.json:31, or parts as in 0-16,keystone,held:left."""
    end: Annotated[str | None, arg(metavar="STATE", help_behavior_hint="(default: complete)")] = None
    """State in which the assembly ends, such as `complete`, plan.json:31, or parts."""

    def rules(self, assembly: Assembly) -> TaskRules:
        """Return the rules, as `find_plans` takes them."""
        parts = self.parts(assembly)
        return {
            # A task starts with the state that has more parts.
            "start": None if self.end is None else parse_state(self.end, "--end", assembly),
            "target": None if self.begin is None else parse_state(self.begin, "--begin", assembly),
            "fixed": parts["fixed"],
            "missing": parts["missing"],
            "removable_only_if_clear": self.removable_only_if_clear,
        }


@dataclass(frozen=True, kw_only=True)
class ExitOptions:
    """How parts may leave."""

    rare: ClassVar[tuple[str, ...]] = ("moves", "turns", "waiting")

    parts_at_once: Annotated[int, arg(metavar="K")] = 1
    """Largest number of parts that one step may insert: parts that lock each other, each held by a robot of its own, or
    all carried by one. More than 1 implies --removable-only-if-clear."""
    moves: Annotated[int, arg(metavar="K")] = 1
    """Largest number of straight moves in which a part may leave, such as out and then up, where it has no straight
    exit. Other parts that robots hold may move aside meanwhile. More than 1 implies --removable-only-if-clear."""
    turns: bool = False
    """Let a part that leaves also turn, or screw, as one of its --moves. Implies --removable-only-if-clear."""
    waiting: bool = False
    """Let robots also carry aside parts that they do not hold, and let go of a part half way out, where what waits
    stands. Needs --moves above 1."""

    def exits(self, *others: AllowsExits) -> ExitRules:
        """Return these options as rules, with all that others allow."""
        from falsework.search.task_rules import exit_rules

        return exit_rules(self, *others)


@dataclass(frozen=True, kw_only=True)
class RareExitOptions(ExitOptions):
    """How parts may leave."""

    rare: ClassVar[tuple[str, ...]] = (*ExitOptions.rare, "parts_at_once")


@dataclass(frozen=True, kw_only=True)
class RegraspOptions(ExitOptions, RuleOptions):
    """Rules that a plan must obey, with repeated holds and props."""

    rare: ClassVar[tuple[str, ...]] = (*RuleOptions.rare, *ExitOptions.rare)

    allow_regrasp: bool = False
    """Let robots release a part without removing it when it no longer needs them, and hold parts again."""
    props: int = 0
    """Number of props, passive posts from the floor to the lower side of a part, that may be in place at a time."""

    def rules(self, assembly: Assembly) -> TaskRules:
        """Return the rules, as `find_plans` takes them."""
        from falsework.assembly.props import keep_props

        # States are given without places for props, which are absent at both ends.
        plain = keep_props(assembly, ())
        return {**super().rules(plain), "allow_regrasp": self.wider, "props": self.props, **self.exits()}

    @property
    def wider(self) -> bool:
        """Whether plans may hold parts more than once or use props."""
        return self.allow_regrasp or self.props > 0

    def with_places(self, assembly: Assembly) -> Assembly:
        """Return the structure with places for props, if any are allowed."""
        from falsework.assembly.props import prop_places, with_props

        if self.props < 0:
            raise InputError(f"--props {self.props} is not a number of props; give 0 or more")
        return with_props(assembly, prop_places(assembly)) if self.props else assembly


def reserve_lines(plan: Plan) -> list[str]:
    """Return what a plan promises of its replay, and what it asks of robots, in words."""
    stands = plan.replay is not None and plan.replay.stands
    judgement = None if plan.replay is None else plan.replay.judgement
    judged = judge_text(judgement) if judgement is not None and judgement.stands else ""
    lines = [press_text(plan), load_text(plan, plan.loads), judged]
    return [*([replay_text(plan)] if stands else []), *filter(None, lines)]


def untried_changes(plan: Plan) -> str:
    """Return that a plan with a reserve was not tried under changes of settings; empty if it was, or has not stood."""
    tried = plan.replay is None or plan.replay.varied or not plan.replay.stands
    return (
        "" if plan.claim.reserve == 1 or tried else "changes of settings were not tried; falsework check --replay does"
    )


def lacks_reserve(plan: Plan, asked: float, why: str) -> str:
    """Return the remark on a plan that keeps less reserve than was asked; empty if it keeps it.

    Args:
        why: no plan with the reserve was found; empty if that is not known.
    """
    kept, because = plan.claim.reserve, f": {why}" if why else ""
    return f"no plan was found with the reserve of {asked:g}{because}; this one keeps {kept:g}" if kept < asked else ""


def lacks_of(plan: Plan, reserve: float, why: str, *, robust: bool = False, judged: bool) -> list[str]:
    """Return the remarks on a plan that is weaker than was asked; a reserve asks for changed settings too.

    Args:
        reserve: that was asked for.
        why: as for `lacks_reserve`.
        robust: whether the plan was to stand under changed settings in any case.
        judged: whether the judge was to accept it.
    """
    found = [lacks_reserve(plan, reserve, why)]
    if (robust or plan.claim.reserve > 1) and plan.replay is not None and not plan.replay.varied:
        found.append(
            "the plan was not shown to stand under each small change of settings; falsework check --replay names those "
            "under which it falls"
        )
    if judged:
        found.append(_lacks_judge(plan))
    return [*filter(None, found)]


def judge_text(judgement: Judgement) -> str:
    """Return that discrete elements build a plan too, and which states they leave undecided, in words."""
    some = ", ".join(map(str, judgement.undecided))
    return f"discrete elements build the plan too{f'; they leave open whether states {some} stand' * bool(some)}"


def _lacks_judge(plan: Plan) -> str:
    """Return the remark on a plan that the judge does not accept; empty if it does."""
    from falsework.search.plans.plan_report import describe_place

    judgement = None if plan.replay is None else plan.replay.judgement
    if judgement is not None and judgement.stands:
        return ""
    if judgement is None or judgement.falls_at is None:
        return (
            f"the time was up when discrete elements had built {judgement.built if judgement else 0} states of the plan"
        )
    where, part = describe_place(plan, judgement.falls_at), plan.part_names[judgement.part]
    return f"no plan was found that discrete elements build; in this one {part} falls {where}"


def save_plans(
    plans: Iterable[Plan], out: Path, source: Callable[[Path], Mapping[str, Any] | None], *, proofs: bool = False
) -> list[tuple[Path, Plan]]:
    """Write plans, from the second on with -2, -3, ... in their names, and return them as they were written.

    Args:
        out: file of the first.
        source: returns the source of the structure for a file.
        proofs: write the proofs of states too.
    """
    from falsework.search.plans.plan_file import save_plan

    saved = []
    for number, found in enumerate(plans, 1):
        path = out if number == 1 else out.with_stem(f"{out.stem}-{number}")
        plan = replace(found, source=source(path))
        # A plan whose replay fails, which is saved to be looked at, has no proofs of all states.
        save_plan(plan, path, proofs=proofs and (plan.replay is None or plan.replay.stands))
        saved.append((path, plan))
    return saved


def say_alternatives(paths: Sequence[Path], least: float, asked: int, output: Output) -> None:
    """Print where further plans are, and how different the two most alike are, from 0 to 1."""
    if len(paths) > 1:
        others = ", ".join(map(str, paths[1:]))
        output.say(f"alternatives in {others}; the two plans most alike differ by {least:.2f} of 1")
    if len(paths) < asked:
        output.note(f"only {len(paths)} of the {asked} requested plans were found")


def first_steps(plan: Plan, direction: Direction, built: int = 0) -> str:
    """Describe the steps of a plan that come first in an order, after those that are done."""
    steps = plan.in_order(direction)[built:]
    if not steps:
        return "nothing is left to do"
    return listed([str(step) for step in steps], SHOWN, "steps")


def need_text(plan: Plan, need: PartDeadline, built: int = 0) -> str:
    """Return when a missing part is needed, in one sentence."""
    placed = int((plan.actions[:built] >= len(plan.boundary)).sum())
    after, when = need.after_parts - placed, f"{plan.part_names[need.part]} is needed at step {need.after_steps + 1}"
    if not after:
        return f"{when}, before any other part"
    return f"{when}, after {after} {'more' if built else 'other'} {'part is' if after == 1 else 'parts are'} placed"


def search_directions(search_from: str) -> tuple[Direction, ...]:
    """Return the directions in which searches from the beginning, the end or both ends of an assembly go."""
    from falsework.search.problem.task import Direction

    known = {"beginning": (Direction.ASSEMBLY,), "end": (Direction.DISASSEMBLY,)}
    return known.get(search_from, (Direction.ASSEMBLY, Direction.DISASSEMBLY))


def replay_text(plan: Plan) -> str:
    """Return how the replay of a plan succeeds, in one sentence."""
    kept, replay = plan.claim.reserve, plan.replay
    assert replay is not None
    reserve = f" with the true friction and with friction / {kept:g}" if kept > 1 else ""
    also = ", and under each small change of settings" * replay.varied
    return f"the replay succeeds{reserve}{also}; parts move by {format_bound(replay.moved, 'length')}"


def press_text(plan: Plan, scale: float = 1.0) -> str:
    """Return in how many steps robots press, and how hard at most; empty if they do not."""
    forces = [scale * press.force for presses in plan.presses for press in presses]
    steps = counted(sum(map(bool, plan.presses)), "step")
    return f"robots press in {steps}, with at most {format_quantity(max(forces), 'force')}" if forces else ""


def load_record(loads: Loads) -> dict[str, float | None]:
    """Return the largest force, N, and moment, N m, that robots bear, as JSON values; null where it is not known."""
    from falsework.stability.contact.hold_loads import largest_load

    force, moment = largest_load(loads) if loads else (None, None)
    return {"largest_force_n": force, "largest_moment_nm": moment}


def load_text(plan: Plan, loads: Loads) -> str:
    """Return the largest force and moment that robots bear in a plan, and where; empty if it is not known."""
    from falsework.stability.contact.hold_loads import largest_load

    every = [(load, row) for row, some in enumerate(loads) for load in some]
    if not every:
        return ""
    load, row = max(every, key=lambda pair: pair[0].force)
    force, moment = format_quantity(load.force, "force"), format_quantity(largest_load(loads)[1], "moment")
    return f"robots bear at most {force} (for {plan.part_names[load.part]}, after step {row}) and {moment}"


def writable(path: Path, suffix: str = "") -> None:
    """Check before a long search that its result can be written.

    Args:
        suffix: ending by which commands know the file again, if they do.
    """
    if suffix and path.suffix.lower() != suffix:
        raise InputError(f"{path} is written as {suffix}; name such a file")
    check_writable(path)


def writable_plan(path: Path) -> None:
    """Check before a long search that a plan can be written, under a name that does not stand for another format."""
    from falsework.utils.files.formats import check_json_name

    check_json_name(path, "a plan")
    writable(path)


def refuse_unstable(
    assembly: Assembly,
    oracle: StabilityOracle,
    task: Task,
    output: Output,
    directions: Collection[Direction] = (),
    *,
    building: bool = False,
) -> bool:
    """Report a start or target state that is not stable, since then there is no plan.

    Args:
        directions: of the search that follows, see `judge_ends`; none if it judges states from rest alone.
        building: whether the user's start is the target of the task.
    """
    from falsework.cli.velocity_text import describe, motions_at
    from falsework.search.problem.ends import end_subject, judge_ends
    from falsework.search.problem.task import Direction

    failed, _ = judge_ends(task, oracle, directions)
    if failed is None:
        return False
    starts = failed.direction is Direction.DISASSEMBLY
    verdicts = oracle.verdicts(failed.rejected, require_certificate=True)
    subject = end_subject(task, failed.rejected[0], "target" if starts == building else "start")
    moving = motions_at(assembly, verdicts, 0)
    outcome = "no plan exists" if verdicts.unstable[0] else "no plan was found"
    text = f"{outcome}: the {subject} {verdicts.kinds[0].words}"
    if starts and oracle.replayer is not None and verdicts.depends_on_path[0]:
        text += " from rest, all that counts here; falsework plan --search-from beginning tells if it stands as built"
    if verdicts.on_tolerance[0]:
        text += ", which depends on the tolerance"
    if subject == "complete structure" and (hint := assembly.clearance_hint):
        text += f"; {hint}"
    output.outcome("impossible" if verdicts.unstable[0] else "not_found")
    output.record({"reason": text, "moving": [motion.to_dict(assembly) for motion in moving]})
    output.note(f"falsework: {text}{'; ' if moving else ''}{describe(assembly, moving, limit=3)}")
    return True


def policy_guide(run: Path | None, assembly: Assembly, task: Task) -> Guide | None:
    """Return the guide of the policy of a run; None without a run."""
    if run is None:
        return None
    from falsework.learn import load_run  # says what to install where torch is missing
    from falsework.replanning.policy_guide import PolicyGuide

    return PolicyGuide(load_run(run, assembly=assembly).policy, task=task)
