"""k-means over states, which keeps a beam diverse (paper, section 5.1)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray


def k_means(
    points: ArrayLike, clusters: int, rng: np.random.Generator, *, iterations: int = 10
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Lloyd's algorithm from k-means++ seeds.

    Args:
        points: shape (count, dimensions); states as they are, 0, 1 and 2.
        clusters: number of clusters, at most `count`.
        rng: where the seeds come from; the same generator state gives the same clusters.
        iterations: upper bound; stops before when no label changes.

    Returns:
        Cluster of each point, shape (count,), and squared distance to its centre, shape (count,). A cluster may end
        empty only if there are fewer distinct points than clusters.
    """
    x = np.ascontiguousarray(points, dtype=np.float32)
    count = len(x)
    if not 1 <= clusters <= count:
        raise ValueError(f"cannot make {clusters} clusters of {count} points")
    squared = np.einsum("ij,ij->i", x, x)
    centers = _seeds(x, squared, clusters, rng)
    labels = np.full(count, -1, dtype=np.int64)
    distance = np.zeros(count, dtype=np.float32)
    for _ in range(iterations):
        gap = np.einsum("ij,ij->i", centers, centers)[None] - 2.0 * (x @ centers.T)
        nearest = gap.argmin(axis=1)
        distance = np.maximum(gap[np.arange(count), nearest] + squared, 0.0)
        if np.array_equal(nearest, labels):
            break
        labels = nearest
        order = np.argsort(labels, kind="stable")
        filled, begin = np.unique(labels[order], return_index=True)
        size = np.diff(np.append(begin, count))[:, None]
        centers = centers.copy()
        centers[filled] = np.add.reduceat(x[order], begin, axis=0) / size
        empty = np.setdiff1d(np.arange(clusters), filled)
        # An empty cluster restarts at one of the points that are worst served now.
        far = np.argsort(-distance, kind="stable")[: len(empty)]
        centers[empty] = x[far]
    return labels, distance


def _seeds(
    x: NDArray[np.float32], squared: NDArray[np.float32], clusters: int, rng: np.random.Generator
) -> NDArray[np.float32]:
    """k-means++: each next seed is drawn with probability proportional to its squared distance from the others."""
    chosen = np.empty(clusters, dtype=np.int64)
    chosen[0] = rng.integers(len(x))
    nearest = np.full(len(x), np.inf, dtype=np.float32)
    draws = rng.random(clusters)
    for k in range(1, clusters):
        last = x[chosen[k - 1]]
        np.minimum(nearest, squared - 2.0 * (x @ last) + last @ last, out=nearest)
        nearest[chosen[k - 1]] = 0.0
        cumulative = np.cumsum(np.maximum(nearest, 0.0), dtype=np.float64)
        chosen[k] = min(np.searchsorted(cumulative, draws[k] * cumulative[-1], side="right"), len(x) - 1)
    return x[chosen]
