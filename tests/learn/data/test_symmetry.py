"""Symmetries of structures: as many as theory says, and physics that does not tell images apart."""

from __future__ import annotations

import numpy as np
import pytest

from falsework import Assembly, StabilityOracle, load_structure
from falsework.assembly import ContactWarning
from falsework.geometry import TriangleMesh
from falsework.learn.data.symmetry import rigid_motions, same_contacts, symmetries
from falsework.stability.settings import EQUILIBRIUM


def moved(assembly: Assembly, turn: float, shift: tuple[float, float, float], scale: float = 1.0) -> Assembly:
    """The same structure elsewhere, turned about the vertical."""
    cos, sin = np.cos(turn), np.sin(turn)
    matrix = scale * np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    meshes = [
        TriangleMesh.from_arrays(mesh.name, mesh.vertices @ matrix.T + shift, mesh.faces) for mesh in assembly.meshes
    ]
    return Assembly.from_meshes(meshes, boundary=assembly.boundary, density=assembly.density)


def _places(assembly: Assembly) -> tuple[np.ndarray, np.ndarray, float]:
    """Centres about the axis and masses of the movable parts, and the size of one."""
    loose = ~assembly.boundary
    place = assembly.mass.center[loose] - [*assembly.mass.center[loose, :2].mean(axis=0), 0.0]
    return place, assembly.mass.mass[loose], 0.1


def _image_under(assembly: Assembly, turn: np.ndarray) -> np.ndarray:
    """Which part comes to lie on which; the boundary stays."""
    place, loose = _places(assembly)[0], np.flatnonzero(~assembly.boundary)
    image = np.arange(assembly.part_count)
    image[loose] = loose[np.linalg.norm((place @ turn.T)[:, None] - place, axis=2).argmin(axis=1)]
    return image


@pytest.mark.parametrize(
    ("structure", "count"),
    [
        ("dome:rings=3,blocks=8,stagger=0", 16),  # eight turns, and a reflection after each
        ("dome:rings=3,blocks=8,stagger=1", 16),
        ("dome:rings=2,blocks=5,stagger=0", 10),
        ("arch:blocks=7", 2),
        ("stack:blocks=5", 1),  # in the one plane that reflects it into itself, no part changes places
        ("bottle", 1),
    ],
)
def test_there_are_as_many_as_the_shape_has(structure: str, count: int) -> None:
    assembly = load_structure(structure)
    images = symmetries(assembly)
    assert images.shape == (count, assembly.part_count)
    assert images[0].tolist() == list(range(assembly.part_count))
    assert (np.sort(images, axis=1) == np.arange(assembly.part_count)).all()


def test_they_make_a_group() -> None:
    images = symmetries(load_structure("dome:rings=3,blocks=8,stagger=0"))
    known = {tuple(image) for image in images.tolist()}
    assert len(known) == len(images)
    for one in images:
        assert tuple(np.argsort(one).tolist()) in known
        for other in images:
            assert tuple(one[other].tolist()) in known


def test_place_direction_and_size_do_not_matter() -> None:
    assembly = load_structure("arch:blocks=7")
    images = symmetries(assembly)
    assert len(images) > 1
    for copy in (moved(assembly, 0.7, (3.0, -1.0, 0.5)), moved(assembly, 0.0, (0.0, 0.0, 0.0), 40.0)):
        assert {tuple(image) for image in symmetries(copy).tolist()} == {tuple(image) for image in images.tolist()}


def test_mass_matters() -> None:
    """A part of heavier stone has no image but itself."""
    assembly = load_structure("arch:blocks=7")
    density = np.full(assembly.part_count, 2400.0)
    loose = int(np.flatnonzero(~assembly.boundary)[0])
    density[loose] *= 1.5
    heavier = symmetries(assembly.replace(density=density))
    assert len(heavier) < len(symmetries(assembly))
    assert (heavier[:, loose] == loose).all()


def test_contacts_matter() -> None:
    """A dome in which two blocks do not touch, where all their images do, is reflected into itself alone."""
    dome = load_structure("dome:rings=2,blocks=5,stagger=0")
    lost = int(np.flatnonzero((~dome.boundary)[dome.contacts.parts].all(axis=1))[0])
    push = dome.contacts.pushes(dome.part_count)
    one, other = dome.contacts.parts[lost]
    push[one, other] = push[other, one] = 0.0
    kept = 0
    for turn in rigid_motions(*_places(dome)):
        image = _image_under(dome, turn)
        assert same_contacts(dome.contacts.pushes(dome.part_count), turn, image)
        kept += same_contacts(push, turn, image)
    assert kept == 2


def test_lines_matter() -> None:
    """Two boxes on a slab are mirror images until the edge of a fixed wedge, or a pair of them, touches."""
    faces = np.array([(0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1)])
    faces = np.concatenate([faces, [(2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)]])

    def box(name: str, low: tuple[float, ...], high: tuple[float, ...]) -> TriangleMesh:
        corners = [(x, y, z) for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])]
        return TriangleMesh.from_arrays(name, corners, faces)

    def wedge(name: str, side: float) -> TriangleMesh:
        points = [(x, y, z) for y in (-0.5, 0.5) for x, z in ((2, 0.5), (3, 0.2), (3, 0.8))]
        turned = np.array(points) * (side, side, 1)
        prism = [(0, 1, 2), (3, 5, 4), (0, 3, 4), (0, 4, 1), (1, 4, 5), (1, 5, 2), (2, 5, 3), (2, 3, 0)]
        return TriangleMesh.from_arrays(name, turned, prism)

    slab = box("slab", (-5, -2, -1), (5, 2, 0))
    pair = [slab, box("left", (-2, -1, 0), (-1, 1, 1)), box("right", (1, -1, 0), (2, 1, 1))]
    assert symmetries(Assembly.from_meshes(pair, boundary=[0]))[:, 1].max() == 2
    for wedges in (1, 2):
        parts = [*pair, wedge("east", 1.0), *([wedge("west", -1.0)] if wedges == 2 else [])]
        with pytest.warns(ContactWarning):
            assembly = Assembly.from_meshes(parts, boundary=[0, *range(3, len(parts))])
        assert (assembly.contacts.dimension == 1).sum() == wedges
        assert (symmetries(assembly)[:, 1].max() == 2) == (wedges == 2)


def test_images_of_states_stand_if_the_states_do() -> None:
    """Verdicts on random states of a dome and on their images under every symmetry."""
    assembly = load_structure("dome:rings=3,blocks=8,stagger=0")
    oracle, rng = StabilityOracle(assembly, EQUILIBRIUM), np.random.default_rng(0)
    states = rng.choice([0, 1, 2], p=[0.3, 0.6, 0.1], size=(60, assembly.part_count)).astype(np.uint8)
    states[:, assembly.boundary] = 2
    verdicts = oracle.verdicts(states).verdict
    assert 0.05 < (verdicts == 1).mean() < 0.95
    for image in symmetries(assembly):
        there = np.empty_like(states)
        there[:, image] = states
        assert np.array_equal(oracle.verdicts(there).verdict, verdicts)


def test_one_part_and_parts_on_the_axis_have_no_others_to_be() -> None:
    single = load_structure("stack:blocks=1")
    assert len(symmetries(single)) == 1
