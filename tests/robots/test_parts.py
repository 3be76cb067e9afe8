"""Parts in a cell: convex pieces, grasps, exit directions, and reachability."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from falsework import load_structure
from falsework.cli.main import main
from falsework.errors import DependencyError, StateError
from falsework.geometry import TriangleMesh
from falsework.geometry.arrays import apply
from falsework.geometry.mesh.collision import inside
from falsework.robots import CellRobot, Gripper, Placement
from falsework.robots.grasping.grasp import grasp_fault, grasps
from falsework.robots.model.builtin_robots import builtin_robot
from falsework.robots.model.part_shapes import convex_pieces, place_parts
from falsework.robots.model.shapes import block, outer_hull, pose


def ring(sides: int = 12) -> TriangleMesh:
    """A flat ring: as far from convex as parts get."""
    import trimesh

    made = trimesh.creation.annulus(0.5, 1.0, 0.3, sections=sides)
    return TriangleMesh.from_arrays("ring", made.vertices, made.faces)


def covered(points: np.ndarray, pieces: tuple[np.ndarray, ...]) -> np.ndarray:
    """Which points are in some piece, shape (points,)."""
    found = np.zeros(len(points), bool)
    for piece in pieces:
        planes = ConvexHull(piece).equations
        found |= (points @ planes[:, :3].T + planes[:, 3] <= 1e-7).all(axis=1)
    return found


def volume(pieces: tuple[np.ndarray, ...]) -> float:
    return sum(float(ConvexHull(piece).volume) for piece in pieces)


def test_a_convex_part_is_its_own_piece() -> None:
    """Nothing is added and nothing cut."""
    assembly = load_structure("arch")
    for mesh in assembly.meshes:
        pieces = convex_pieces(mesh)
        assert len(pieces) == 1
        assert volume(pieces) == pytest.approx(mesh.volume, rel=1e-6)


def test_boxes_put_together_come_apart_exactly() -> None:
    """Polycubes are cut into as many boxes as volume tells."""
    assembly = load_structure("polycube")
    for mesh in assembly.meshes:
        pieces = convex_pieces(mesh, 1e-6)
        assert volume(pieces) == pytest.approx(mesh.volume, rel=1e-5)


def test_pieces_cover_the_solid() -> None:
    """Every point inside a ring is in a piece, and the pieces together are little larger than it."""
    mesh = ring()
    pieces = convex_pieces(mesh)
    assert volume(pieces) < 1.06 * mesh.volume
    random = np.random.default_rng(0)
    points = random.uniform(mesh.bounds[0], mesh.bounds[1], (6_000, 3))
    solid = inside(points, mesh.triangles)
    assert solid.sum() > 1500
    assert covered(points[solid], pieces).all()
    assert covered(mesh.vertices, pieces).all()
    few = convex_pieces(mesh, pieces=3)
    assert len(few) <= 4
    assert covered(points[solid], few).all()


def test_a_surface_that_is_no_manifold_is_one_piece() -> None:
    """Nothing of it is lost, whatever is inside."""
    mesh = ring()
    torn = TriangleMesh.from_arrays("torn", mesh.vertices, mesh.faces[1:])
    (piece,) = convex_pieces(torn)
    assert covered(mesh.vertices, (piece,)).all()


def test_cutting_needs_a_library(monkeypatch: pytest.MonkeyPatch) -> None:
    """Convex parts do not."""
    monkeypatch.setitem(sys.modules, "manifold3d", None)
    assert len(convex_pieces(load_structure("arch").meshes[1])) == 1
    with pytest.raises(
        DependencyError, match=r"parts that are not convex need manifold3d: pip install 'falsework\[robots\]'"
    ):
        convex_pieces(ring())


def test_a_simpler_hull_lies_outside() -> None:
    """All points stay inside, corners stick out by no more than asked for unless planes run out."""
    random = np.random.default_rng(1)
    points = random.normal(size=(150, 3))
    points /= np.linalg.norm(points, axis=1)[:, None]
    outer = outer_hull(0.2 * points, tolerance=0.008, planes=200)
    assert covered(0.2 * points, (outer,)).all()
    planes = ConvexHull(0.2 * points).equations
    assert (outer @ planes[:, :3].T + planes[:, 3]).max() < 0.0081
    assert len(outer_hull(0.2 * points, planes=24)) < 60


def test_parts_are_placed_to_scale() -> None:
    """Masses go with the cube of the scale and with the density of what is built in the cell."""
    assembly = load_structure("arch")
    there = place_parts(assembly, Placement(position=(1, 2, 3), yaw=0.5, scale=0.5, density=600.0))
    np.testing.assert_allclose(there.mass, assembly.mass.mass * 0.125 * 600 / assembly.density)
    world = pose((1, 2, 3), 0.5)
    np.testing.assert_allclose(there.meshes[2].vertices, apply(world, 0.5 * assembly.meshes[2].vertices), atol=1e-12)
    np.testing.assert_allclose(there.center, apply(world, 0.5 * assembly.mass.center), atol=1e-12)


def test_pieces_of_parts_are_those_of_the_tolerance_and_the_place_that_are_asked_for() -> None:
    """Also where the same parts were placed otherwise before."""
    assembly = load_structure("polycube")
    for tolerance, scale in ((0.05, 1.0), (1e3, 1.0), (0.05, 0.5), (0.05, 1.0)):
        for mesh, pieces in zip(
            assembly.meshes, place_parts(assembly, Placement(scale=scale), tolerance=tolerance).pieces, strict=True
        ):
            assert len(pieces) == len(convex_pieces(mesh, tolerance))
            assert volume(pieces) == pytest.approx(scale**3 * volume(convex_pieces(mesh, tolerance)))
    assert any(len(convex_pieces(mesh)) > 1 for mesh in assembly.meshes)


@pytest.fixture(scope="module")
def arch():
    assembly = load_structure("arch")
    return assembly, place_parts(assembly)


def arm(gripper: Gripper) -> CellRobot:
    model = builtin_robot("irb2600-12/1.65")
    return CellRobot("arm", model, np.eye(4), gripper, model.home, np.zeros((0, 4, 4)))


def strong(gripper: Gripper) -> CellRobot:
    robot = arm(gripper)
    return replace(robot, gripper=replace(gripper, payload=1e6), model=replace(robot.model, payload=None))


def test_suction_grasps_touch_a_face_that_has_room(arch, cup: Gripper) -> None:
    """The tool is on the surface, looks into it, and the cup's rim is on the same face; always in the same order."""
    assembly, parts = arch
    robot = strong(cup)
    part = int(np.argmax(parts.center[:, 2]))
    found = grasps(assembly, parts, part, np.ones(parts.part_count), robot)
    assert found
    corners = parts.meshes[part].triangles
    for grasp in found:
        assert grasp.tool[:3, 2] @ grasp.approach == pytest.approx(1.0)
        point = grasp.tool[:3, 3]
        angle = np.linspace(0, 2 * np.pi, 16)[:, None]
        rim = point + cup.cup * (np.cos(angle) * grasp.tool[:3, 0] + np.sin(angle) * grasp.tool[:3, 1])
        into = rim + 0.002 * grasp.approach
        assert inside(into, corners).all()
        assert not inside(point[None], corners)[0]
        assert abs(grasp.approach[0]) < 0.5  # the neighbours cover the faces along the arch
    again = grasps(assembly, parts, part, np.ones(parts.part_count), robot)
    assert [grasp.tool.tolist() for grasp in again] == [grasp.tool.tolist() for grasp in found]


