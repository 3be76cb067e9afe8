"""Initial keyframe: the task of a cell, and the initial configurations of the robots."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from falsework.assembly.model import Assembly
from falsework.assembly.state import HELD
from falsework.errors import InputError, StateError
from falsework.robots.grasping.exit_directions import ExitDirections
from falsework.robots.keyframes.keyframe_graph import KeyframeGraph
from falsework.robots.keyframes.keyframes import Node
from falsework.robots.model.cell import GRIP_DISTANCE, Cell
from falsework.search.problem.task import STAGE, Task


def task_in_cell(assembly: Assembly, cell: Cell, task: Task | None, exits: ExitDirections) -> Task:
    """Return a task with the number of robots of the cell, and with free exit directions, none of them downwards.

    Raises:
        InputError: props.
        StateError: more parts held at start or target than there are robots, or a part that ends up released.
    """
    given = task or Task.create(assembly.boundary, cell.robot_count, identity=assembly.identity)
    if given.props:
        raise InputError("robot plans have no props; plan for the structure without them")
    freed = np.flatnonzero(STAGE[given.target] < STAGE[given.start])
    if len(freed):
        name = assembly.names[int(freed[0])]
        raise StateError(f"part {name} is held in the start and installed in the target; hold it in the target too")
    return Task.create(
        assembly.boundary,
        cell.robot_count,
        start=given.start,
        target=given.target,
        fixed=given.fixed,
        missing=given.missing,
        clearance=exits.table,
        identity=assembly.identity,
        support=given.support,
    )


def first_keyframe(
    graph: KeyframeGraph,
    task: Task,
    configurations: Sequence[ArrayLike] | None,
    held: Sequence[int | None] | None,
) -> Node:
    """Return the validated initial keyframe.

    Args:
        graph: keyframes of the structure in the cell.
        task: task whose start state is used.
        configurations: joint values of the robots, shape (joints,) each; by default their home.
        held: the part that each robot holds.

    Raises:
        InputError: configurations that do not fit the robots, or in which something collides or a gripper is not at
            the part that it holds.
        StateError: held parts that do not go with the start state.
    """
    robots = graph.cell.robots
    values = graph.cell.homes if configurations is None else tuple(configurations)
    held = (None,) * len(robots) if held is None else tuple(held)
    if len(values) != len(robots) or len(held) != len(robots):
        raise InputError(f"{graph.cell.name} has {len(robots)} robots; give configuration and held part of each")
    checked = tuple(
        robot.model.check_configuration(entry, f"configuration of {robot.name}")
        for robot, entry in zip(robots, values, strict=True)
    )
    names = graph.assembly.names
    wanted = np.flatnonzero((task.start == HELD) & ~graph.assembly.boundary).tolist()
    named = sorted(part for part in held if part is not None)
    if len(set(named)) < len(named):
        raise StateError("two robots hold one part, as within a hand-over; finish that first, then plan from there")
    if named != wanted:
        has, needs = (", ".join(f"part {names[part]}" for part in parts) or "nothing" for parts in (named, wanted))
        raise StateError(
            f"the robots hold {has}, the start state has {needs} held; give the part that each robot holds"
        )
    for robot, part in enumerate(held):
        if part is not None and (far := graph.world.grip_distance(robot, checked[robot], part)) > GRIP_DISTANCE:
            raise InputError(
                f"the gripper of {robots[robot].name} is {far:.3g} m away from part {names[part]}, which it should "
                "hold; give the configuration in which it holds the part"
            )
    node = graph.start(task.start, checked, held)
    for robot in range(len(robots)):
        pair = graph.collision(node, robot)
        if pair is not None:
            raise InputError(f"at the start {pair[0]} is too near {pair[1]}; move {robots[robot].name} away first")
    return node
