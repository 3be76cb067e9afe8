"""Faces that touch without being parallel: no force is used that one of the two surfaces would not bear."""

from __future__ import annotations

from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from falsework import (
    Assembly,
    StabilityOracle,
    StabilitySettings,
    Verdict,
    find_plans,
    load_structure,
    verify_certificates,
)
from falsework.assembly import Joints, library
from falsework.geometry import ContactSettings, TriangleMesh
from falsework.search.plans.plan_check import validate_plan
from falsework.stability import Verdicts
from falsework.stability.certificate import residual_bound_of_velocity, residual_of_forces
from falsework.stability.contact_geometry import geometry_of
from falsework.stability.second_order.springs import into_cone
from falsework.stability.settings import EQUILIBRIUM
from falsework.stability.strength import strength_of

CRITERIA = ("equilibrium", "contact")
STATE = np.array([[1, 2]], dtype=np.uint8)


@pytest.fixture
def pairs(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The makers of pairs whose surfaces do not fit."""
    monkeypatch.syspath_prepend(str(Path(__file__).resolve().parents[2] / "benchmarks"))
    return import_module("inclined_pairs")


def checked(assembly: Assembly, criterion: Any) -> Verdicts:
    """Verdict with a circular cone of friction; its certificate is accepted."""
    settings = StabilitySettings(criterion=criterion, cone="quadratic")
    verdicts = StabilityOracle(assembly, settings).verdicts(STATE, require_certificate=True)
    assert verdicts.undecided.any() or verify_certificates(assembly, STATE, verdicts, settings.claim)[0]
    return verdicts


def verdict_of(assembly: Assembly, criterion: Any) -> Verdict:
    return Verdict(int(checked(assembly, criterion).verdict[0]))


def wedge(scenes: Any, bed: float, body: float, friction: float) -> Assembly:
    """A flat box whose lower face leans by `body` degrees, on a bed that leans by `bed` degrees about the same axis."""
    box = scenes.box((-0.5, -0.5, 0.0), (0.5, 0.5, 0.1), "body", scenes.about_y(np.radians(body)))
    slope = scenes.box((-2.0, -2.0, -1.0), (2.0, 2.0, 0.0), "bed", scenes.about_y(np.radians(bed)))
    settings = ContactSettings(gap=0.1, overlap=0.1)
    return Assembly.from_meshes([box, slope], boundary=[1], friction=friction, contact_settings=settings)


@pytest.mark.parametrize("criterion", CRITERIA)
@pytest.mark.parametrize(("bed", "body"), [(20.0, 24.0), (24.0, 20.0), (20.0, 20.0), (20.0, 20.04), (3.0, -2.0)])
def test_a_box_slides_where_either_of_two_faces_is_too_steep(
    scenes: Any, criterion: str, bed: float, body: float
) -> None:
    steepest = np.tan(np.radians(max(abs(bed), abs(body))))
    structure = wedge(scenes, bed, body, 0.0)
    assert len(structure.contacts) == 1
    assert structure.contacts.point_lean == pytest.approx(np.radians(abs(bed - body)) / 2, abs=1e-9)
    assert verdict_of(structure.replace(friction=steepest - 1e-3), criterion) == Verdict.UNSTABLE
    assert verdict_of(structure.replace(friction=steepest + 1e-3), criterion) == Verdict.STABLE


@pytest.mark.filterwarnings("ignore::falsework.assembly.touching.ContactWarning")
@pytest.mark.parametrize("surface", ["circle", "sphere", "cone", "quadric"])
def test_no_pair_is_stable_that_has_no_equilibrium_on_one_of_its_surfaces(pairs: Any, surface: str) -> None:
    """Neither within tolerances nor with a fitted joint, and with a little more than enough friction it stands."""
    curved = import_module("curved_pairs")
    pair = pairs.random_inclined_pair(np.random.default_rng(9), surface)
    needed = curved.critical_friction(pair, EQUILIBRIUM.tolerance, steps=7)
    assert 0.0 < needed < np.inf
    below = [
        friction for friction in (0.0, min(needed, 1.5) - 0.012) if pair.residual(friction) > EQUILIBRIUM.tolerance
    ]
    assert below
    for fitted in (False, True):
        body = pair.assembly(0.0, fitted=fitted)
        assert body.contacts.point_lean.max() <= np.radians(pair.angle.max() / 2) + 1e-6
        for friction in below:
            for criterion in CRITERIA:
                assert verdict_of(body.replace(friction=friction), criterion) != Verdict.STABLE
        assert verdict_of(body.replace(friction=needed + 0.15), "equilibrium") == Verdict.STABLE


@pytest.mark.parametrize("criterion", CRITERIA)
def test_facets_shifted_by_half_of_one_carry_what_both_bear(pairs: Any, criterion: str) -> None:
    """A body in a trough about the y axis, its facets half a facet beside those of the bed."""

    def trough(angles: Any) -> Any:
        angle = np.radians(angles)
        edge = np.stack([np.sin(angle), 0 * angle, -np.cos(angle)], axis=1)
        points = np.stack([edge, edge + [0, 0.5, 0]], axis=1).reshape(-1, 3)
        first = 2 * np.arange(len(angles) - 1)[:, None]
        return points, (first + np.array([[0, 2, 3, 0, 3, 1]])).reshape(-1, 3)

    regular = np.linspace(-20.0, 44.0, 17)
    shifted = np.concatenate([regular[:1], (regular[1:] + regular[:-1]) / 2, regular[-1:]])
    lean = np.radians(12.0)
    rise = 0.3 * np.array([-np.sin(lean), 0.0, np.cos(lean)])
    pair = pairs.inclined_pair_on("circle", trough(shifted), trough(regular), rise)
    assert pair.angle.max() == pytest.approx(2.0, abs=1e-6)
    body = pair.assembly(0.0)
    assert np.degrees(body.contacts.point_lean).max() == pytest.approx(1.0, abs=1e-3)
    needed = import_module("curved_pairs").critical_friction(pair, EQUILIBRIUM.tolerance)
    assert 0.05 < needed < 1.0
    assert verdict_of(body.replace(friction=needed - 1e-3), criterion) == Verdict.UNSTABLE
    assert verdict_of(body.replace(friction=needed + 0.06), criterion) == Verdict.STABLE


@pytest.mark.parametrize("criterion", CRITERIA)
def test_without_enough_friction_for_both_faces_a_contact_carries_nothing(scenes: Any, criterion: Any) -> None:
    """The cones about the two normals have nothing in common; a force along the mean would be outside of both."""
    structure = wedge(scenes, 2.0, -2.0, 0.0)
    assert strength_of(structure).idle.all()
    smooth = replace(structure, contacts=replace(structure.contacts, lean=None))
    assert verdict_of(smooth, criterion) == Verdict.STABLE
    assert verdict_of(structure, criterion) == Verdict.UNSTABLE
    settings = StabilitySettings(criterion=criterion, cone="quadratic")
    assert StabilityOracle(structure, settings).verdicts(STATE).unstable[0]
    proven = checked(smooth, criterion)
    assert not verify_certificates(structure, STATE, proven, settings.claim)[0]
    assert proven.forces is not None
    assert residual_of_forces(structure, STATE, proven.forces, settings.claim)[0] == pytest.approx(1.0, abs=1e-6)
    falls = np.zeros((1, 2, 6))
    falls[0, 0, 2] = -1.0
    assert residual_bound_of_velocity(structure, STATE, falls, settings.claim)[0] == pytest.approx(1.0)
    rounded = wedge(scenes, 0.004, -0.004, 0.0)  # degrees: as little as a file's rounding
    assert not strength_of(rounded).idle.any()
    assert verdict_of(rounded, criterion) == Verdict.STABLE


@pytest.mark.parametrize("criterion", CRITERIA)
def test_margins_do_not_count_on_contacts_that_carry_nothing(scenes: Any, criterion: Any) -> None:
    structure, settings = wedge(scenes, 2.0, -2.0, 0.5), StabilitySettings(criterion=criterion, cone="quadratic")
    (margins,) = StabilityOracle(structure, settings).margins(STATE, ["friction"])
    assert margins.friction is not None
    assert margins.friction.value == pytest.approx(np.tan(np.radians(2.0)), rel=0.02)


def test_plans_do_not_count_on_contacts_that_carry_nothing() -> None:
    """Between two bricks side by side nothing is needed; below a voussoir of an arch it is."""
    for name, contact, found in (("wall:bricks=2,courses=3", -1, True), ("arch:blocks=5", 0, False)):
        whole = library.build(name)
        contacts, lean = whole.contacts, np.zeros(len(whole.contacts.points))
        lean[contacts.points_of(np.arange(len(contacts))[[contact]])] = 0.7
        structure = replace(whole, contacts=replace(contacts, lean=lean))
        planning = find_plans(structure, robots=2)
        assert planning.found == found
        assert all(validate_plan(plan, structure).good for plan in planning.plans)


@pytest.mark.parametrize("tension", [0.0, 0.2])
@pytest.mark.parametrize("cohesion", [0.0, 0.4])
def test_the_reduced_cone_lies_in_those_of_both_surfaces(scenes: Any, tension: float, cohesion: float) -> None:
    """Forces on its surface are admissible about every normal that leans by as much, also in joints that pull."""
    rng = np.random.default_rng(2)
    body = scenes.make([scenes.box((0, 0, 0), (1, 1, 1)), scenes.box((0, 0, -1), (1, 1, 0), "bed")], [1], friction=0.5)
    if tension or cohesion:
        given = cohesion if cohesion else np.nan
        body = body.replace(joints=Joints.from_arrays(body.contacts, tension=4 * tension, cohesion=4 * given))
    whole = strength_of(body).take(np.zeros(500, np.int64))
    for lean in (1e-4, 0.02, 0.2, 0.46, 0.47):
        leaning = replace(body, contacts=replace(body.contacts, lean=np.full(4, lean)))
        reduced = strength_of(leaning).take(np.zeros(500, np.int64))
        assert reduced.idle.all() == (lean > np.arctan(0.5))
        trial = rng.normal(size=(500, 3)) * [1, 3, 3] + [rng.choice([-1.0, 1.0]), 0, 0]
        forces = into_cone(trial[None], reduced, "quadratic")[0][0]
        azimuth = rng.uniform(0, 2 * np.pi, 500)
        side = np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1)
        along = (forces[:, 1:] * side).sum(axis=1)
        tilted = forces.copy()
        tilted[:, 0] = np.cos(lean) * forces[:, 0] + np.sin(lean) * along
        turned = np.cos(lean) * along - np.sin(lean) * forces[:, 0]
        tilted[:, 1:] += (turned - along)[:, None] * side
        assert np.linalg.norm(tilted, axis=1) == pytest.approx(np.linalg.norm(forces, axis=1))
        assert into_cone(tilted[None], whole, "quadratic")[1].max() <= 1e-9
        if not reduced.idle.any() and tension:
            assert reduced.pull.min() > 0.3 * whole.pull.min()


def test_parallel_faces_lose_nothing(scenes: Any, shared_assembly: Any) -> None:
    """Friction is bit by bit that of the structure, and no array is kept."""
    for structure in (wedge(scenes, 10.0, 10.0, 0.55), load_structure(str(shared_assembly("vault-62")))):
        assert structure.contacts.lean is None
        assert (strength_of(structure).friction == structure.friction).all()


def test_leans_follow_their_points(scenes: Any) -> None:
    structure = wedge(scenes, 20.0, 24.0, 0.5)
    contacts = structure.contacts
    flat = wedge(scenes, 0.0, 0.0, 0.5).contacts
    both = flat.join(contacts)
    assert (both.point_lean == np.concatenate([np.zeros(4), contacts.point_lean])).all()
    assert (both.take(np.array([1])).point_lean == contacts.point_lean).all()
    assert both.take(np.array([0])).point_lean.max() == 0.0
    assert (both.flat().point_lean == both.point_lean).all()
    one = Assembly.from_meshes(structure.meshes, boundary=[1], contacts=contacts)
    other = Assembly.from_meshes(structure.meshes, boundary=[1], contacts=replace(contacts, lean=None))
    assert one.identity != other.identity
    assert geometry_of(one.contacts, one.mass).part_a.tolist() == [0] * 4


def test_a_strip_leans_by_what_its_faces_do(scenes: Any) -> None:
    """A ridge so narrow that it is a line keeps the angle of its top, which is a face, to the other part."""
    width = 1e-5
    x = np.array([-1.0, -width, width, 1.0])
    profile = np.column_stack([x, [0.5, 0.0, 2 * width * np.tan(0.05), 0.5]])
    outline = np.vstack([profile, [[1.0, 1.0], [-1.0, 1.0]]])
    vertices = np.array([[a, y, b] for y in (-1.0, 1.0) for a, b in outline])
    count = len(outline)
    sides = [(k, (k + 1) % count, (k + 1) % count + count, k + count) for k in range(count)]
    faces = [(a, c, b) for a, b, c, _ in sides] + [(a, d, c) for a, _, c, d in sides]
    fan = [(0, k, k + 1) for k in range(1, count - 1)]
    faces += fan + [(a + count, c + count, b + count) for a, b, c in fan]
    ridge = TriangleMesh.from_arrays("ridge", vertices, np.array(faces))
    bed = scenes.box((-2, -2, -1), (2, 2, 0), "bed")
    contacts = Assembly.from_meshes([ridge, bed], boundary=[1]).contacts
    assert contacts.dimension.tolist() == [1]
    assert contacts.point_lean == pytest.approx(0.025, abs=1e-3)
