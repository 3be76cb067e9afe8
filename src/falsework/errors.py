"""One exception tree; every message says what was wrong, which part, and what to do."""

from __future__ import annotations

__all__ = [
    "AssemblyError",
    "CellError",
    "DependencyError",
    "FalseworkError",
    "InputError",
    "MeshError",
    "PlanError",
    "SolverError",
    "StateError",
    "TrainingError",
]


class FalseworkError(Exception):
    """Base of everything this package raises on purpose."""


class InputError(FalseworkError, ValueError):
    """What was handed in cannot be used; the message names the remedy (command line: exit code 2)."""


class MeshError(InputError):
    """A mesh cannot be read, is not closed, or has no volume."""


class AssemblyError(InputError):
    """Parts, boundary, density or friction do not make an assembly."""


class StateError(InputError):
    """A state or an action has the wrong length or values."""


class CellError(InputError):
    """A cell file or a robot description cannot be used."""


class PlanError(InputError):
    """A plan file is damaged, of another version, or for another assembly."""


class DependencyError(InputError, ImportError):
    """An optional package is missing; the message says which extra installs it."""


class SolverError(FalseworkError):
    """A numerical library failed where the mathematics says that it must not."""


class TrainingError(FalseworkError):
    """Training cannot go on, such as after a loss that is not a finite number; what was saved is still good."""
