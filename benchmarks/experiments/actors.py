"""Processes that roll one policy out on many structures, while others learn from what they send.

Verdicts are found by these processes, the network is evaluated by another one for all of them. Transitions come back
through a queue; those who learn do not wait for those who roll out.
"""

from __future__ import annotations

import multiprocessing
import os
import queue
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from experiments.inference import Inference, RemotePolicy
from experiments.labelled_states import LabelledStructure, LabelSettings, search_solvable
from numpy.typing import NDArray

from falsework.assembly.model import Assembly
from falsework.errors import InputError
from falsework.learn.algorithms.advantages import normalized
from falsework.learn.algorithms.rollout_storage import collect_transitions
from falsework.learn.algorithms.start_states import MixedStarts
from falsework.learn.config.policy import PolicySettings
from falsework.learn.data.solvable_states import SolvableStates
from falsework.learn.env.environment import Environment
from falsework.learn.env.rollout import PolicyFunction
from falsework.learn.networks.local_attention import LocalAttention
from falsework.learn.training.evaluate import greedy_success, sample
from falsework.stability.oracle import StabilityOracle
from falsework.stability.settings import NumericalSettings, StabilitySettings

COLUMNS = ("states", "actions", "log_probability", "advantage", "returns")
"""What a process tells of each action."""
MASTERED = 0.99
"""Share of successful rollouts of a structure from which on nothing is learned from it: advantages are noise there."""
_GAE_LAMBDA = 0.95
"""Decay of generalised advantages."""
_VISITS = 6
"""Collections of a structure, one after another: its verdicts are in memory then."""
_WIDE, _KEPT = LabelSettings(width=64, searches=1, seconds=30.0), 512
"""Search for states to start from, wider than those for labels, and how many of its states are kept."""
_TRIED = 64
"""States that greedy success is measured from, at most."""
_WAITING = 2
"""Structures that wait to be taken, for each process."""

Load = Callable[[str], Assembly]
"""Returns the structure of a name; a function of a module, which processes import."""


@dataclass(frozen=True, eq=False)
class Experience:
    """What one process found on one structure."""

    name: str
    success: float
    """Share of the rollouts that reached the end."""
    moves: dict[str, NDArray[Any]] | None = None
    """`COLUMNS` of `Transitions`, advantages by their deviation; None of greedy rollouts, which teach nothing."""


