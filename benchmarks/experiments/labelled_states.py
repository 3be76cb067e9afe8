"""States of one structure with the actions that keep them solvable, and files of many such structures.

The states are those of searches that begin at the empty structure, those around them, and those that rollouts of a
policy pass on their way to the end. All of them are solvable. A file holds what a network reads and learns, so training
needs neither meshes nor a solver.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from falsework.assembly.model import Assembly
from falsework.assembly.state import Mask, States
from falsework.learn.data.dataset import check_states, search_states
from falsework.learn.data.solvable_states import SolvableStates
from falsework.learn.env.environment import Environment
from falsework.learn.env.rollout import PolicyFunction, roll_out
from falsework.learn.networks.contact_graph import ContactGraph, from_rows
from falsework.search.device.oracle import HostOracle
from falsework.search.device.rules import TensorRules
from falsework.search.planner import Planner
from falsework.search.problem.guide import SupportGuide
from falsework.search.problem.hashing import StateIndex
from falsework.search.problem.result import Stop
from falsework.search.problem.task import Direction
from falsework.search.settings import PlannerSettings
from falsework.stability.oracle import StabilityOracle
from falsework.stability.settings import NumericalSettings, StabilitySettings
from falsework.stability.verdict import Criterion
from falsework.utils.archive import read_archive, write_archive
from falsework.utils.files.damage import blamed_on

FORMAT = "falsework.labelled/1"


@dataclass(frozen=True)
class LabelSettings:
    """Effort for the states of one structure."""

    width: int = 24
    """States that each search keeps a level."""
    searches: int = 2
    """Searches, each with its own seed."""
    around: int = 3
    """Steps that random walks take away from the states of the searches."""
    rollouts: int = 64
    """Rollouts of a policy, if there is one."""
    most: int = 512
    """States kept."""
    seconds: float = 20.0
    """Time after which no more levels and walks begin."""


@dataclass(frozen=True, eq=False)
class LabelledStructure:
    """Graph of one structure, and solvable states of one task with their valid actions."""

    name: str
    family: str
    robots: int
    criterion: Criterion
    graph: ContactGraph
    states: States
    """Shape (count, parts)."""
    valid: Mask
    """Legal actions whose successors are known to be solvable, shape (count, 2 parts)."""
    success: float | None = None
    """Share of the rollouts of the policy that reached the end; None without a policy."""


def label_states(
    assembly: Assembly,
    robots: int = 2,
    criterion: Criterion = "contact",
    settings: LabelSettings = LabelSettings(),
    *,
    seed: int = 0,
    family: str = "",
    policy: PolicyFunction | None = None,
    known: LabelledStructure | None = None,
) -> LabelledStructure | None:
    """Search a structure on one core, and label states.

    Args:
        assembly: the structure.
        robots: parts that may be held at once.
        criterion: of stability.
        settings: effort.
        seed: of searches, walks, rollouts and of the choice of states.
        family: kept with the result.
        policy: whose successful rollouts add states, and whose failures come first among the states that are kept.
        known: earlier labels of the same task, in place of searches.

    Returns:
        Labels; None if the complete structure was not reached from the empty one.
    """
    end = time.perf_counter() + settings.seconds

    def late() -> bool:
        return time.perf_counter() > end

    oracle = StabilityOracle(assembly, StabilitySettings(criterion=criterion, numerics=NumericalSettings(threads=1)))
    environment = Environment(assembly, robots, oracle=oracle, device="cpu")
    solved, generator = SolvableStates(environment.rules), environment.generator(seed)
    if known is not None:
        solved.add(torch.from_numpy(known.states))
    elif not search_solvable(solved, assembly, oracle, settings, seed, late):
        return None
    _walk(solved, environment, settings.around, generator, late)
    hard, success = solved.states[:0], None
    if policy is not None:
        starts = _spread(solved.states, environment.rules, settings.rollouts, generator)
        rollouts = roll_out(environment, policy, starts, greedy=False, generator=generator)
        kept = (rollouts.passed() & rollouts.success[None]).flatten()
        solved.add(rollouts.states.flatten(0, 1)[kept])
        hard, success = starts[~rollouts.success], float(rollouts.success.float().mean())
    rest = _spread(solved.states, environment.rules, max(settings.most - len(hard), 0), generator)
    chosen = torch.unique(torch.cat([hard, rest]), dim=0)
    chosen = chosen[~environment.rules.reached(chosen)]
    valid = solved.valid_actions(chosen)
    if known is not None:  # successors that are not among the states that were kept
        rows = StateIndex(known.states).find(chosen.numpy())
        old = torch.from_numpy(known.valid[np.maximum(rows, 0)] & (rows >= 0)[:, None])
        valid |= old & environment.rules.moves(chosen)
    graph = ContactGraph.from_assembly(assembly)
    return LabelledStructure(assembly.name, family, robots, criterion, graph, chosen.numpy(), valid.numpy(), success)


def search_solvable(
    solved: SolvableStates, assembly: Assembly, oracle: StabilityOracle, settings: LabelSettings, seed: int, late: Stop
) -> bool:
    """Add the states of searches, and return whether one of them reached the complete structure."""
    task, reached = solved.rules.task, False
    for number in range(settings.searches):
        states, found = search_states(task, HostOracle(oracle), settings.width, seed + number, stop=late)
        solved.add(torch.from_numpy(states))
        reached |= found
        if not found:
            break
    if not reached:
        # Beams with a guide, and with returns to earlier levels, find plans where plain ones do not.
        planner = Planner(task, oracle, PlannerSettings(settings.width, seed=seed), guide=SupportGuide(assembly))
        planner.run(stop=late)
        if not planner.routes:
            return False
        solved.add(torch.from_numpy(planner.routes[0].states))
    return True


def _walk(solved: SolvableStates, environment: Environment, steps: int, generator: torch.Generator, late: Stop) -> None:
    """Add what random steps of assembly lead to: from there the state before it is one action away."""
    rules = TensorRules(environment.rules.task, "cpu", Direction.ASSEMBLY)
    frontier = _spread(solved.states, environment.rules, 256, generator)
    for _ in range(steps):
        mask = rules.moves(frontier)
        frontier, mask = frontier[mask.any(dim=1)], mask[mask.any(dim=1)]
        if late() or len(frontier) == 0:
            return
        actions = torch.multinomial(mask.float(), 1, generator=generator)[:, 0]
        after = rules.follow(frontier, actions)
        after = after[environment.stable(after, frontier, needed=rules.needs_verdict(actions))]
        solved.add(after)
        frontier = after


def _spread(states: torch.Tensor, rules: TensorRules, count: int, generator: torch.Generator) -> torch.Tensor:
    """Draw different states, those of each number of steps from the end about as often."""
    if len(states) <= count:
        return states
    left = rules.steps_left(states)
    weight = 1.0 / torch.bincount(left)[left].double()
    return states[torch.multinomial(weight, count, generator=generator)] if count else states[:0]


def legal_actions(states: torch.Tensor, fixed: torch.Tensor, robots: torch.Tensor) -> torch.Tensor:
    """Return the legal actions of complete disassembly without clear exits, as of `TensorRules.moves`.

    Args:
        states: shape (..., parts).
        fixed: boundary parts, and those that fill up a batch; broadcast to the states.
        robots: parts that may be held, shape (..., 1).

    Returns:
        Bool, shape (..., 2 parts).
    """
    held = (states == 2) & ~fixed
    idle = held.sum(dim=-1, keepdim=True) < robots
    return torch.cat([(states == 1) & ~fixed & idle, held], dim=-1)


_PAIR = ("own", "place", "other", "pair", "lever")
_ARRAYS = frozenset({"part", *_PAIR, "whole", "boundary", "states", "valid"})


def save_labelled(structures: Sequence[LabelledStructure], path: Path | str, about: Mapping[str, Any] = {}) -> None:
    """Write structures with their labels; numbers of features in half precision, states and actions in bits.

    Args:
        structures: at least one.
        path: file to write.
        about: JSON values, such as how the structures were drawn.
    """
    columns: dict[str, list[NDArray[Any]]] = {name: [] for name in _ARRAYS}
    rows = []
    for one in structures:
        graph = one.graph
        own, place = np.nonzero(graph.taken)
        columns["own"].append(own.astype(np.uint16))
        columns["place"].append(place.astype(np.uint8))
        columns["other"].append(graph.neighbour[own, place].astype(np.uint16))
        columns["pair"].append(graph.pair[own, place].astype(np.float16))
        columns["lever"].append(graph.lever[own, place].astype(np.float16))
        columns["part"].append(graph.part.astype(np.float16))
        columns["whole"].append(graph.whole[None])
        columns["boundary"].append(graph.boundary)
        bits = np.concatenate([one.states & 1, one.states >> 1], axis=1)
        columns["states"].append(np.packbits(bits, axis=1).ravel())
        columns["valid"].append(np.packbits(one.valid, axis=1).ravel())
        names = {"name": one.name, "family": one.family, "robots": one.robots, "criterion": one.criterion}
        counts = {"parts": graph.part_count, "pairs": len(own), "states": len(one.states)}
        rows.append({**names, **counts, "success": one.success})
    write_archive(
        path, FORMAT, {"structures": rows, "about": dict(about)}, {k: np.concatenate(v) for k, v in columns.items()}
    )


def load_labelled(path: Path | str) -> tuple[list[LabelledStructure], dict[str, Any]]:
    """Read what `save_labelled` wrote.

    Raises:
        InputError: no such file, a damaged one, or one of another version.
    """
    header, arrays = read_archive(path, FORMAT, _ARRAYS)
    found: list[LabelledStructure] = []
    part_at = pair_at = state_at = valid_at = 0
    with blamed_on(path, "make it anew"):
        for number, row in enumerate(header["structures"]):
            parts, pairs, count = row["parts"], row["pairs"], row["states"]
            mine, slots = slice(part_at, part_at + parts), slice(pair_at, pair_at + pairs)
            width = -(-2 * parts // 8)
            packed = slice(state_at, state_at + count * width), slice(valid_at, valid_at + count * width)
            bits = [
                np.unpackbits(arrays[name][rows].reshape(count, width), axis=1)[:, : 2 * parts]
                for name, rows in zip(("states", "valid"), packed, strict=True)
            ]
            states = bits[0][:, :parts] + 2 * bits[0][:, parts:]
            check_states(path, {"states": states}, parts, "make it anew")
            own, place, other, pair, lever = (arrays[name][slots] for name in _PAIR)
            whole, boundary = arrays["whole"][number], arrays["boundary"][mine]
            graph = from_rows(arrays["part"][mine], own, place, other, pair, lever, whole, boundary)
            names = row["name"], row["family"], row["robots"], row["criterion"]
            found.append(LabelledStructure(*names, graph, states, bits[1].astype(bool), row["success"]))
            part_at, pair_at = mine.stop, slots.stop
            state_at, valid_at = packed[0].stop, packed[1].stop
    return found, header["about"]