def test_a_large_face_is_gripped_in_several_places(arch, cup: Gripper) -> None:
    """First as near to the centre of mass as can be; other places for the cup are more than its radius apart."""
    assembly, parts = arch
    small = replace(cup, cup=0.005)
    part = int(np.argmax(parts.center[:, 2]))
    found = grasps(assembly, parts, part, np.ones(parts.part_count), strong(small))
    best = [grasp for grasp in found if np.allclose(grasp.approach, found[0].approach)]
    points = np.unique(np.round([grasp.tool[:3, 3] for grasp in best], 9), axis=0)
    assert len(points) == 5
    apart = np.linalg.norm(points[:, None] - points[None], axis=2)
    assert apart[~np.eye(5, dtype=bool)].min() > small.cup
    flat = points - np.outer((points - parts.center[part]) @ found[0].approach, found[0].approach)
    far = np.linalg.norm(flat - parts.center[part], axis=1)
    assert np.linalg.norm(found[0].tool[:3, 3] - points[np.argmin(far)]) < 1e-6


def test_the_gripper_keeps_off_neighbours(arch, cup: Gripper) -> None:
    """A face that a neighbour covers has no grasp until the neighbour has gone."""
    assembly, parts = arch
    part = int(np.argmax(parts.center[:, 2]))
    alone = np.zeros(parts.part_count, bool)
    alone[part] = True
    every = {tuple(np.round(g.approach, 3)) for g in grasps(assembly, parts, part, alone, strong(cup))}
    amid = {
        tuple(np.round(g.approach, 3)) for g in grasps(assembly, parts, part, np.ones(parts.part_count), strong(cup))
    }
    assert amid < every


