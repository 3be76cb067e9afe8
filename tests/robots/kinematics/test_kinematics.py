"""Kinematics: against URDF readers, finite differences and forward kinematics itself."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from falsework.errors import InputError
from falsework.geometry.arrays import apply
from falsework.robots import CellRobot, Gripper, load_urdf
from falsework.robots.kernels.kernel_arrays import make_bodies
from falsework.robots.kinematics.forward import flange_pose, link_poses
from falsework.robots.kinematics.inverse import inverse, inverse_flange, solver_of
from falsework.robots.model.builtin_robots import BUILTIN, builtin_robot
from falsework.robots.model.shapes import pose

pytestmark = pytest.mark.filterwarnings("ignore::falsework.robots.cells.urdf_review.CellWarning")

REAL = {"irb2600-12/1.65": "abb_irb2600_12_165", "crb15000-5/0.95": "abb_crb15000_5_95", "ur10e": "ur10e"}


def samples(model, count: int, seed: int = 0) -> np.ndarray:
    low, high = np.maximum(model.lower, -np.pi), np.minimum(model.upper, np.pi)
    return np.random.default_rng(seed).uniform(low, high, (count, model.joints))


@pytest.mark.parametrize("name", BUILTIN)
def test_built_in_arms_are_where_the_real_ones_are(name: str, robot_file: Callable[[str], Path]) -> None:
    """Flanges differ by less than a millimetre, limits by less than a hundredth of a radian."""
    yourdfpy = pytest.importorskip("yourdfpy")
    path = robot_file(REAL[name])
    reader = yourdfpy.URDF.load(str(path), load_meshes=False, build_scene_graph=True)
    model = builtin_robot(name)
    real = load_urdf(path)
    np.testing.assert_allclose(model.lower, real.lower, atol=0.01)
    np.testing.assert_allclose(model.upper, real.upper, atol=0.01)
    np.testing.assert_allclose(model.velocity, real.velocity, rtol=0.01)
    for values in samples(model, 30):
        reader.update_cfg(values)
        there = reader.get_transform("tool0", "base_link")
        here = flange_pose(model, values)
        assert np.linalg.norm(there[:3, 3] - here[:3, 3]) < 1e-3
        np.testing.assert_allclose(there[:3, :3], here[:3, :3], atol=1e-3)


@pytest.mark.parametrize("name", BUILTIN)
def test_built_in_links_cover_the_real_hulls(name: str, robot_file: Callable[[str], Path]) -> None:
    """No point of a real link's hull is more than 2 mm outside ours, and no corner of ours 11 cm outside it."""
    pytest.importorskip("yourdfpy")
    model, real = builtin_robot(name), load_urdf(robot_file(REAL[name]))
    for ours, theirs in zip(model.pieces, real.pieces, strict=True):
        inner = np.concatenate(theirs)
        outer = ConvexHull(np.concatenate(ours))
        out = (inner @ outer.equations[:, :3].T + outer.equations[:, 3]).max()
        assert out < 0.002 + 0.004  # the hull of the file is itself drawn up to 4 mm too large
        excess = (np.concatenate(ours) @ ConvexHull(inner).equations[:, :3].T + ConvexHull(inner).equations[:, 3]).max()
        assert excess < 0.11


@pytest.mark.parametrize(
    "name", ["abb_irb2600_12_165", "abb_crb15000_5_95", "ur10e", "ur5e", "kuka_lbr_iiwa_14_r820", "franka_fer"]
)
def test_urdf_files_are_read_as_yourdfpy_reads_them(name: str, robot_file: Callable[[str], Path]) -> None:
    """All links of six real arms, six and seven joints, whatever way their axes point."""
    yourdfpy = pytest.importorskip("yourdfpy")
    model = load_urdf(robot_file(name))
    reader = yourdfpy.URDF.load(str(robot_file(name)), load_meshes=False, build_scene_graph=True)
    for values in samples(model, 5):
        reader.update_cfg(dict(zip(model.joint_names, values, strict=True)))
        for link, here in zip(model.link_names, link_poses(model, values), strict=True):
            np.testing.assert_allclose(reader.get_transform(link, model.link_names[0]), here, atol=1e-9)


def test_no_point_moves_farther_than_the_sweep_says(cup: Gripper) -> None:
    """What the proof of free edges rests on: joint motion times sweep bounds the motion of every vertex."""
    for name in BUILTIN:
        model = builtin_robot(name)
        robot = CellRobot("arm", model, np.eye(4), cup, model.home, np.zeros((0, 4, 4)))
        bodies, _, kinds = make_bodies(robot)
        values = samples(model, 40)
        step = np.random.default_rng(3).normal(size=values.shape) * 0.3
        before, after = link_poses(model, values), link_poses(model, values + step)
        sources = [(k, p) for k in range(model.joints + 1) for p in model.pieces[k]]
        sources += [(model.joints + 1, p) for p in cup.pieces]
        assert tuple(k for k, _ in sources) == kinds
        for body, (link, piece) in enumerate(sources):
            frame = min(link, model.joints)
            points = apply(model.flange, piece) if link > model.joints else piece
            bound = np.abs(step) @ bodies.sweep[body]
            for row in range(len(values)):
                far = np.linalg.norm(apply(after[row, frame], points) - apply(before[row, frame], points), axis=1).max()
                assert far <= bound[row] + 1e-9


