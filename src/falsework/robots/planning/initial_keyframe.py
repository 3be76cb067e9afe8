"""Given keyframes: the task of a cell, and the robots as they are at the start, or when an assembly is continued."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from falsework.assembly.model import Assembly
from falsework.assembly.state import HELD, REMOVED, States
from falsework.errors import InputError, StateError
from falsework.robots.grasping.exit_ways import ExitWays
from falsework.robots.keyframes.keyframe_graph import KeyframeGraph
from falsework.robots.keyframes.keyframes import CarriedLoad, Node
from falsework.robots.kinematics.forward import tool_pose
from falsework.robots.model.cell import Cell
from falsework.robots.model.shapes import Array, inverse_pose
from falsework.search.problem.task import STAGE, Task
from falsework.stability.oracle import StabilityOracle
from falsework.utils.quantity import format_quantity


def task_in_cell(assembly: Assembly, cell: Cell, task: Task | None, exits: ExitWays, oracle: StabilityOracle) -> Task:
    """Return a task with the number of robots of the cell, and with ways out of which none begins downwards.

    `exits` then know the ways that the task allows, by verdicts of the oracle where others than the part move.
    InputError for props, StateError for more held parts than robots.
    """
    given = task or Task.from_rules(assembly.boundary, cell.robot_count, identity=assembly.identity)
    if given.props:
        raise InputError("robot plans have no props; plan for the structure without them")
    exits.allow(given, oracle, cell.robot_count)
    freed = np.flatnonzero(STAGE[given.target] < STAGE[given.start])
    if len(freed):
        name = assembly.names[int(freed[0])]
        raise StateError(f"part {name} is held in the start and installed in the target; hold it in the target too")
    return Task.from_rules(
        assembly.boundary,
        cell.robot_count,
        start=given.start,
        target=given.target,
        fixed=given.fixed,
        missing=given.missing,
        clearance=exits.clearance,
        identity=assembly.identity,
        allow_regrasp=given.allow_regrasp,
        together=given.together,
    )


def given_keyframe(
    graph: KeyframeGraph,
    state: States,
    configurations: Sequence[ArrayLike] | None,
    held: Sequence[int | None] | None,
    gripped: Sequence[ArrayLike | None] | None = None,
) -> Node:
    """Return the validated keyframe of given configurations, by default homes; arguments as of `plan_robots`.

    Raises:
        InputError: configurations that do not fit the robots, or in which something collides or a gripper is not at
            the part that it holds.
        StateError: held parts that do not go with the state.
    """
    robots, names = graph.cell.robots, graph.assembly.names
    values = graph.cell.homes if configurations is None else tuple(configurations)
    held = (None,) * len(robots) if held is None else tuple(held)
    gripped = (None,) * len(robots) if gripped is None else tuple(gripped)
    if not len(values) == len(held) == len(gripped) == len(robots):
        raise InputError(f"{graph.cell.name} has {len(robots)} robots; give configuration and held part of each")
    checked = tuple(
        robot.model.check_configuration(entry, f"configuration of {robot.name}")
        for robot, entry in zip(robots, values, strict=True)
    )
    named = sorted(part for part in held if part is not None)
    if len(set(named)) < len(named):
        raise StateError("two robots hold one part, as within a hand-over; finish that first, then plan from there")
    carried = tuple(
        None if part is None or state[part] != REMOVED else _load(graph, robot, part, gripped[robot])
        for robot, part in enumerate(held)
    )
    for robot, load, grip in zip(robots, carried, gripped, strict=True):
        if load is None and grip is not None:
            raise InputError(f"{robot.name} carries no part, so it has no grip to give; leave it out")
    held = tuple(part if load is None else None for part, load in zip(held, carried, strict=True))
    named = sorted(part for part in held if part is not None)
    wanted = np.flatnonzero((state == HELD) & ~graph.assembly.boundary).tolist()
    if named != wanted:
        has, needs = (", ".join(f"part {names[part]}" for part in parts) or "nothing" for parts in (named, wanted))
        raise StateError(
            f"the robots hold {has}, the start state has {needs} held; give the part that each robot holds"
        )
    for robot, part in enumerate(held):
        if part is not None:
            _check_grip(graph, robot, part, checked[robot])
    node = graph.start(state, checked, held)
    for robot, load in enumerate(carried):
        if load is not None:
            node = node.moved(robot, checked[robot], load)
    for robot in range(len(robots)):
        pair = graph.collision(node, robot)
        if pair is not None:
            raise InputError(f"at the start bodies are too near: {pair.words}; move {robots[robot].name} away first")
    return node


def _check_grip(graph: KeyframeGraph, robot: int, part: int, values: Array) -> None:
    far = graph.world.grip_distance(robot, values, part)
    if far > graph.cell.robots[robot].gripper.grip_distance:
        raise InputError(
            f"the gripper of {graph.cell.robots[robot].name} is {format_quantity(far, 'length')} away from part "
            f"{graph.assembly.names[part]}, which it should hold; give the configuration in which it holds the part"
        )


def _load(graph: KeyframeGraph, robot: int, part: int, gripped: ArrayLike | None) -> CarriedLoad:
    """Return the load of a robot that would hold a part at its place in a configuration, shape (joints,)."""
    entry, name = graph.cell.robots[robot], graph.assembly.names[part]
    if gripped is None:
        raise InputError(
            f"{entry.name} carries part {name}, which is not in place; give the joint values with which it would hold "
            "it at its place"
        )
    values = entry.model.check_configuration(gripped, f"grip of {entry.name}")
    _check_grip(graph, robot, part, values)
    return CarriedLoad(part, inverse_pose(tool_pose(entry, values)), values)
