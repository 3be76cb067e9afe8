"""Structures made of other ones: each is that which is built anew from changed input, and nothing is lost."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from falsework import Assembly, load_structure
from falsework.assembly import Joints, Loads, prop_places, with_props
from falsework.assembly.fasteners import fasten
from falsework.assembly.groups import Groups, groups_of, join_parts
from falsework.assembly.props import keep_props
from falsework.assembly.store import save_assembly
from falsework.errors import AssemblyError, InputError
from falsework.geometry.contact.interfaces import ContactSettings
from falsework.stability.margins.placement import moved_assembly

SHELF = "shelf:shelves=0"
BOARDS = (("top-3", "top-2"),)


def dome(**given: Any) -> Assembly:
    """A dome with props under its inclined lower sides."""
    built = load_structure("dome", **given)
    return with_props(built, prop_places(built))


def shelf(**given: Any) -> Assembly:
    return load_structure(SHELF, groups=BOARDS, **given)


def grouped(assembly: Assembly) -> Groups:
    groups = groups_of(assembly)
    assert groups is not None
    return groups


def agree(one: Assembly, other: Assembly) -> None:
    assert one.identity == other.identity
    assert one.names == other.names
    assert one.props == other.props
    np.testing.assert_array_equal(one.immovable, other.immovable)
    for name in ("parts", "frames", "points", "start", "areas"):
        np.testing.assert_array_equal(getattr(one.contacts, name), getattr(other.contacts, name))
    np.testing.assert_array_equal(one.mass.mass, other.mass.mass)
    np.testing.assert_array_equal(one.applied_wrench(), other.applied_wrench())


@pytest.mark.parametrize("given", [{"friction": 0.3}, {"density": 900.0}, {"boundary": ["ground-33", "voussoir-0"]}])
def test_a_change_of_a_structure_with_props_is_as_building_it_anew(given: dict[str, Any]) -> None:
    before = dome()
    agree(before.replace(**given), with_props(load_structure("dome", **given), before.props))


def test_another_friction_turns_the_heads_of_props_or_is_another_structure() -> None:
    """What props bear at a coefficient depends on the one for which their heads were turned upright."""
    before, anew = dome(), dome(friction=0.3)
    scaled = before.at_friction(0.3)
    assert not np.allclose(scaled.contacts.frames, anew.contacts.frames)
    assert scaled.identity != anew.identity
    assert before.at_friction(before.friction).identity == before.identity
    assert scaled.replace(friction=0.3).contacts.frames == pytest.approx(anew.contacts.frames)


@pytest.mark.parametrize("given", [{"friction": 0.3}, {"density": 900.0}])
def test_a_change_of_joined_parts_is_one_of_the_loose_parts_too(given: dict[str, Any]) -> None:
    changed, anew = shelf().replace(**given), shelf(**given)
    agree(changed, anew)
    agree(grouped(changed).loose, grouped(anew).loose)


def test_joined_parts_at_another_friction_are_those_of_loose_parts_at_it() -> None:
    changed, anew = shelf().at_friction(0.3), shelf(friction=0.3)
    agree(changed, anew)
    agree(grouped(changed).loose, grouped(anew).loose)


def test_a_ground_keeps_props_and_groups() -> None:
    before = dome()
    agree(before.with_ground(), with_props(load_structure("dome").with_ground(), before.props))
    grounded = shelf().with_ground()
    loose = load_structure(SHELF).with_ground()
    agree(grounded, join_parts(loose, BOARDS))
    agree(grouped(grounded).loose, loose)


def rich() -> Assembly:
    """A structure with everything that one can have, but for contacts that are given."""
    settings = ContactSettings(angle=7.0)
    meshes = load_structure("arch:blocks=7").meshes
    loose = Assembly.from_meshes(
        meshes, boundary=[], ground=True, name="rich", friction=0.7, contact_settings=settings, settle=1e-4
    )
    wrench = np.zeros((loose.part_count, 6))
    wrench[3, 2] = -50.0
    joints = Joints.from_arrays(loose.contacts, friction=0.6, tension=np.where(loose.contacts.dimension == 2, 5.0, 0.0))
    loads = Loads.from_arrays(loose.part_count, wrench=wrench, acceleration=(0.01, 0.0, 0.0))
    return with_props(loose.replace(loads=loads, joints=joints), prop_places(loose)[1:3])


CHANGES: dict[str, Callable[[Assembly], Assembly]] = {
    "replace": lambda given: given.replace(name="rich", density=1000.0),
    "at_friction": lambda given: given.at_friction(0.7),
    "with_ground": lambda given: given.with_ground(),
    "keep_props": lambda given: keep_props(given, range(len(given.props))),
    "fasten": lambda given: fasten(
        given, [{"parts": [0, 1], "at": given.contacts.points[0].tolist(), "tension": 1.0, "shear": 1.0}]
    ),
}


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES.keys())
def test_a_derived_structure_has_all_that_it_is_made_of(change: Callable[[Assembly], Assembly]) -> None:
    before = rich()
    after = change(before)
    for field in fields(Assembly):
        had, has = getattr(before, field.name), getattr(after, field.name)
        if had is None or had is False:
            continue
        assert has is not None, field.name
        if isinstance(had, (str, float, tuple, ContactSettings)) and field.name != "meshes":
            assert has == had, field.name
    assert after.loads is not None
    assert after.joints is not None
    np.testing.assert_array_equal(after.loads.wrench[: len(before.meshes) - 2, :3].sum(axis=0), [0.0, 0.0, -50.0])
    np.testing.assert_array_equal(after.loads.acceleration, [0.01, 0.0, 0.0])
    assert (after.joints.friction == 0.6).sum() == (before.joints is not None and (before.joints.friction == 0.6).sum())
    assert after.immovable.sum() - after.boundary.sum() == 2


def test_parts_placed_with_an_error_stay_on_their_props() -> None:
    before = dome()
    moved = moved_assembly(before, 1e-4, np.random.default_rng(0))
    assert moved is not None
    np.testing.assert_array_equal(moved.immovable, before.immovable)
    assert [prop.part for prop in moved.props] == [prop.part for prop in before.props]
    np.testing.assert_allclose([prop.at for prop in moved.props], [prop.at for prop in before.props], atol=1e-3)
    assert not np.array_equal(moved.meshes[3].vertices, before.meshes[3].vertices)


def test_joined_parts_have_no_loads_joints_or_fasteners() -> None:
    """They would be lost as soon as the parts are joined anew."""
    joined = shelf()
    loads = Loads.from_arrays(joined.part_count, acceleration=(0.1, 0.0, 0.0))
    joints = Joints.from_arrays(joined.contacts, friction=0.4)
    cases: list[tuple[dict[str, Any], str]] = [({"loads": loads}, "loads"), ({"joints": joints}, "joints")]
    for given, name in cases:
        with pytest.raises(AssemblyError, match=f"joined parts, and {name} are of single parts"):
            joined.replace(**given)
    place = joined.contacts.points[0].tolist()
    with pytest.raises(AssemblyError, match="joints are of single parts"):
        fasten(joined, [{"parts": joined.contacts.parts[0].tolist(), "at": place, "tension": 1.0}])
    with pytest.raises(AssemblyError, match="loads are of single parts"):
        replace(joined, loads=loads).with_ground()


def test_a_folder_refuses_what_it_cannot_keep(tmp_path: Path) -> None:
    for assembly, what in ((dome(), "props"), (shelf(), "joined parts")):
        with pytest.raises(InputError, match=f"has {what}"):
            save_assembly(assembly, tmp_path / "folder")
    assert not (tmp_path / "folder").exists()
