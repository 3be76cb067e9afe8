"""Text of one file of an export."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Written:
    """One file of an export."""

    name: str
    """Path inside the output folder."""
    text: str
