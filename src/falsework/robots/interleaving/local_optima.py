"""Ways out of local optima of the search for orders: slightly worse orders, from which better ones are searched nearby.

Iterated local search, after Lourenço, Martin and Stützle (2003).
"""

from __future__ import annotations

import numpy as np

from falsework.robots.interleaving.search import LENGTHS, OrderSearch

_TRIES = 640
"""Windows that are searched for another order."""
_MOST = 40
"""Orders from which better ones are searched."""
_PATIENCE = 24
"""Orders in succession from which none is better than the best one, after which the search ends."""
_WORSE = 0.02
"""Share by which such an order may be worse."""
_DRIFT = 0.002
"""Share by which the order at the end of a search may be worse to go on from it."""
_NEAR = 8
"""Steps before and after the window that are searched again."""
_SWEEPS = (10, 14)
"""Steps of the windows in that search, in turn."""
_TURNS = 4


def leave_local_optima(search: OrderSearch, seed: int) -> None:
    """Search for better orders from the best one on.

    Args:
        search: a search whose windows lead to no better order.
        seed: seed of the choice of windows.
    """
    rng, steps, found, since = np.random.default_rng(seed), len(search.best) - 1, 0, 0
    best = base = list(search.units), search.best, search.cost
    for _ in range(_TRIES):
        if search.stop() or found == _MOST or since == _PATIENCE:
            break
        size = int(rng.choice(sorted(LENGTHS)))
        first = int(rng.integers(max(steps - size, 1)))
        if not search.improve(first, size, worse=_WORSE):
            continue
        found, since = found + 1, since + 1
        _descend(search, max(first - _NEAR, 0), min(first + size + _NEAR, steps))
        if search.cost < base[2] * (1 + _DRIFT):
            base = list(search.units), search.best, search.cost
        else:
            search.take(base[:2])
        if base[2] < best[2]:
            best, since = base, 0
    search.take(best[:2])


def _descend(search: OrderSearch, first: int, last: int) -> None:
    """Search the windows of a part of the order until none leads to a better one."""
    for _ in range(_TURNS):
        better = False
        for size in _SWEEPS:
            for k in range(first, last, size // 2):
                if search.stop():
                    return
                better |= search.improve(k, size)
        if not better:
            return