@pytest.mark.parametrize(
    ("name", "kind"), [("irb2600-12/1.65", "spherical"), ("crb15000-5/0.95", "wrist"), ("ur10e", "parallel")]
)
def test_inverse_finds_the_configuration_that_made_the_pose(name: str, kind: str) -> None:
    """Among all branches, each of which brings the flange to the pose to a micrometre, within the limits."""
    model = builtin_robot(name)
    assert solver_of(model).kind == kind
    values = samples(model, 150)
    poses = flange_pose(model, values)
    for row, target, solutions in zip(values, poses, inverse_flange(model, poses), strict=True):
        assert np.abs(solutions - row).max(axis=1).min() < 1e-5
        assert np.abs(flange_pose(model, solutions) - target).max() < 1e-6
        assert model.within_limits(solutions).all()


def test_full_turns_are_branches_too() -> None:
    """Joints 4 and 6 of the IRB 2600 turn past a full turn; a solution stays one when they do."""
    model = builtin_robot("irb2600-12/1.65")
    solutions = inverse_flange(model, flange_pose(model, np.array([0.2, 0.1, -0.2, 0.4, 0.7, 0.3])))[0]
    turned = {tuple(np.round((row + np.pi) % (2 * np.pi) - np.pi, 4)) for row in solutions}
    assert len(solutions) > len(turned)
    assert len({tuple(np.round(row, 6)) for row in solutions}) == len(solutions)


def test_inverse_agrees_with_an_independent_library() -> None:
    """As many branches within the limits as py-opw-kinematics, for every pose."""
    opw = pytest.importorskip("py_opw_kinematics")
    from scipy.spatial.transform import RigidTransform

    model = builtin_robot("irb2600-12/1.65")
    geometry = opw.KinematicModel(
        a1=0.15, a2=-0.115, b=0, c1=0.445, c2=0.7, c3=0.795, c4=0.085, offsets=(0, 0, -np.pi / 2, 0, 0, 0)
    )
    poses = flange_pose(model, samples(model, 200, seed=4))
    limits = np.stack([model.lower, model.upper], axis=1)
    theirs = opw.Robot(geometry, degrees=False).reach(RigidTransform.from_matrix(poses), joint_limits=limits)
    for solutions, margin in zip(inverse_flange(model, poses), theirs.limit_margin, strict=True):
        ours = {tuple(np.round(np.concatenate([np.cos(row), np.sin(row)]), 4) + 0.0) for row in solutions}
        assert len(ours) == int((margin >= 0).sum())


@pytest.mark.parametrize("name", ["kuka_lbr_iiwa_14_r820", "franka_fer"])
def test_seven_joints_give_samples_of_their_curves(name: str, robot_file: Callable[[str], Path]) -> None:
    """Different configurations, all at the pose and within the limits."""
    pytest.importorskip("yourdfpy")
    model = load_urdf(robot_file(name))
    assert solver_of(model).kind == "general"
    poses = flange_pose(model, samples(model, 10))
    found = inverse_flange(model, poses)
    assert sum(len(solutions) > 0 for solutions in found) >= 9
    for target, solutions in zip(poses, found, strict=True):
        if len(solutions):
            assert np.abs(flange_pose(model, solutions) - target).max() < 1e-6
            assert model.within_limits(solutions).all()


def test_a_robot_of_a_cell_counts_base_and_tool(cup: Gripper) -> None:
    """A tool pose in the world is reached in the world."""
    from falsework.robots.kinematics.forward import tool_pose

    model = builtin_robot("irb2600-12/1.65")
    robot = CellRobot("arm", model, pose((1, 2, 0.5), 0.7), cup, model.home, np.zeros((0, 4, 4)))
    target = tool_pose(robot, model.home)
    assert np.abs(inverse(robot, target)[0] - model.home).max(axis=1).min() < 1e-6
    assert len(inverse(robot, pose((9, 9, 9)))[0]) == 0


def test_wrong_input_is_named() -> None:
    """Unknown arm; a configuration outside its limits; poses that are no numbers."""
    with pytest.raises(InputError, match=r"no built-in robot 'kr6'; there are crb15000"):
        builtin_robot("kr6")
    model = builtin_robot("ur10e")
    with pytest.raises(InputError, match=r"elbow_joint is 4, outside its limits -3.142 to 3.142"):
        model.check_configuration([0, 0, 4, 0, 0, 0])
    with pytest.raises(InputError, match="needs 6 joint values"):
        model.check_configuration([0, 0])
    with pytest.raises(InputError, match="not finite"):
        inverse_flange(model, np.full((4, 4), np.nan))
