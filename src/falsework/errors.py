"""Exceptions and warnings; every message names the fault, the part where there is one, and the remedy."""

from __future__ import annotations

__all__ = [
    "AssemblyError",
    "CellError",
    "DependencyError",
    "FalseworkError",
    "InputError",
    "MeshError",
    "NotFoundError",
    "PlanError",
    "ReadWarning",
    "SolverError",
    "StateError",
    "TrainingError",
]


class FalseworkError(Exception):
    """Base of all exceptions that this package raises."""


class InputError(FalseworkError, ValueError):
    """Invalid input; the message names the remedy (command line: exit code 2)."""


class MeshError(InputError):
    """Mesh that cannot be read, is not closed, or has no volume."""


class AssemblyError(InputError):
    """Parts, boundary, density or friction that do not make an assembly."""


class UntouchedPartError(AssemblyError):
    """A part of an assembly touches no other."""


class StateError(InputError):
    """State or action of the wrong length or with invalid values."""


class CellError(InputError):
    """Cell file or robot description that cannot be used."""


class PlanError(InputError):
    """Plan file that is damaged, of another version, or of another assembly."""


class NotFoundError(FalseworkError):
    """Result without a value, of which the value was asked for; the message says why there is none."""


class DependencyError(InputError, ImportError):
    """Missing optional package; the message names the extra that installs it."""


class ReadWarning(UserWarning):
    """Content of a file that the structure does not have, or has in another way than the file."""


class ExportWarning(UserWarning):
    """Property of a structure that a file of another program does not hold."""


class SolverError(FalseworkError):
    """Failure of a numerical library where the mathematics excludes one."""


class TrainingError(FalseworkError):
    """Training that cannot continue, such as after a non-finite loss; saved checkpoints remain valid."""