def test_payload_and_cup_decide(arch, cup: Gripper) -> None:
    """A part heavier than the payload has no grasp, nor one without a face for the cup."""
    from dataclasses import replace

    assembly, parts = arch
    part = int(np.argmax(parts.center[:, 2]))
    there = np.ones(parts.part_count)
    weak = replace(strong(cup), gripper=replace(cup, payload=float(parts.mass[part]) * 0.99))
    assert grasps(assembly, parts, part, there, weak) == []
    wide = replace(strong(cup), gripper=replace(cup, payload=1e6, cup=2.0))
    assert grasps(assembly, parts, part, there, wide) == []
    with pytest.raises(StateError, match=r"present has shape \(2,\)"):
        grasps(assembly, parts, part, [1, 1], strong(cup))
    with pytest.raises(StateError, match="no part 99"):
        grasps(assembly, parts, 99, there, strong(cup))


def test_a_part_without_a_grasp_is_told_with_its_size_and_that_of_the_gripper(cup: Gripper) -> None:
    """The circle on the largest face of a box, and its narrowest width."""
    from dataclasses import replace

    from falsework import Assembly
    from falsework.assembly.library.blocks import box, gather

    made = gather([box("slab", (0, 0, 0), (0.3, 0.2, 0.05)), box("ground", (0, 0, -1), (1, 1, 0), fixed=True)])
    parts = place_parts(Assembly.from_meshes(made.meshes, boundary=made.boundary, density=100.0), Placement())
    text = grasp_fault(parts, 0, replace(cup, cup=0.12), blocked=False)
    assert text == (
        "no face that the gripper can grasp: its cup has a radius of 120 mm, the largest face takes one of 100 mm"
    )
    jaw = Gripper("jaw", "jaw", cup.pieces, np.eye(4), 10.0, opening=0.04, depth=0.03)
    text = grasp_fault(parts, 0, jaw, blocked=False)
    assert text.endswith("its jaws open to 40 mm and are 30 mm deep, the part is at least 50 mm wide")
    assert "among the other parts, which leave it no room: its cup" in grasp_fault(parts, 0, cup, blocked=True)


def test_jaws_close_on_opposite_faces() -> None:
    """The part is between the jaws, no wider than they open, and the palm stays outside."""
    assembly = load_structure("stack")
    parts = place_parts(assembly, Placement(scale=0.1))
    jaw = Gripper(
        "jaw",
        "jaw",
        (block((-0.08, -0.02, 0), (0.08, 0.02, 0.05)),),
        np.array(pose((0, 0, 0.1))),
        payload=1e6,
        opening=0.15,
        depth=0.03,
    )
    part = int(np.flatnonzero(~parts.boundary)[-1])
    alone = np.zeros(parts.part_count, bool)
    alone[part] = True
    found = grasps(assembly, parts, part, alone, strong(jaw))
    assert found
    for grasp in found:
        level = parts.meshes[part].vertices @ grasp.tool[:3, 0]
        assert level.max() - level.min() == pytest.approx(grasp.width, abs=1e-6)
        assert grasp.width <= 0.15
        assert level.mean() == pytest.approx(grasp.tool[:3, 3] @ grasp.tool[:3, 0], abs=1e-6)
        ahead = (parts.meshes[part].vertices - grasp.tool[:3, 3]) @ grasp.approach
        assert ahead.min() >= -jaw.depth - 1e-9


