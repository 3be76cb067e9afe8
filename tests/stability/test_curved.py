"""Bodies in curved beds: closed forms, and linear programs on all facets of random pairs."""

from __future__ import annotations

from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from falsework import Assembly, StabilityOracle, StabilitySettings, Verdict, verify_certificates
from falsework.assembly import Loads
from falsework.stability.second_order.growth import growth_of_motion
from falsework.stability.settings import EQUILIBRIUM

CRITERIA = ("equilibrium", "contact")
STATE = np.array([[1, 2]], dtype=np.uint8)


@pytest.fixture
def pairs(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The makers of curved pairs."""
    monkeypatch.syspath_prepend(str(Path(__file__).resolve().parents[2] / "benchmarks"))
    return import_module("curved_pairs")


def verdict_of(assembly: Assembly, criterion: Any) -> Verdict:
    """Verdict with a circular cone of friction; its certificate is accepted."""
    settings = StabilitySettings(criterion=criterion, cone="quadratic")
    verdicts = StabilityOracle(assembly, settings).verdicts(STATE, require_certificate=True)
    assert verdicts.undecided.any() or verify_certificates(assembly, STATE, verdicts, settings.claim)[0]
    return Verdict(int(verdicts.verdict[0]))


def grid(rows: int, columns: int, *, closed: bool = False) -> NDArray[np.int64]:
    """Triangles over a grid of points, whose second direction may be a circle."""
    wide = columns if closed else columns + 1
    i, j = (index.ravel() for index in np.mgrid[:rows, :columns])
    a, b, c, d = (i * wide + j, (i + 1) * wide + j, (i + 1) * wide + (j + 1) % wide, i * wide + (j + 1) % wide)
    return np.stack([a, b, c, a, c, d], axis=1).reshape(-1, 3)


def circle(pairs: Any, low: float, high: float, facets: int) -> Any:
    """A body in a trough of radius 1 m about the y axis, between two angles in degrees, leaning as the trough does."""
    angle = np.radians(np.linspace(low, high, facets + 1))
    edge = np.stack([np.sin(angle), 0 * angle, -np.cos(angle)], axis=1)
    points = np.stack([edge, edge + [0, 0.5, 0]], axis=1).reshape(-1, 3)
    lean = np.radians((low + high) / 2)
    return pairs.pair_on("circle", points, grid(facets, 1), 0.3 * np.array([-np.sin(lean), 0, np.cos(lean)]))


@pytest.mark.parametrize("criterion", CRITERIA)
@pytest.mark.parametrize(("low", "high", "facets"), [(-40, 45, 40), (-57, 75, 60), (-10, 24, 24)])
def test_a_body_rolls_in_a_trough_past_a_friction_in_closed_form(
    pairs: Any, criterion: str, low: float, high: float, facets: int
) -> None:
    """With all friction up the trough, forces at its two ends turn the body most about the axis of the circle:
    `sin(phi) cos(middle + phi) / cos(half the span) = (r / R) sin(angle of the centre of mass)`.

    Facets have corners where their normal differs by half their angle from that of the circle, and so has the cone.
    """
    half = np.radians((high - low) / 2 / facets)
    body = circle(pairs, low, high, facets).assembly(0.0)
    x, _, z = body.mass.center[0]
    middle, span = np.radians((low + high) / 2), np.radians((high - low) / 2)

    def holds(friction: float) -> bool:
        angle = np.arctan(friction) + half
        return bool(np.sin(angle) * np.cos(middle + angle) / np.cos(span) >= x)

    assert np.hypot(x, z) < 1
    assert x > 0.01
    assert verdict_of(body, criterion) == Verdict.UNSTABLE
    needed = next(friction for friction in np.arange(0, 1, 1e-4) if holds(friction))
    assert verdict_of(body.replace(friction=needed - 1e-3), criterion) == Verdict.UNSTABLE
    assert verdict_of(body.replace(friction=needed + 2 * half), "equilibrium") == Verdict.STABLE


@pytest.mark.parametrize("criterion", CRITERIA)
@pytest.mark.parametrize(("beside", "stable"), [(0, True), (3.5, False), (9, False)])
def test_a_body_without_friction_rolls_in_a_bowl_unless_it_is_centred(
    pairs: Any, criterion: str, beside: float, stable: bool
) -> None:
    """All forces pass by the centre of the sphere, but for the half angle of a facet, here about 2 degrees."""
    angle = np.radians(np.linspace(-30, 30, 17))
    a, b = (values.ravel() for values in np.meshgrid(angle, angle, indexing="ij"))
    points = np.stack([np.sin(a), np.cos(a) * np.sin(b), -np.cos(a) * np.cos(b)], axis=1)
    turn = np.radians(beside)
    turned = points @ np.array([[np.cos(turn), 0, -np.sin(turn)], [0, 1, 0], [np.sin(turn), 0, np.cos(turn)]]).T
    rise = 0.2 * np.array([-np.sin(turn), 0, np.cos(turn)])
    body = pairs.pair_on("sphere", turned, grid(16, 16), rise).assembly(0.0)
    assert len(body.contacts) < 100
    assert np.degrees(np.arctan2(body.mass.center[0, 0], -body.mass.center[0, 2])) == pytest.approx(beside, abs=0.1)
    assert verdict_of(body, criterion) == (Verdict.STABLE if stable else Verdict.UNSTABLE)


@pytest.mark.parametrize("criterion", CRITERIA)
@pytest.mark.parametrize("friction", [0.0, 0.1, 0.3])
@pytest.mark.parametrize("steep", [30, 50])
def test_a_moment_turns_a_ring_in_a_cone(pairs: Any, criterion: str, friction: float, steep: float) -> None:
    """Friction along the rim resists `mu W R / (cos psi sqrt(1 - mu^2 tan^2 psi))`, with the cone inclined by `psi`.

    Facets resist too, as friction by the sine of half their angle, on the side of the cone, would.
    """
    facets, psi = 96, np.radians(steep)
    angle = 2 * np.pi * np.arange(facets) / facets
    ring = np.stack([np.cos(angle), np.sin(angle), np.full(facets, np.tan(psi))], axis=1)
    points = np.concatenate([ring, 0.7 * ring])
    outwards = grid(1, facets, closed=True)[:, ::-1]
    body = pairs.pair_on("cone", points, outwards, np.array([0, 0, 0.2])).assembly(friction)
    weight = 9.81 * body.mass.mass[0]

    def most(mu: float) -> float:
        return float(mu / (np.cos(psi) * np.sqrt(1 - (mu * np.tan(psi)) ** 2))) * weight

    def turned(moment: float) -> Verdict:
        wrench = np.zeros((2, 6))
        wrench[0, 5] = moment
        return verdict_of(body.replace(loads=Loads.from_arrays(2, wrench=wrench)), criterion)

    locked = np.tan(np.pi / facets)
    assert turned(1.02 * most(friction + locked)) == Verdict.UNSTABLE
    if criterion == "equilibrium":
        assert turned(0.98 * np.cos(np.pi / facets) * most(friction)) == Verdict.STABLE


@pytest.mark.parametrize("surface", ["circle", "sphere", "cone", "quadric"])
def test_no_pair_is_stable_that_has_no_equilibrium_on_all_facets(pairs: Any, surface: str) -> None:
    """Below the friction that a linear program on the unsimplified contact needs, no state is stable.

    Forces of some facets are left out, so that a little more friction may be needed: 0.05 is enough here.
    """
    rng = np.random.default_rng(7)
    near = 0
    for _ in range(2):
        pair = pairs.random_pair(rng, surface)
        body = pair.assembly(0.0)
        needed = pairs.critical_friction(pair, EQUILIBRIUM.tolerance, steps=11)
        near += bool(0.0 < needed < np.inf)
        for criterion in CRITERIA:
            if needed > 0.0:
                least = min(needed, 1.5)
                assert verdict_of(body, criterion) != Verdict.STABLE
                assert verdict_of(body.replace(friction=0.98 * least - 1e-3), criterion) != Verdict.STABLE
        if needed < np.inf:
            assert verdict_of(body.replace(friction=needed + 0.05), "equilibrium") == Verdict.STABLE
    assert near >= 1


@pytest.mark.parametrize("criterion", CRITERIA)
def test_planes_that_differ_by_less_than_a_tenth_of_a_degree_keep_their_normals(pairs: Any, criterion: str) -> None:
    """A block in a flat groove of two planes without friction presses on both alike, or slides.

    Each force acts on its own half, so that the centre of mass has to be over the middle half of the groove.
    """
    angle = np.radians(0.045)
    x = np.array([-1.0, 0.0, 1.0, 1.0])
    edge = np.stack([x, 0 * x, np.abs(x) * np.tan(angle)], axis=1)[:3]
    points = np.stack([edge, edge + [0, 4, 0]], axis=1).reshape(-1, 3)
    centred = pairs.pair_on("groove", points, grid(2, 1), np.array([0, 0, 0.5])).assembly(0.0)
    beside = pairs.pair_on("groove", points, grid(2, 1), np.array([1.6, 0, 0.5])).assembly(0.0)
    assert len(centred.contacts) == 1
    assert verdict_of(centred, criterion) == Verdict.STABLE
    assert verdict_of(beside, criterion) == Verdict.UNSTABLE


def test_points_of_curved_contacts_are_corners_of_facets_with_their_normals(pairs: Any) -> None:
    rng = np.random.default_rng(3)
    pair = pairs.random_pair(rng, "quadric")
    contacts = pair.assembly(0.0).contacts
    edges = pair.corners[:, 1:] - pair.corners[:, :1]
    normals = np.cross(edges[:, 0], edges[:, 1])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    for point, frame in zip(contacts.points, contacts.point_frames, strict=True):
        here = np.linalg.norm(pair.corners - point, axis=2).min(axis=1) < 1e-9
        assert (normals[here] @ -frame[0]).max() == pytest.approx(1.0, abs=1e-9)
    assert contacts.curved is not None
    apart = contacts.flat()
    assert (apart.points == contacts.points).all()
    assert apart.point_frames == pytest.approx(contacts.point_frames)
    assert apart.areas.sum() == pytest.approx(contacts.areas.sum())
    back = contacts.take(np.arange(len(contacts))[::-1]).take(np.arange(len(contacts))[::-1])
    assert (back.point_frames == contacts.point_frames).all()


def test_what_tips_in_a_trough_does_not_depend_on_how_its_points_are_grouped(pairs: Any) -> None:
    """A thin sector in a smooth trough falls over sideways; points with frames of their own, or each a contact."""
    angle = np.radians(np.linspace(-65, 65, 41))
    edge = np.stack([np.sin(angle), 0 * angle, -np.cos(angle)], axis=1)
    points = np.stack([edge, edge + [0, 1e-4, 0]], axis=1).reshape(-1, 3)
    curved = pairs.pair_on("circle", points, grid(40, 1), np.array([0, 0, 0.3])).assembly(0.0)
    verdicts = StabilityOracle(curved).verdicts(STATE, require_certificate=True)
    assert verdicts.tips[0]
    assert curved.contacts.curved is not None
    assert verdicts.displacement is not None
    assert verdicts.velocity is not None
    proof = STATE, verdicts.displacement, verdicts.velocity, StabilitySettings().claim
    grown = [growth_of_motion(some, *proof) for some in (curved, replace(curved, contacts=curved.contacts.flat()))]
    assert grown[0] == pytest.approx(grown[1], rel=1e-9)
