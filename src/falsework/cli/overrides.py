"""Options of the structure that a plan sets itself: a check prints them, and its exit code says so."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from falsework.cli.arguments import spell_options
from falsework.cli.exit_code import Exit

if TYPE_CHECKING:
    from falsework.cli.output import Output


def note_overrides(overrides: Mapping[str, Any], output: Output) -> None:
    """Warn of options of the structure that a plan sets, where a command computes with them."""
    if overrides:
        output.note(f"falsework: warning: the plan sets options of its structure itself: {spell_options(overrides)}")


def say_overrides(overrides: Mapping[str, Any], output: Output) -> None:
    """Print options of the structure that a plan sets, as they are written on the command line.

    Args:
        overrides: as `structure_to_check` returns them.
    """
    if overrides:
        output.say(f"options of the structure that the plan sets: {spell_options(overrides)}")


def exit_of_good(plan: Path, overrides: Mapping[str, Any], output: Output, *, accepted: bool) -> Exit:
    """Return the exit code of a check that found nothing wrong, and say what it depends on.

    Args:
        overrides: options of the structure that the plan sets and the command line does not give.
        accepted: whether the command line accepts them all.
    """
    if not overrides or accepted:
        return Exit.DONE
    output.note(
        f"falsework: {plan}: good only with options of the structure that the plan sets itself: "
        f"{spell_options(overrides)}; give them too, or --accept-overrides"
    )
    return Exit.CONDITIONAL
