"""`falsework robots-needed`: fewest robots with a plan, and why fewer do not suffice."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar

from tyro.conf import arg

from falsework.cli.command import UNSET, JudgingCommand, StructureOptions
from falsework.cli.exit_code import Exit
from falsework.cli.planning import HoldOptions, SupportOptions, lacks_reserve, promise_lines, writable

if TYPE_CHECKING:
    from falsework.assembly.model import Assembly
    from falsework.cli.output import Output
    from falsework.search.fewest_robots import RobotsNeeded
    from falsework.search.settings import PlannerSettings
    from falsework.stability import StabilitySettings


@dataclass(frozen=True, kw_only=True)
class AskRobotsNeeded(JudgingCommand):
    """Find the fewest robots with which a structure can be disassembled and assembled.

    A plan is found with that number, and for the number below it is either proven that no plan exists, or reported that
    none was found, with the number of robots that is proven to be needed at least. Exit code 1 if no plan was found
    with any number, or none that keeps the reserve.
    """

    examples: ClassVar[tuple[str, ...]] = (
        "falsework robots-needed vault",
        "falsework robots-needed arch --deadline 300 --out fewest.json",
        "falsework robots-needed arch --support",
    )

    structure: StructureOptions
    task: SupportOptions
    holds: HoldOptions
    out: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint=UNSET)] = None
    """File to write the plan to."""
    deadline: float = 60.0
    """Seconds after which the search ends with the best it has."""
    seed: int = 0
    """Random seed; results are reproducible on one machine unless the deadline is reached."""

    def run(self, output: Output) -> Exit:
        """Search, report, save."""
        from falsework.search.plans.plan_file import save_plan
        from falsework.search.settings import PlannerSettings

        if self.out is not None:
            writable(self.out)
        assembly = self.task.with_places(self.structure.load())
        stability = self.holds.settings(self.criterion)
        answer = ask(assembly, stability, self.task, PlannerSettings(seed=self.seed), self.deadline, False, output)
        if answer.plan is not None and self.out is not None:
            save_plan(replace(answer.plan, source=self.structure.source(self.out)), self.out)
        return report(answer, stability.reserve, self.out, output)


def ask(
    assembly: Assembly,
    stability: StabilitySettings,
    rules: SupportOptions,
    settings: PlannerSettings,
    deadline: float | None,
    proofs: bool,
    output: Output,
) -> RobotsNeeded:
    """Run `falsework.search.robots_needed` with progress on the error stream."""
    from falsework.search.fewest_robots import DEADLINE, robots_needed

    with output.search_progress() as show:
        return robots_needed(
            assembly,
            stability=stability,
            settings=settings,
            deadline=DEADLINE if deadline is None else deadline,
            progress=show,
            forces=proofs,
            **rules.rules(assembly),
        )


def report(answer: RobotsNeeded, reserve: float, path: Path | None, output: Output) -> Exit:
    """Print the answer, and return the exit code.

    Args:
        answer: the answer.
        reserve: that was asked for.
        path: of the plan, where it was saved.
        output: where to print.
    """
    output.record(answer.to_dict() | {"plan": None if path is None or answer.plan is None else str(path)})
    spent = f"{answer.seconds:.1f} s, {answer.verdicts} verdicts"
    fewer = [f"with {n}: {reason}" for n, reason in enumerate(answer.reasons, 1)]
    if answer.robots is not None:
        least = "proven to be the fewest" if answer.proven else f"at least {answer.least} are proven to be needed"
        if answer.robots == 1:
            least = "the fewest there can be"
        output.say(f"{answer.robots} robot{'s' * (answer.robots > 1)}: a plan was found; {least} ({spent})")
        for line in fewer[-1:] if answer.proven else fewer[answer.least - 2 if answer.least > 1 else 0 :]:
            output.say(line)
        if path is not None and answer.plan is not None:
            output.say(f"the plan is in {path}")
            for line in promise_lines(answer.plan):
                output.say(line)
    elif answer.impossible:
        word = "no number of robots suffices" if answer.certain else "no plan was found with any number of robots"
        output.note(f"falsework: {word}: {answer.impossible}")
    else:
        least = "at least 1 robot is" if answer.least == 1 else f"at least {answer.least} robots are"
        found = [f"no plan was found; {least} needed", *fewer]
        output.note(f"falsework: {'; '.join(found)} ({spent})")
    if answer.interrupted:
        output.note("interrupted; this is the best so far")
        return Exit.INTERRUPTED
    if answer.deadline_passed and not answer.proven:
        output.note("the deadline ended the search; more time may find a plan or a proof")
    lacking = "" if answer.plan is None else lacks_reserve(answer.plan, reserve)
    if lacking:
        output.note(lacking)
    return Exit.DONE if answer.robots is not None and not lacking else Exit.NO
