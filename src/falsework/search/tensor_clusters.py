"""k-means on tensors, shared by several processes, the same to the last bit however many there are."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from falsework.search.shards import Shards
from falsework.search.tensors import import_torch, mix, uniform

if TYPE_CHECKING:
    import torch

_EXACT = 2**24
"""Whole numbers up to this are exact in float32."""
_ROUNDS = 16
"""Rounds in which the seeds are drawn."""
_CHUNK = {"cpu": 1 << 21, "cuda": 1 << 29}
"""Distances worked out at once."""


def k_means(
    points: torch.Tensor,
    count: int,
    words: torch.Tensor,
    clusters: int,
    *,
    shards: Shards = Shards(),
    iterations: int = 10,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Lloyd's algorithm on whole numbers, from seeds drawn in rounds.

    Centres are rounded to multiples of a power of two, small enough that every sum and product below stays a whole
    number that float32 holds exactly; sums of points are integers. So neither the order of additions, nor the shape
    of a matrix product, nor the number of processes can change a label.

    The seeds are those of k-means++ with a round of draws in place of each single one: points are drawn with
    probability about proportional to the squared distance from the seeds of earlier rounds (priority sampling:
    the largest ratios of weight to a uniform random number), so 16 products of matrices do what one dependent step a
    cluster did.

    Args:
        points: this process's block of the points, `uint8`, values 0, 1 and 2, shape (block, dimensions); see
            `Shards.block`. All points together must differ from each other.
        count: number of all points, more than `clusters`.
        words: random word of each point of the block, int64, shape (block,).
        clusters: number of clusters.
        shards: the processes that share the points.
        iterations: Lloyd iterations.

    Returns:
        Of all points, in every process: cluster, int64, and squared distance from its centre in units of its own,
        int64; both of shape (count,). Clusters may end empty.
    """
    torch = import_torch()
    if not 1 <= clusters < count:
        raise ValueError(f"cannot make {clusters} clusters of {count} points")
    x = points.float()
    dimensions = x.shape[1]
    # Largest power of two for which a squared norm of a scaled centre stays exact.
    scale = max(2 ** int(np.log2(np.sqrt(_EXACT / (4 * max(dimensions, 1))))), 1)
    scale = min(scale, 64)
    squared = (x * x).sum(dim=1) * (scale * scale)
    centers = _seeds(x, squared / (scale * scale), words, clusters, shards) * scale
    for step in range(iterations + 1):
        labels, gap = _nearest(x, centers, scale)
        if step == iterations:
            break
        # One row a cluster: the sum of its points, and their number.
        sums = torch.zeros((clusters, dimensions + 1), dtype=torch.int32, device=x.device)
        ones = torch.ones((len(x), 1), dtype=torch.int32, device=x.device)
        sums.index_add_(0, labels, torch.cat([points.int(), ones], dim=1))
        shards.add(sums)
        size = sums[:, -1:]
        mean = torch.div(2 * scale * sums[:, :-1] + size, 2 * size.clamp(min=1), rounding_mode="floor")
        centers = torch.where(size > 0, mean.float(), centers)
    distance = (gap + squared).clamp(min=0).long()
    both = shards.gather_blocks(torch.stack([labels, distance], dim=1), count)
    return both[:, 0], both[:, 1]


def _nearest(x: torch.Tensor, centers: torch.Tensor, scale: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Nearest centre of each point, and its squared distance less that of the point from the origin."""
    torch = import_torch()
    norm = (centers * centers).sum(dim=1)
    labels = torch.empty(len(x), dtype=torch.int64, device=x.device)
    gap = torch.empty(len(x), dtype=torch.float32, device=x.device)
    rows = max(_CHUNK[x.device.type] // max(len(centers), 1), 1)
    for begin in range(0, len(x), rows):
        chunk = slice(begin, begin + rows)
        distance = torch.addmm(norm, x[chunk], centers.T, alpha=-2.0 * scale)
        labels[chunk] = distance.argmin(dim=1)
        gap[chunk] = distance.gather(1, labels[chunk, None])[:, 0]
    return labels, gap


def _seeds(x: torch.Tensor, squared: torch.Tensor, words: torch.Tensor, clusters: int, shards: Shards) -> torch.Tensor:
    """Points to begin with, drawn in rounds, shape (clusters, dimensions)."""
    torch = import_torch()
    chosen = x.new_empty((0, x.shape[1]))
    weight = torch.ones(len(x), dtype=torch.float64, device=x.device)
    rounds = min(_ROUNDS, clusters)
    for turn, wanted in enumerate(np.diff(np.linspace(0, clusters, rounds + 1).astype(int)).tolist()):
        key = weight / uniform(mix(words, turn))
        # Each process offers its best; those of all are the best of these.
        offered = min(wanted, len(x))
        best, row = torch.topk(key, offered)
        offer = x.new_full((wanted,), -1.0, dtype=torch.float64)
        states = x.new_zeros((wanted, x.shape[1]))
        offer[:offered], states[:offered] = best, x[row]
        offer, states = shards.gather(offer), shards.gather(states)
        fresh = states[torch.sort(offer, descending=True, stable=True).indices[:wanted]]
        chosen = torch.cat([chosen, fresh])
        _, gap = _nearest(x, fresh, 1)
        nearest = (gap + squared).double()
        weight = nearest if turn == 0 else torch.minimum(weight, nearest)
    return chosen
