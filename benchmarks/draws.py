"""Draws of the two searches of the paper's protocol: one to learn from, others to test on.

Which states a beam search keeps depends on its random seed, and so do the success of a policy on the states of another
search and the distance between the two. A figure for one pair of searches says little. A *training draw* is a search of
width 64, one for each seed of training. Its *test draws* are five searches of width 128: four with other seeds, and one
with the seed of the training draw, as the published code pairs them. Three more searches choose the weights.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from falsework import Assembly, Direction, StabilityOracle, StabilitySettings
from falsework.assembly import States
from falsework.learn import Environment, Policy, TrainSettings
from falsework.learn.data.dataset import (
    VALIDATION_STATES,
    Dataset,
    DataSettings,
    search_several,
    search_states,
    training_task,
)
from falsework.learn.data.symmetry import symmetries
from falsework.learn.data.symmetry_augmentation import symmetric_images
from falsework.learn.networks.autocast import Network
from falsework.learn.training.evaluate import greedy_success, sample
from falsework.search.device.oracle import TensorOracle, without_fallback
from falsework.search.problem.hashing import StateIndex
from falsework.stability import PressOracle
from falsework.utils.tensors import put

TRAIN_WIDTH, TEST_WIDTH = 64, 128
TEST_SEEDS, VALIDATION_SEEDS = (1, 11, 21, 31), (2, 12, 22)
WIDE_SEED = 1000
"""Seed of the first of the wider searches to learn from."""
PRESSED = 16
"""Failures of each test draw that are tried again with presses, at most: these are sought state by state."""
_ROWS = 1024
"""States whose distances are computed at once."""


@dataclass(frozen=True, eq=False)
class Draw:
    """Searches of one run: the states to learn from, and those to test on."""

    dataset: Dataset
    """With all test draws of the run together, which it holds out."""
    tests: dict[int, States]
    """States of each test draw that are not among those to learn from, by the seed of its search."""
    pairing: int
    """Seed of the test draw whose search has the seed of the training draw."""


def train_seed(seed: int) -> int:
    """Return the seed of the training draw of a run."""
    return 10 * seed


def test_seeds(seed: int) -> tuple[int, ...]:
    """Return the seeds of the test draws of a run; the first is that of its training draw."""
    return (train_seed(seed), *TEST_SEEDS)


@dataclass(frozen=True, eq=False)
class Searches:
    """Searches of one structure, kept in a folder."""

    assembly: Assembly
    robots: int
    clearance: bool
    oracle: TensorOracle
    device: torch.device
    folder: Path | None
    train_width: int = TRAIN_WIDTH
    test_width: int = TEST_WIDTH

    def states(self, width: int, seed: int) -> States:
        """Return the states of a search, read if they are there."""
        path = None
        if self.folder is not None:
            criterion = self.oracle_criterion()
            rules = f"{criterion}-clear" if self.clearance else criterion
            path = self.folder / f"{self.assembly.name}-{self.robots}-{rules}-{width}-{seed}.npz"
            if path.exists():
                return np.load(path)["states"]
        task = training_task(self.assembly, self.robots, self.clearance).judged_by(self.oracle)
        states, _ = search_states(task, self.oracle, width, seed, device=self.device)
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
            partial = path.with_suffix(f".{np.random.default_rng().integers(1 << 60)}.npz")
            np.savez_compressed(partial, states=states)
            partial.rename(path)
        return states

    def oracle_criterion(self) -> str:
        """Return the criterion of the verdicts."""
        task = training_task(self.assembly, self.robots, self.clearance).judged_by(self.oracle)
        return "equilibrium" if task.holds_keep_stable else "contact"

    def all_seeds(self, seeds: tuple[int, ...]) -> Iterator[tuple[int, int]]:
        """Yield width and seed of all searches that runs with these seeds need."""
        tests = dict.fromkeys(one for seed in seeds for one in test_seeds(seed))
        yield from ((self.train_width, train_seed(seed)) for seed in seeds)
        yield from ((self.test_width, seed) for seed in (*tests, *VALIDATION_SEEDS))

    def draw(self, seed: int, tests: tuple[int, ...], widths: tuple[int, ...] = ()) -> Draw:
        """Return the searches of a run.

        Args:
            seed: of training, which decides the training draw.
            tests: seeds of the test draws.
            widths: of further searches to learn from, without the held-out states.
        """
        task = training_task(self.assembly, self.robots, self.clearance).judged_by(self.oracle)
        train = self.states(self.train_width, train_seed(seed))
        found = {one: _without(self.states(self.test_width, one), train) for one in tests}
        test = np.unique(np.concatenate(list(found.values())), axis=0)
        known = np.concatenate([train, test])
        share = -(-VALIDATION_STATES // len(VALIDATION_SEEDS))
        pieces = [sample(_without(self.states(self.test_width, one), known), share) for one in VALIDATION_SEEDS]
        validation = np.unique(np.concatenate(pieces), axis=0)
        more = train[:0]
        if widths:
            judge, way, wide_seed = without_fallback(self.oracle), Direction.ASSEMBLY, WIDE_SEED + seed
            groups = [(width, widths.count(width)) for width in dict.fromkeys(widths)]
            wide = [search_several(task, judge, n, w, way, wide_seed, device=self.device)[0] for w, n in groups]
            more = _without(np.unique(np.concatenate(wide), axis=0), np.concatenate([known, validation]))
        settings = DataSettings(self.train_width, self.test_width, widths, seed=train_seed(seed))
        dataset = Dataset(train, test, validation, more, task, self.assembly.name, settings)
        return Draw(dataset, found, train_seed(seed))


def learned_from(assembly: Assembly, draw: Draw) -> States:
    """Return the states that a run starts from: all found ones but the held-out ones and their symmetric images."""
    data = draw.dataset
    held_out = symmetric_images(np.concatenate([data.test, data.validation]), symmetries(assembly))
    return _without(np.concatenate([data.train, data.more]), held_out)


def distances(states: States, others: States, device: torch.device, rows: int = _ROWS) -> NDArray[np.float64]:
    """Return the Hamming distance of each state to the nearest of some others, by parts whose condition differs.

    Args:
        states: shape (count, parts).
        others: shape (others, parts), at least one.
        device: where to compute.
        rows: states that are compared at once.

    Returns:
        Shape (count,).
    """
    kind = torch.float16 if device.type == "cuda" else torch.float32

    def spread(rows: States) -> torch.Tensor:
        found = torch.as_tensor(rows, device=device).long()
        return torch.nn.functional.one_hot(found, 3).flatten(1).to(kind)

    mine = spread(states)
    nearest = torch.zeros(len(states), device=device, dtype=kind)
    for begin in range(0, len(others), 1 << 16):
        theirs = spread(others[begin : begin + (1 << 16)]).T
        for row in range(0, len(states), rows):
            agreed = (mine[row : row + rows] @ theirs).max(dim=1).values
            nearest[row : row + rows] = torch.maximum(nearest[row : row + rows], agreed)
    return (states.shape[1] - nearest.double()).cpu().numpy()


def by_distance(found: NDArray[np.float64], success: NDArray[np.bool_]) -> dict[str, list[float]]:
    """Return the number of states and the share of success at each distance."""
    rounded = found.astype(int)
    return {
        str(one): [int((rounded == one).sum()), round(float(success[rounded == one].mean()), 4)]
        for one in np.unique(rounded)
    }


def success_on_draws(
    assembly: Assembly, settings: TrainSettings, policy: Policy, draw: Draw, *, most: int = 0
) -> dict[str, Any]:
    """Return greedy success on each test draw, with the distance of its states to the nearest one learned from.

    Args:
        assembly: the structure.
        settings: of the run.
        policy: as it was trained.
        draw: searches of the run.
        most: states of each test draw that are tried; 0: all.
    """
    device = next(policy.parameters()).device
    oracle = StabilityOracle(assembly, StabilitySettings(criterion=settings.criterion))
    clear = settings.removable_only_if_clear
    environment = Environment(assembly, settings.robots, oracle=oracle, device=device, removable_only_if_clear=clear)
    network = Network(policy, settings.resolved(assembly.part_count, device.type).precision)
    pressed = None
    if settings.criterion == "contact":
        pressing = PressOracle(oracle)
        pressed = Environment(assembly, settings.robots, oracle=pressing, device=device, removable_only_if_clear=clear)
    known = learned_from(assembly, draw)
    found: list[dict[str, Any]] = []
    for seed, states in draw.tests.items():
        chosen = sample(states, most)
        success, each = greedy_success(environment, network, put(chosen, device))
        failed = chosen[~each.cpu().numpy()]
        far = distances(chosen, known, device)
        found.append(
            {
                "seed": seed,
                "published_pairing": seed == draw.pairing,
                "states": len(states),
                "evaluated": success.states,
                "success": success.share,
                "distance": round(float(far.mean()), 3) if len(far) else 0.0,
                "by_distance": by_distance(far, each.cpu().numpy()),
                **({} if pressed is None else with_presses(pressed, network, failed)),
            }
        )
    train, _ = greedy_success(environment, network, put(sample(draw.dataset.train, most), device))
    mean = {name: float(np.mean([one[name] for one in found])) for name in ("success", "distance")}
    return {
        "draws": found,
        "test": {"success": mean["success"], "states": sum(one["states"] for one in found)},
        "distance": round(mean["distance"], 3),
        "train": train.to_dict(),
        "training_states": len(known),
        "training_states_found": len(draw.dataset.train) + len(draw.dataset.more),
    }


def with_presses(environment: Environment, network: Network, failed: States) -> dict[str, int]:
    """Return from how many states the policy succeeds only where its robots may press.

    Where it succeeds without presses it does so with them too, by the same actions.

    Args:
        environment: whose robots press.
        network: as it was trained.
        failed: states from which it fails without, shape (count, parts).
    """
    tried = sample(failed, PRESSED)
    success, _ = greedy_success(environment, network, put(tried, environment.device))
    return {"failed": len(failed), "tried_with_presses": len(tried), "succeeded_with_presses": success.succeeded}


def _without(states: States, others: States) -> States:
    """Return the states that are not among some others."""
    return states[StateIndex(np.unique(others, axis=0)).find(states) < 0] if len(others) else states