CELL = """
[structure]
position = [1.0, 0.0, 0.0]
scale = 0.2
[grippers.cup]
kind = "suction"
payload = 10.0
cup = 0.01
tool = { position = [0.0, 0.0, 0.12] }
shapes = [{ cylinder = { radius = 0.02, low = 0.0, high = 0.119 } }]
[[robots]]
name = "arm"
model = "irb2600-12/1.65"
gripper = "cup"
"""


def test_the_doctor_prints_reach_and_proposes_bases(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], read_answer: Callable[[str], dict[str, Any]]
) -> None:
    """All parts near the robot are reached; from far away none, and better bases are found; a picture on demand."""
    near, far, picture = tmp_path / "near.toml", tmp_path / "far.toml", tmp_path / "reach.png"
    near.write_text(CELL)
    far.write_text(CELL.replace("position = [1.0, 0.0, 0.0]", "position = [2.6, 0.0, 0.0]"))
    assert main(["doctor", "arch:blocks=7", "--cell", str(near), "--json", "--picture", str(picture)]) == 0
    answer = read_answer(capsys.readouterr().out)
    assert {row["reach"]["arm"] for row in answer["reach"]} == {"reached"}
    assert answer["files"] == [str(picture)]
    assert picture.stat().st_size > 10_000
    assert main(["doctor", "arch:blocks=7", "--cell", str(far)]) == 1
    said = capsys.readouterr()
    assert "out of reach" in said.out
    assert "better bases" in said.out
    assert "grippers without force and moment bear fifty weights of the heaviest part in planning: cup" in said.out
    assert "no robot reaches" in said.err


def test_arms_on_a_ceiling_are_not_told_to_stand(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """No upright base is proposed for them, also where they reach nothing."""
    far = tmp_path / "far.toml"
    hung = CELL + "base = { position = [0.0, 0.0, 3.0], rpy = [180, 0, 0] }\nhome = [0, -40, 30, 0, 60, 0]\n"
    far.write_text(hung.replace("position = [1.0, 0.0, 0.0]", "position = [2.6, 0.0, 0.0]"))
    assert main(["doctor", "arch:blocks=7", "--cell", str(far)]) == 1
    assert "no better bases found: 0 of 7 pairs" in capsys.readouterr().out


def test_the_doctor_refuses_a_cell_with_other_weights(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cell = tmp_path / "cell.toml"
    cell.write_text(CELL)
    assert main(["doctor", "arch:blocks=7", "--load", "voussoir-3=0,0,-10", "--cell", str(cell)]) == 2
    error = capsys.readouterr().err
    assert "but its loads stay as they are" in error
    assert len(error.strip().splitlines()) == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["arch", "--cell", "nowhere.toml"], "there is no cell file nowhere.toml"),
        (["arch", "--cell", "dome-99"], "unknown cell dome-99"),
        (["arch", "--cell", "dome-37", "--picture", "reach.gif"], "give a file that ends in .png, .svg or .pdf"),
        (["arch", "--cell", "dome-37", "--picture", "no-folder/reach.png"], "there is no folder no-folder"),
        (["cell.toml", "--cell", "dome-37"], "cell.toml is a cell; to test what it reaches"),
    ],
)
def test_the_reach_of_a_cell_refuses_wrong_input(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Exit code 2 and one line."""
    assert main(["doctor", *arguments]) == 2
    assert message in capsys.readouterr().err


def test_a_cell_is_examined_by_itself(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], read_answer: Callable[[str], dict[str, Any]]
) -> None:
    cell = tmp_path / "cell.toml"
    cell.write_text(CELL)
    assert main(["doctor", str(cell), "--json"]) == 0
    assert read_answer(capsys.readouterr().out)["robots"] == ["arm"]
    cell.write_text(CELL + "base = { position = [0.0, 0.0, -0.5] }\n")
    assert main(["doctor", str(cell), "--json"]) == 1
    answer = read_answer(capsys.readouterr().out)
    assert (answer["outcome"], answer["loads"]) == ("does_not_load", False)
    assert "below the floor" in answer["error"]
