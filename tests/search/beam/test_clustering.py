"""k-means against properties of its optimum and against SciPy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.cluster.vq import kmeans2

from falsework.search.beam.k_means import k_means


def test_separated_clusters_are_found() -> None:
    rng = np.random.default_rng(0)
    centers = 100.0 * np.eye(6)
    truth = np.repeat(np.arange(6), 20)
    labels, _ = k_means(centers[truth] + rng.normal(size=(120, 6)), 6, rng)
    for cluster in range(6):
        assert len(np.unique(labels[truth == cluster])) == 1
    assert len(np.unique(labels)) == 6


def test_distance_is_to_the_nearest_centre_and_the_centre_is_the_mean() -> None:
    rng = np.random.default_rng(1)
    points = rng.integers(0, 3, size=(300, 20)).astype(float)
    labels, distance = k_means(points, 8, rng, iterations=500)
    centers = np.array([points[labels == cluster].mean(axis=0) for cluster in range(8)])
    gaps = ((points[:, None] - centers[None]) ** 2).sum(axis=2)
    assert np.array_equal(gaps.argmin(axis=1), labels)
    np.testing.assert_allclose(distance, gaps.min(axis=1), rtol=1e-4, atol=1e-4)


def test_as_good_as_scipy() -> None:
    """Sum of squares, mean of ten runs each: a few per cent at most above SciPy's with the same seeding."""
    rng = np.random.default_rng(2)
    points = rng.integers(0, 3, size=(400, 30)).astype(float)
    ours = np.mean([k_means(points, 16, np.random.default_rng(seed), iterations=20)[1].sum() for seed in range(10)])
    theirs = []
    for seed in range(10):
        centers, labels = kmeans2(points, 16, iter=20, minit="++", rng=np.random.default_rng(seed))
        theirs.append(((points - centers[labels]) ** 2).sum())
    assert ours <= 1.03 * np.mean(theirs)


def test_every_cluster_has_a_point_where_there_are_enough() -> None:
    rng = np.random.default_rng(3)
    points = np.unique(rng.integers(0, 3, size=(200, 6)), axis=0)
    for clusters in (1, 7, 64, len(points)):
        labels, _ = k_means(points, clusters, rng, iterations=30)
        assert len(np.unique(labels)) == clusters


def test_repeated_points_do_not_break_it() -> None:
    labels, distance = k_means(np.ones((10, 3)), 4, np.random.default_rng(0))
    assert labels.shape == distance.shape == (10,)
    assert (distance < 1e-5).all()


def test_same_seed_same_clusters() -> None:
    points = np.random.default_rng(4).integers(0, 3, size=(100, 10))
    first, _ = k_means(points, 9, np.random.default_rng(5))
    second, _ = k_means(points, 9, np.random.default_rng(5))
    assert np.array_equal(first, second)


@pytest.mark.parametrize("clusters", [0, 5])
def test_impossible_numbers(clusters: int) -> None:
    with pytest.raises(ValueError, match="clusters"):
        k_means(np.zeros((4, 2)), clusters, np.random.default_rng(0))
