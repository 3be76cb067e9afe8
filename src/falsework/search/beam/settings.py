"""Settings of a beam search."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

from falsework.errors import InputError
from falsework.search.problem.task import Direction
from falsework.utils.quantity import check_seed

AHEAD = 16
"""Candidates beyond those that a beam keeps for their verdicts, for each state of its width: states ahead without a
need for a verdict, and moves that failed before and are tried again. More are a wider choice for the next level."""
WIDENING = 4
"""A beam that restarts is so many times wider. Beams for missing parts restart once; those for other plans begin so
wide, and restart once."""

SLIP = 0.1
"""Share of the movement limit from which a step that comes to rest waits until nothing else can be tried. Steps that
move parts so far leave structures that a later release brings down, often far away; most steps move parts by less than
a hundredth."""
MEMORY = 256 << 20
"""Bytes for what only saves work: contact histories, and states of a device written down at once."""

Diversity = Literal["k-means", "none"]


@dataclass(frozen=True)
class BeamSettings:
    """Settings of a beam search."""

    width: int = 64
    """States kept at a level."""
    direction: Direction = Direction.ASSEMBLY
    """Direction of the search: assembly begins at the empty structure, disassembly at the complete one."""
    diversity: Diversity = "k-means"
    """How states are chosen where there are too many: one from each of `width` clusters, or the best scored."""
    lookahead: int = 0
    """0: request all verdicts of a level, then select `width` of the stable states, as the paper does.
    Above 0: request verdicts in order of promise (free robots, then score) until `width` states are stable, and keep
    this many more that need no verdict, so that the next level has a choice. Narrow beams then need few verdicts."""
    commit: bool = False
    """With `lookahead`: drop states that keep more robots busy than the `width` states found stable."""
    number: int = 0
    """Draws random numbers, together with the seed; of dead ends so far."""
    seed: int = 0
    """Same seed, same machine, same result."""
    history_bytes: int = MEMORY
    """Memory for contact histories; those that it has no room for are computed anew where they are needed again."""
    pool: int = 8_000_000
    """Bound on candidates times parts that are written down and clustered at once; beyond it a random sample is."""
    restarts: bool = False
    """Where the beam dies, jump back from the dead end, and at last restart wider, see `BeamSearch`."""

    @classmethod
    def from_width(
        cls,
        width: int = 1,
        direction: Direction = Direction.ASSEMBLY,
        *,
        seed: int = 0,
        lookahead: int = WIDENING * AHEAD,
    ) -> BeamSettings:
        """Return settings for one plan, of a beam that looks ahead, jumps back from dead ends and restarts.

        Args:
            width: to begin with.
            seed: same seed, same machine, same result.
            lookahead: states ahead of narrow beams, so that the next level has a choice; with fewer, little but what
                the guide puts first is tried.
        """
        ahead = max(lookahead, AHEAD * width)
        return cls(width, direction, "none", lookahead=ahead, commit=width == 1, seed=seed, restarts=True)

    def wider(self) -> BeamSettings:
        """Return the settings of a restart."""
        width = WIDENING * self.width
        return replace(self, width=width, lookahead=max(self.lookahead, AHEAD * width), commit=False)

    def __post_init__(self) -> None:
        if self.width < 1:
            raise InputError(f"a beam of width {self.width} keeps nothing; give at least 1")
        if self.lookahead < 0:
            raise InputError(f"a beam cannot keep {self.lookahead} states ahead; give 0 or more")
        if self.pool < 1:
            raise InputError("the pool of a beam search must hold at least one number")
        check_seed(self.seed)
