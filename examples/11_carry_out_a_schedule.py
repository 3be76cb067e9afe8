"""Carry out a schedule of two arms against simulated controllers, one of which is late.

Each arm runs its own motions in order. Before a motion it waits until every motion named by a precedence has come as
far as it says; nothing else couples the arms, so a late arm delays those that wait for it and no state is skipped.

Run: python examples/11_carry_out_a_schedule.py
Needs: pip install 'falsework[robots,schedule]'
"""

from __future__ import annotations

import asyncio
import tempfile
from pathlib import Path

from falsework import load_cell, load_structure, plan_robots
from falsework.robots import Precedence, RobotPlan, nodes_of

CELL = """
format = "falsework.cell/1"
name = "two arms"

[structure]
density = 200

[grippers.cup]
kind = "suction"
payload = 10.0
mass = 1.0
cup = 0.02
tool = { position = [0.0, 0.0, 0.18] }
shapes = [{ cylinder = { radius = 0.02, low = 0.0, high = 0.178 } }]

[[robots]]
name = "left"
model = "irb2600-12/1.65"
gripper = "cup"
base = { position = [-1.15, 0.0, 0.0], yaw = 0.0 }
places = [{ position = [0.15, -0.95, 0.55] }]

[[robots]]
name = "right"
model = "irb2600-12/1.65"
gripper = "cup"
base = { position = [1.15, 0.0, 0.0], yaw = 180.0 }
places = [{ position = [0.15, -0.95, 0.55] }]
"""
SPEED = 20.0  # simulated seconds in a second
TICK = 0.02  # simulated seconds between two reports of a controller


class Executor:
    """Runs a temporal plan graph; one task an arm, and one condition that all of them wait on."""

    def __init__(self, plan: RobotPlan, late: dict[int, float]) -> None:
        """`late`: by what factor each arm is slower than planned."""
        assert plan.schedule is not None
        self.plan, self.graph, self.late = plan, plan.schedule, late
        self.progress = [-1.0] * len(self.graph.nodes)  # nominal seconds done; -1: not begun
        self.began = [0.0] * len(self.graph.nodes)
        self.changed = asyncio.Condition()

    async def run(self) -> float:
        """Carry everything out, and return how long it took."""
        self.begin = asyncio.get_running_loop().time()
        await asyncio.gather(*(self.arm(robot) for robot in range(self.graph.robots)))
        return self.now()

    def now(self) -> float:
        """Simulated seconds since the start."""
        return (asyncio.get_running_loop().time() - self.begin) * SPEED

    async def arm(self, robot: int) -> None:
        """The motions of one arm, in its order."""
        for node in self.graph.of_robot(robot):
            waits = [edge for edge in self.graph.edges if edge.after == node]
            async with self.changed:
                await self.changed.wait_for(lambda waits=waits: all(self.reached(edge) for edge in waits))
            self.began[node] = self.now()
            await self.controller(robot, node)

    def reached(self, edge: Precedence) -> bool:
        """Whether a motion has come as far as another one waits for."""
        return self.progress[edge.before] >= min(edge.offset, self.length(edge.before))

    def length(self, node: int) -> float:
        """Nominal duration of a motion."""
        return self.graph.nodes[node].seconds

    async def controller(self, robot: int, node: int) -> None:
        """Stand-in for a robot controller: reports how far a trajectory is done."""
        while True:
            done = (self.now() - self.began[node]) / self.late.get(robot, 1.0)
            async with self.changed:
                self.progress[node] = min(done, self.length(node))
                self.changed.notify_all()
            if done >= self.length(node):
                return
            await asyncio.sleep(TICK / SPEED)


def main() -> None:
    """Plan, schedule, and carry out: in time, and with one arm at half its speed."""
    with tempfile.TemporaryDirectory() as scratch:
        file = Path(scratch) / "cell.toml"
        file.write_text(CELL)
        cell = load_cell(file)
    structure = load_structure("stack:blocks=2,length=0.3,height=0.15,depth=0.3")
    plan = plan_robots(structure, cell, concurrent=True).unwrap()
    print(f"planned: {plan.makespan:.1f} s; one motion after the other {plan.seconds:.1f} s")
    for late in ({}, {1: 2.0}):
        executor = Executor(plan, late)
        seconds = asyncio.run(executor.run())
        states = [executor.began[event.node] for event in nodes_of(plan)[1]]
        assert states == sorted(states)  # the structure went through the states of the plan, in their order
        print(f"{'an arm at half speed' if late else 'in time'}: {seconds:.1f} s, {len(states)} steps in their order")


if __name__ == "__main__":
    main()
