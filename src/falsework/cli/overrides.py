"""Options of the structure that a plan sets itself: commands print them, and the exit code of a check says so."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from falsework.cli.arguments import spell_options
from falsework.cli.exit_code import Exit

if TYPE_CHECKING:
    from falsework.cli.output import Output


def exit_of_good(plan: Path, overrides: Mapping[str, Any], output: Output, *, accepted: bool) -> Exit:
    """Return the exit code of a check that found nothing wrong, and say what it depends on.

    Args:
        plan: file of the plan.
        overrides: options that the plan sets and the command line does not give, see `structure_to_check`.
        output: streams of the command.
        accepted: whether the command line accepts them all.
    """
    if not overrides or accepted:
        return Exit.DONE
    output.note(
        f"falsework: {plan}: good only with options of the structure that the plan sets itself: "
        f"{spell_options(overrides)}; give them too, or --accept-overrides"
    )
    return Exit.CONDITIONAL
