"""Arrows show what the certificates say."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from falsework import StabilityOracle, find_plans, load_structure
from falsework.assembly import complete_state
from falsework.search.find import PLANS
from falsework.stability.verdict import Criterion
from falsework.viewer import Timeline
from falsework.viewer.arrows import Arrows, arrow_mesh, arrows_of_forces
from falsework.viewer.page.scene import ViserScene
from falsework.viewer.page.viewer_state import ViewerState
from falsework.viewer.palette import MOTION, rgb
from falsework.viewer.proof import proof_of_state
from falsework.viewer.viewable import Viewable


def total(arrows: Arrows) -> np.ndarray:
    return (arrows.ends[:, 1] - arrows.ends[:, 0]).sum(axis=0)


def test_forces_on_a_lying_block_balance_its_weight() -> None:
    """A wall of one brick on the ground: pressure up is as long as the weight down, and nothing rubs."""
    stack = load_structure("stack:blocks=1,overhang=0.2")
    state = complete_state(stack.boundary)
    proof = proof_of_state(StabilityOracle(stack), state)
    assert proof.stable
    np.testing.assert_allclose(
        total(proof.arrows["contact forces"]) + total(proof.arrows["friction"]), -total(proof.arrows["gravity"]),
        atol=1e-3 * float(np.linalg.norm(total(proof.arrows["gravity"]))),
    )  # fmt: skip
    assert total(proof.arrows["gravity"])[2] < 0


@pytest.mark.parametrize("criterion", ["contact", "equilibrium"])
def test_proofs_of_a_plan_are_those_under_its_gravity(criterion: Criterion) -> None:
    """A block is pulled up by one and a half times its weight on the earth: it lies where it weighs twice as much."""
    spec = "stack:blocks=1,overhang=0.2"
    weight = load_structure(spec).applied_wrench()[0, 2]
    stack = load_structure(spec, loads=[{"part": 0, "force": [0, 0, -1.5 * weight]}])
    plan = find_plans(stack, robots=1, stability=replace(PLANS, gravity=2 * 9.81)).unwrap()
    assert not proof_of_state(StabilityOracle(stack), plan.states[-1]).stable
    timeline = Timeline.from_plan(plan, stack)
    page = ViewerState(timeline, plan=plan, criterion=criterion)
    page.position = float(len(plan))
    shown = Viewable("plan", stack, timeline, plan)
    for proof in (page.proof(), shown.proofs([len(plan)], criterion)[len(plan)]):
        assert proof.stable
        assert proof.arrows["gravity"].longest == pytest.approx(-0.5 * weight)


def test_an_unstable_arch_moves_and_its_keystone_falls() -> None:
    arch = load_structure("arch:blocks=15,thickness=0.08")
    state = complete_state(arch.boundary)
    proof = proof_of_state(StabilityOracle(arch), state)
    assert not proof.stable
    assert proof.decided
    assert "would move" in proof.words
    assert len(proof.arrows["motion"])
    top = int(np.argmax(arch.mass.center[:, 2]))
    assert proof.moved[top][:, 2].mean() < arch.meshes[top].vertices[:, 2].mean()
    assert not set(proof.moved) & set(np.flatnonzero(arch.boundary).tolist())


def test_a_state_in_which_all_is_held_has_no_forces() -> None:
    arch = load_structure("arch:blocks=3")
    state = np.full(arch.part_count, 2, dtype=np.uint8)
    proof = proof_of_state(StabilityOracle(arch), state)
    assert proof.stable
    assert "every part is held" in proof.words
    assert all(len(some) == 0 for some in proof.arrows.values())


def test_forces_of_absent_parts_are_not_drawn() -> None:
    arch = load_structure("arch:blocks=5")
    state = np.where(arch.boundary, 2, 0).astype(np.uint8)
    forces = np.ones((len(arch.contacts.points), 3))
    assert all(len(some) == 0 for some in arrows_of_forces(arch, state, forces).values())


@pytest.mark.parametrize("tip", [(0.0, 0.0, 1.0), (1.0, 2.0, -3.0), (1.0, 0.0, 0.0)])
def test_an_arrow_is_a_closed_mesh_that_faces_outwards(tip: tuple[float, float, float]) -> None:
    vertices, faces = arrow_mesh(np.zeros(3), np.array(tip), 0.1)
    corners = vertices[faces]
    assert np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() > 0
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()


def test_moved_parts_have_the_colour_of_their_motion() -> None:
    arch = load_structure("arch:blocks=3")
    sent: dict[str, Any] = {}
    scene = SimpleNamespace(add_mesh_simple=lambda name, *_, color, **__: sent.update({name: color}))
    shown = ViserScene(scene, Timeline.from_state(arch, complete_state(arch.boundary)))
    shown.show_arrows({}, {0: arch.meshes[0].vertices}, MOTION)
    assert sent == {"/motion": rgb(MOTION)}


def test_a_weight_on_the_line_of_a_contact_force_is_seen_around_it() -> None:
    arch = load_structure("arch:blocks=3")
    proof = proof_of_state(StabilityOracle(arch), complete_state(arch.boundary))
    assert proof.arrows["gravity"].breadth > proof.arrows["contact forces"].breadth
