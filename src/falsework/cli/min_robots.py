"""Part of `falsework plan --robots auto`: fewest robots with a plan, and why fewer do not suffice."""

from __future__ import annotations

from typing import TYPE_CHECKING

from falsework.cli.exit_code import Exit
from falsework.cli.planning import lacks_of
from falsework.utils.quantity import counted

if TYPE_CHECKING:
    from falsework.cli.output import Output
    from falsework.search.min_robots import MinRobots

_SHARED = ("verdicts", "seconds", "interrupted")
"""Fields that the answer on any plan has."""


def report(answer: MinRobots, reserve: float, output: Output, *, judged: bool) -> Exit:
    """Print the answer without the plan, and return the exit code.

    Args:
        judged: whether the judge was asked for.
    """
    fields = answer.to_dict()
    output.record({"fewest": {name: value for name, value in fields.items() if name not in _SHARED}})
    output.record({name: fields[name] for name in _SHARED})
    spent = f"{answer.seconds:.1f} s, {counted(answer.verdicts, 'verdict')}"
    fewer = [f"with {n}: {reason}" for n, reason in enumerate(answer.reasons, 1)]
    if answer.value is not None:
        least = "proven to be the fewest" if answer.proven else f"at least {answer.bound} are proven to be needed"
        if answer.value == 1:
            least = "the fewest there can be"
        output.say(f"{counted(answer.value, 'robot')}: a plan was found; {least} ({spent})")
        for line in fewer[-1:] if answer.proven else fewer[answer.bound - 2 if answer.bound > 1 else 0 :]:
            output.say(line)
    elif answer.impossible:
        output.outcome("impossible" if answer.certain else "not_found")
        word = "no number of robots suffices" if answer.certain else "no plan was found with any number of robots"
        output.note(f"falsework: {word}: {answer.impossible}")
    else:
        least = "at least 1 robot is" if answer.bound == 1 else f"at least {answer.bound} robots are"
        found = [f"no plan was found; {least} needed", *fewer]
        output.note(f"falsework: {'; '.join(found)} ({spent})")
    if answer.interrupted:
        output.note("interrupted; this is the best so far")
        return Exit.INTERRUPTED
    if answer.deadline_passed and not answer.proven:
        output.note("the search ended before a plan or a proof was found; --deadline gives it more time")
    lacking = [] if answer.plan is None else lacks_of(answer.plan, reserve, answer.unreserved, judged=judged)
    if lacking:
        output.outcome("weaker")
        output.note(lacking[0])
    return Exit.DONE if answer.value is not None and not lacking else Exit.NO
