"""Libraries of the checks: Pinocchio and Coal, imported where they are needed."""

from __future__ import annotations

from typing import Any

from falsework.errors import DependencyError


def import_pinocchio() -> tuple[Any, Any]:
    """Return the modules Pinocchio and Coal; DependencyError without them."""
    try:
        import coal
        import pinocchio
    except ImportError:
        raise DependencyError(
            "checking robot plans needs Pinocchio and Coal; install them: pip install 'falsework[robots]'"
        ) from None
    return pinocchio, coal
