"""Features of structures with lines and points among their contacts: all numbers finite, shares as they should be."""

from __future__ import annotations

import numpy as np
import pytest

from falsework import Assembly
from falsework.learn.networks.force_torque_graph import ForceTorqueGraph
from falsework.learn.networks.geometric_features import PartFeatures


def test_a_line_is_a_small_share_of_what_surrounds_a_part(beam_on_ridge: Assembly) -> None:
    features = PartFeatures.from_assembly(beam_on_ridge)
    for array in (features.part, features.pair, features.ports):
        assert np.isfinite(array).all()
    of_beam = features.ports[0, 2]
    assert of_beam.sum() == pytest.approx(1.0)
    assert 0 < of_beam[1] < 0.01 < of_beam[0]
    assert features.ports[0, 1, 2] == pytest.approx(1.0), "the ridge touches nothing else"
    assert features.ports[5, 2, :2].sum() == pytest.approx(1.0), "both carry it"


def test_a_line_is_a_force_with_two_torques(beam_on_ridge: Assembly) -> None:
    graph = ForceTorqueGraph.from_assembly(beam_on_ridge)
    assert graph.force_parts.tolist() == [[0, 2], [1, 2]]
    assert np.bincount(graph.point_force).tolist() == [4, 2]
    assert graph.normals == pytest.approx(np.array([(0, 0, 1.0)] * 2))
