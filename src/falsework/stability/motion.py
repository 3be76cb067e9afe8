"""Motion of the parts in an unstable state, from its certificate."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.model import Assembly
from falsework.stability.verdict import Verdict, Verdicts

SLIDING_SHARE = 0.1
"""Share of the largest movement from which a part of a sliding state counts as moving: the others only settle."""


def motion_of(assembly: Assembly, verdicts: Verdicts, row: int) -> NDArray[np.float64] | None:
    """Return the initial motion of the parts of one state, up to scale.

    Of an unstable state it is the virtual velocity that proves it; of a sliding state it is the displacement at
    which the iterations ended, without the parts that move less than `SLIDING_SHARE` of the largest movement; of a
    state that tips it is the motion that grows, without those too.

    Args:
        verdicts: with certificates, as `StabilityOracle.verdicts` returns them where asked to.

    Returns:
        `(linear, angular)` about the centres of mass, shape (parts, 6); None where the state is stable or undecided,
        or no motion is known.
    """
    verdict = verdicts.verdict[row]
    if verdict == Verdict.UNSTABLE and verdicts.velocity is not None:
        return verdicts.velocity[row]
    moving = {Verdict.SLIDES: verdicts.displacement, Verdict.TIPS: verdicts.velocity}.get(Verdict(verdict))
    if moving is None:
        return None
    displacement = moving[row]
    if not np.isfinite(displacement).all():
        return None
    moved = np.maximum(
        np.linalg.norm(displacement[:, :3], axis=1),
        np.linalg.norm(displacement[:, 3:], axis=1) * assembly.mass.gyration,
    )
    if not moved.any():
        return None
    return np.where((moved > SLIDING_SHARE * moved.max())[:, None], displacement, 0.0)
