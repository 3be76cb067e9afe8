"""k-means on tensors, shared by several processes, the same to the last bit however many there are."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from falsework.search.shards import Shards
from falsework.search.tensors import import_torch, mix, uniform

if TYPE_CHECKING:
    import torch

_EXACT = 2**24
"""Whole numbers up to this are exact in float32."""
_FINEST = 64
"""Centres are rounded to this share of a unit, or coarser where there are very many dimensions."""
_ROUNDS = 8
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
    iterations: int = 5,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Lloyd's algorithm on whole numbers, from seeds drawn in rounds.

    Centres are rounded to multiples of a power of two, small enough that every sum and product below stays a whole
    number that float32 holds exactly; sums of points are integers. So neither the order of additions, nor the shape
    of a matrix product, nor the number of processes can change a label.

    The seeds are those of k-means++ with a round of draws in place of each single one: points are drawn with
    probability about proportional to the squared distance from the seeds of earlier rounds (priority sampling:
    the largest ratios of weight to a uniform random number), so eight products of matrices do what one dependent step a
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
    scale = min(max(2 ** int(np.log2(np.sqrt(_EXACT / (4 * max(dimensions, 1))))), 1), _FINEST)
    squared = (x * x).sum(dim=1)
    centers = _seeds(x, squared, words, clusters, shards) * scale
    # One row a point: its values, and a one to count it.
    rows = torch.cat([points, torch.ones_like(points[:, :1])], dim=1).int()
    for _ in range(iterations):
        labels = _nearest(x, centers, scale)
        sums = torch.zeros((clusters, dimensions + 1), dtype=torch.int32, device=x.device)
        shards.add(sums.index_add_(0, labels, rows))
        size = sums[:, -1:]
        mean = (sums[:, :-1].double() * scale / size).round_().float()
        centers = torch.where(size > 0, mean, centers)
    labels = _nearest(x, centers, scale)
    own = centers[labels]
    distance = ((own - scale * x) ** 2).sum(dim=1).long()
    both = shards.gather_blocks(torch.stack([labels, distance], dim=1), count)
    return both[:, 0], both[:, 1]


def _products(x: torch.Tensor, centers: torch.Tensor, scale: int) -> Iterator[torch.Tensor]:
    """Squared distances from scaled centres less the points' own squares, in chunks of shape (rows, centers)."""
    torch = import_torch()
    norm = (centers * centers).sum(dim=1)
    rows = max(_CHUNK[x.device.type] // max(len(centers), 1), 1)
    for begin in range(0, len(x), rows):
        yield torch.addmm(norm, x[begin : begin + rows], centers.T, alpha=-2.0 * scale)


def _nearest(x: torch.Tensor, centers: torch.Tensor, scale: int) -> torch.Tensor:
    """Nearest scaled centre of each point, the first of several; shape (points,)."""
    return _join([gaps.argmin(dim=1) for gaps in _products(x, centers, scale)], x.new_empty(0).long())


def _seeds(x: torch.Tensor, squared: torch.Tensor, words: torch.Tensor, clusters: int, shards: Shards) -> torch.Tensor:
    """Points to begin with, drawn in rounds, shape (clusters, dimensions)."""
    torch = import_torch()
    rounds = min(_ROUNDS, clusters)
    # All rounds' random numbers at once, by keys that differ from round to round: small kernels cost their launch.
    turns = torch.arange(rounds, device=x.device)[:, None] * 0x1E3779B97F4A7C15
    noise = uniform(mix(words[None] + turns, 0))
    chosen = []
    weight = torch.ones(len(x), dtype=torch.float64, device=x.device)
    for turn, wanted in enumerate(np.diff(np.linspace(0, clusters, rounds + 1).astype(int)).tolist()):
        best, row = torch.topk(weight / noise[turn], min(wanted, len(x)))
        fresh = x[row]
        if shards.size > 1:
            # Each process offers its best; the best of all are the best of these.
            offer = torch.full((wanted, x.shape[1] + 1), -1.0, dtype=torch.float64, device=x.device)
            offer[: len(row), :1], offer[: len(row), 1:] = best[:, None], fresh
            offer = shards.gather(offer)
            fresh = offer[torch.sort(offer[:, 0], descending=True, stable=True).indices[:wanted], 1:].float()
        chosen.append(fresh)
        nearest = _join([gaps.amin(dim=1) for gaps in _products(x, fresh, 1)], squared[:0]).add_(squared).double()
        weight = torch.minimum(weight, nearest) if turn else nearest
    return torch.cat(chosen)


def _join(chunks: list[torch.Tensor], empty: torch.Tensor) -> torch.Tensor:
    """The chunks one after the other; without a copy if there is only one."""
    return chunks[0] if len(chunks) == 1 else import_torch().cat([*chunks, empty])
