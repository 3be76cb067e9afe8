"""k-means on tensors in integer arithmetic: bit-identical on every device and in every process."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from falsework.utils.tensors import import_torch, mix, uniform

if TYPE_CHECKING:
    import torch

SAMPLE = 4
"""Points for each cluster from which centres are found."""
_LLOYD_ITERATIONS = 3
_EXACT_FLOAT32 = 2**24
"""Whole numbers up to this are exact in float32."""
_SEEDING_ROUNDS = 8
"""Rounds in which the seeds are drawn."""
_CHUNK_DISTANCES = {"cpu": 1 << 21, "cuda": 1 << 29}
"""Distances worked out at once."""


@dataclass(frozen=True, eq=False)
class Centers:
    """Centres of clusters of states.

    They are rounded to multiples of a power of two, small enough that every sum and product here is a whole number
    that float32 holds exactly. So neither the order of additions nor the shape of a matrix product can change a label.
    """

    scaled: torch.Tensor
    """Whole numbers as float32, shape (clusters, dimensions)."""
    scale: int
    """Length of a unit."""

    def nearest(self, points: torch.Tensor) -> torch.Tensor:
        """Return the nearest centre of each point, the first of several.

        Shapes (count, dimensions) float32, (count,).
        """
        nearest = (gaps.argmin(dim=1) for gaps in _products(points, self))
        return import_torch().cat([*nearest, points.new_empty(0).long()])

    def assign(self, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the cluster of each point, and squared distance from its centre.

        Args:
            points: `uint8`, values 0, 1 and 2, shape (count, dimensions).

        Returns:
            Both int64, shape (count,); the distance in units of its own.
        """
        x = points.float()
        labels = self.nearest(x)
        return labels, ((self.scaled[labels] - self.scale * x) ** 2).sum(dim=1).long()


def find_centers(points: torch.Tensor, words: torch.Tensor, clusters: int) -> Centers:
    """Find cluster centres by Lloyd's algorithm from seeds drawn in rounds.

    The seeds are those of k-means++ with a round of draws in place of each single one: points are drawn with
    probability about proportional to the squared distance from the seeds of earlier rounds (priority sampling:
    the largest ratios of weight to a uniform random number), so eight products of matrices do what one dependent step
    a cluster did. Clusters may end empty.

    Args:
        points: different from each other, `uint8`, values 0, 1 and 2, shape (count, dimensions).
        words: random word of each point, int64, shape (count,).
        clusters: number of clusters, at most `count`.
    """
    torch = import_torch()
    if not 1 <= clusters <= len(points):
        raise ValueError(f"cannot make {clusters} clusters of {len(points)} points")
    x = points.float()
    dimensions = x.shape[1]
    # Largest power of two for which a squared norm of a scaled centre stays exact.
    scale = max(2 ** int(np.log2(np.sqrt(_EXACT_FLOAT32 / (4 * max(dimensions, 1))))), 1)
    centers = Centers(_seeds(x, words, clusters) * scale, scale)
    # One row a point: its values, and a one to count it.
    rows = torch.cat([points, torch.ones_like(points[:, :1])], dim=1).int()
    for _ in range(_LLOYD_ITERATIONS):
        sums = torch.zeros((clusters, dimensions + 1), dtype=torch.int32, device=x.device)
        sums.index_add_(0, centers.nearest(x), rows)
        size = sums[:, -1:]
        mean = (sums[:, :-1].double() * scale / size).round_().float()
        centers = Centers(torch.where(size > 0, mean, centers.scaled), scale)
    return centers


def _seeds(x: torch.Tensor, words: torch.Tensor, clusters: int) -> torch.Tensor:
    """Return points to begin with, drawn in rounds, shape (clusters, dimensions)."""
    torch = import_torch()
    rounds = min(_SEEDING_ROUNDS, clusters)
    # All rounds' random numbers at once, by keys that differ from round to round: small kernels cost their launch.
    turns = torch.arange(rounds, device=x.device)[:, None] * 0x1E3779B97F4A7C15
    noise = uniform(mix(words[None] + turns, 0))
    squared = (x * x).sum(dim=1)
    weight = torch.ones(len(x), dtype=torch.float64, device=x.device)
    chosen = []
    for turn, wanted in enumerate(np.diff(np.linspace(0, clusters, rounds + 1).astype(int)).tolist()):
        fresh = x[torch.topk(weight / noise[turn], wanted).indices]
        chosen.append(fresh)
        nearest = torch.cat([*(gaps.amin(dim=1) for gaps in _products(x, Centers(fresh, 1))), squared[:0]])
        nearest = nearest.add_(squared).double()
        weight = torch.minimum(weight, nearest) if turn else nearest
    return torch.cat(chosen)


def _products(x: torch.Tensor, centers: Centers) -> Iterator[torch.Tensor]:
    """Yield squared distances from centres less the points' own squares, in chunks of shape (rows, centers)."""
    torch = import_torch()
    scaled = centers.scaled
    norm = (scaled * scaled).sum(dim=1)
    rows = max(_CHUNK_DISTANCES[x.device.type] // max(len(scaled), 1), 1)
    for begin in range(0, len(x), rows):
        yield torch.addmm(norm, x[begin : begin + rows], scaled.T, alpha=-2.0 * centers.scale)
