"""Small pictures of single states, as environments render them."""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray

from falsework.assembly.model import Assembly
from falsework.search.problem.task import Direction
from falsework.viewer.appearance import bounds_of
from falsework.viewer.pictures.contact_sheet import Pixels, legend, one_state
from falsework.viewer.pictures.render import Camera
from falsework.viewer.timeline import Timeline

FRAME = Camera(width=480, height=320, zoom=0.94)
"""View of the picture of an environment."""


def state_frame(assembly: Assembly, state: NDArray[Any], robots: int, words: str) -> Pixels:
    """Draw a state with a line above and the legend; see `falsework.utils.display.frame.frame_of`."""
    timeline = Timeline.from_state(assembly, state, robots).turned(Direction.DISASSEMBLY)
    return one_state(
        timeline, 0, FRAME, key=legend(timeline), bounds=bounds_of(assembly), words=words or assembly.name, samples=2
    )
