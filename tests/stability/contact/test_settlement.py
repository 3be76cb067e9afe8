"""Small bearings that settle: the verdict does not depend on how much, only on whether parts come to rest."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from falsework import Assembly, StabilityOracle, StabilitySettings, Verdict, verify_certificates
from falsework.stability.contact.build_verifier import BuildVerifier
from falsework.stability.contact.replay import Replayer
from falsework.stability.gpu.solver import GpuSolver

CONTACT = StabilitySettings()


def corners(scenes: Any, width: float, bottom: float, height: float = 0.02) -> list[Any]:
    """Four shims under the corners of a stone of 3 x 3 m."""
    middle = 1.5 - 0.2
    places = [(x, y) for x in (-middle, middle) for y in (-middle, middle)]
    return [
        scenes.box([x - width / 2, y - width / 2, bottom], [x + width / 2, y + width / 2, bottom + height], f"shim-{k}")
        for k, (x, y) in enumerate(places)
    ]


def stone_on_shims(scenes: Any, width: float) -> Assembly:
    """The ground is part 0."""
    ground = scenes.box([-2, -2, -0.5], [2, 2, 0], "ground")
    stone = scenes.box([-1.5, -1.5, 0.02], [1.5, 1.5, 1.02], "stone")
    return scenes.make([ground, *corners(scenes, width, 0.0), stone], [0])


def stones_on_shims(scenes: Any, width: float) -> Assembly:
    """Four stones on each other, on shims in every joint."""
    boxes = [scenes.box([-2, -2, -0.5], [2, 2, 0], "ground")]
    for course in range(4):
        bottom = 1.02 * course
        boxes += corners(scenes, width, bottom)
        boxes.append(scenes.box([-1.5, -1.5, bottom + 0.02], [1.5, 1.5, bottom + 1.02], f"stone-{course}"))
    return scenes.make(boxes, [0])


def stone_beside_a_wall(scenes: Any, width: float) -> Assembly:
    """A stone on shims that touches a fixed wall, along which it settles."""
    wall = scenes.box([1.5, -2, -0.5], [2, 2, 2], "wall")
    ground = scenes.box([-2, -2, -0.5], [1.5, 2, 0], "ground")
    stone = scenes.box([-1.5, -1.5, 0.02], [1.5, 1.5, 1.02], "stone")
    return scenes.make([ground, wall, *corners(scenes, width, 0.0), stone], [0, 1])


def stone_on_slope(scenes: Any, width: float) -> Assembly:
    """A stone on shims on a slope steeper than friction holds."""
    turn = scenes.about_y(np.deg2rad(31))
    boxes = [scenes.box([-2, -2, -0.5], [2, 2, 0], "ground", turn)]
    middle = 1.5 - 0.2
    for k, (x, y) in enumerate((x, y) for x in (-middle, middle) for y in (-middle, middle)):
        low, high = [x - width / 2, y - width / 2, 0], [x + width / 2, y + width / 2, 0.02]
        boxes.append(scenes.box(low, high, f"shim-{k}", turn))
    return scenes.make([*boxes, scenes.box([-1.5, -1.5, 0.02], [1.5, 1.5, 1.02], "stone", turn)], [0])


def complete(assembly: Assembly) -> Any:
    return np.where(assembly.boundary, 2, 1).astype(np.uint8)[None]


STAND = (stone_on_shims, stones_on_shims, stone_beside_a_wall)


@pytest.mark.parametrize("width", [0.005, 0.015, 0.03, 0.1])
@pytest.mark.parametrize("scene", STAND)
def test_stands_on_bearings_of_any_size(scenes: Any, scene: Callable[..., Assembly], width: float) -> None:
    assembly = scene(scenes, width)
    state = complete(assembly)
    verdicts = StabilityOracle(assembly).verdicts(state, require_certificate=True)
    assert verdicts.stable.all()
    assert verify_certificates(assembly, state, verdicts, CONTACT.claim).all()


@pytest.mark.parametrize("width", [0.005, 0.1])
def test_slides_on_bearings_of_any_size(scenes: Any, width: float) -> None:
    assembly = stone_on_slope(scenes, width)
    assert StabilityOracle(assembly).verdicts(complete(assembly), require_certificate=True).verdict[0] in (
        Verdict.SLIDES,
        Verdict.UNSTABLE,
    )


@pytest.mark.parametrize("scene", STAND)
def test_stands_as_it_is_built(scenes: Any, scene: Callable[..., Assembly]) -> None:
    assembly = scene(scenes, 0.01)
    states = np.zeros((assembly.part_count + 1, assembly.part_count), np.uint8)
    for row in range(len(states)):
        states[row, :row] = 1
        states[row, assembly.boundary] = 2
    replayer = Replayer(assembly)
    assert replayer.replay(states).good
    verifier = BuildVerifier(assembly, replayer.settings.claim)
    presses = [()] * len(states)
    proofs = [
        verifier.step(state, proof) for state, proof in zip(states, replayer.certificates(states, presses), strict=True)
    ]
    assert max(proof.residual for proof in proofs) <= CONTACT.tolerance


@pytest.mark.parametrize("scene", STAND)
def test_never_slides_on_the_gpu(
    scenes: Any, scene: Callable[..., Assembly], make_solver: Callable[..., GpuSolver]
) -> None:
    """Single precision may leave states with so different bearings undecided, which the processor then decides."""
    assembly = scene(scenes, 0.01)
    verdicts = make_solver(assembly, CONTACT).check(complete(assembly))
    assert (verdicts.stable | verdicts.undecided).all()
    assert verdicts.stable.all() or scene is stones_on_shims
