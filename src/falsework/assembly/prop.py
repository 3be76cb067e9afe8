"""Place of a prop: the part that it carries, the position of its head, and the height of its floor."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Prop:
    """Place of a prop."""

    part: int
    """Part that it carries."""
    at: tuple[float, float, float]
    """Middle of its head, on the lower side of the part, m."""
    floor: float
    """Height of its floor, m."""

    def to_dict(self) -> dict[str, Any]:
        """Return the place as a JSON object."""
        return {"part": self.part, "at": list(self.at), "floor": self.floor}