class Playground:
    """Environment of one structure on one core, and a policy for it."""

    def __init__(self, assembly: Assembly, labelled: LabelledStructure, policy: PolicyFunction) -> None:
        """Begin with the labelled states, which are solvable."""
        self.name, self.policy, self._assembly = labelled.name, policy, assembly
        settings = StabilitySettings(criterion=labelled.criterion, numerics=NumericalSettings(threads=1))
        self._oracle = StabilityOracle(assembly, settings)
        self.environment = Environment(assembly, labelled.robots, oracle=self._oracle, device="cpu")
        self.states = torch.from_numpy(labelled.states)

    def prepare(self, folder: Path, rollouts: int, generator: torch.Generator) -> None:
        """Begin to collect, from labelled states and those of a wide search, which are kept in a folder."""
        rules, path = self.environment.rules, folder / f"{self.name}.npy"
        if not path.exists():
            end, wide = time.perf_counter() + _WIDE.seconds, SolvableStates(rules)
            seed = int(torch.randint(2**31, (1,), generator=generator))
            search_solvable(wide, self._assembly, self._oracle, _WIDE, seed, lambda: time.perf_counter() > end)
            with tempfile.NamedTemporaryFile(dir=folder, suffix=".npy", delete=False) as file:
                np.save(file, sample(wide.states.numpy(), _KEPT))
            Path(file.name).replace(path)
        states = torch.cat([self.states, torch.from_numpy(np.load(path))])
        self.solved = SolvableStates(rules, states[~rules.reached(states)])
        self.starts = MixedStarts(self.solved.states, self.solved, rollouts)

    def collect(self, rollouts: int, generator: torch.Generator) -> Experience:
        """Sample rollouts, and learn which states are solvable and which are hard."""
        batch = self.starts.sample(rollouts, generator)
        moves = collect_transitions(
            self.environment, self.policy, batch.states, None, generator, discount=1.0, gae_lambda=_GAE_LAMBDA
        )
        self.solved.add(moves.states[moves.success[moves.rollout]])
        self.starts.record(batch, moves, torch.zeros(len(batch.states)), generator)
        columns = {name: getattr(moves, name).numpy() for name in COLUMNS}
        columns["advantage"] = normalized(moves.advantage).numpy()
        return Experience(self.name, float(moves.success.float().mean()), columns)

    def greedy(self) -> float:
        """Return the greedy success from some of the labelled states."""
        some = self.states[:: -(-len(self.states) // _TRIED)]
        return greedy_success(self.environment, self.policy, some)[0].share


class Actors:
    """Processes that roll out, and the two ways to them."""

    def __init__(
        self,
        network: LocalAttention,
        settings: PolicySettings,
        count: int,
        rollouts: int,
        load: Load,
        folder: Path,
        device: torch.device,
    ) -> None:
        """Start the processes.

        Args:
            network: whose weights they begin with.
            settings: of the network, resolved.
            count: processes.
            rollouts: of each collection.
            load: the structure of a name.
            folder: keeps states to start from for later visits.
            device: where the network is evaluated.
        """
        context = multiprocessing.get_context("spawn")
        self.inference = Inference(network, settings, count, device)
        self._jobs, self._found, self._hurry = context.Queue(), context.Queue(), context.Event()
        self._most = _WAITING * count
        folder.mkdir(parents=True, exist_ok=True)
        options = self._jobs, self._found, self._hurry, rollouts, load, folder
        self._processes = [
            context.Process(target=_act, args=(seed, connection, *options), daemon=True)
            for seed, connection in enumerate(self.inference.connections)
        ]
        for process in self._processes:
            process.start()

    @property
    def hungry(self) -> bool:
        """Whether there is room for another structure."""
        return self._jobs.qsize() < self._most

    def visit(self, labelled: LabelledStructure, *, greedy: bool = False) -> None:
        """Ask for rollouts on a structure, sampled ones to learn from or greedy ones."""
        self._jobs.put((labelled, greedy))

    @contextmanager
    def interrupted(self) -> Iterator[None]:
        """Put off sampled rollouts for what is asked meanwhile; nothing waits before and after."""
        self._hurry.set()
        self._drop()
        yield
        self._drop()
        self._hurry.clear()

    def _drop(self) -> None:
        with suppress(queue.Empty):
            while True:
                self._jobs.get_nowait()

    def found(self, wait: float = 0.0) -> Iterator[Experience]:
        """Yield what has come; of nothing, wait some seconds for the first.

        Raises:
            RuntimeError: a process has failed.
        """
        while True:
            try:
                answer = self._found.get(timeout=wait) if wait else self._found.get_nowait()
            except queue.Empty:
                return
            if isinstance(answer, str):
                raise RuntimeError(answer)
            yield answer
            wait = 0.0

    def close(self) -> None:
        """End the processes, whatever they are at."""
        for process in self._processes:
            process.terminate()
        for process in self._processes:
            process.join()
        self.inference.close()
        for one in (self._jobs, self._found):
            one.cancel_join_thread()
            one.close()


def _act(
    seed: int, connection: Any, jobs: Any, found: Any, hurry: Any, rollouts: int, load: Load, folder: Path
) -> None:
    """Roll out on one structure after another; what goes wrong is sent as words."""
    os.environ["CUDA_VISIBLE_DEVICES"] = ""
    torch.set_num_threads(1)
    policy, generator = RemotePolicy(connection), torch.Generator().manual_seed(seed)
    while True:
        labelled, greedy = jobs.get()
        try:
            policy.of(labelled.graph, labelled.robots, labelled.criterion, averaged=greedy)
            playground = Playground(load(labelled.name), labelled, policy)
            if greedy:
                found.put(Experience(labelled.name, playground.greedy()))
                continue
            playground.prepare(folder, rollouts, generator)
            for _ in range(_VISITS):
                found.put(one := playground.collect(rollouts, generator))
                if one.success >= MASTERED or hurry.is_set():
                    break
        except InputError:  # a structure that this machine draws or judges in another way
            continue
        except Exception as error:
            found.put(f"{labelled.name}: {type(error).__name__}: {error}")
            raise
