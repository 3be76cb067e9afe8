"""The environment: thousands of rollouts as tensors, with the rewards of the paper and proven verdicts."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass

import torch

from falsework.assembly.model import Assembly
from falsework.learn.env.verdict_cache import VerdictTable
from falsework.search.device.oracle import HostOracle, TensorOracle, tensor_oracle, without_fallback
from falsework.search.device.rules import TensorRules
from falsework.search.problem.oracle import Oracle
from falsework.search.problem.task import Task
from falsework.stability.oracle import StabilityOracle
from falsework.utils.tensors import choose_device, put


@dataclass(frozen=True, eq=False)
class Step:
    """Result of one action in each of a batch of states."""

    states: torch.Tensor
    """`uint8`, shape (batch, parts). Of a row that ended unstable: the state that is not proven stable."""
    reward: torch.Tensor
    """+1 where the target is reached, -1 where the state is not proven stable or has no legal action left, else 0.
    `float32`, shape (batch,)."""
    done: torch.Tensor
    """`bool`, shape (batch,)."""
    success: torch.Tensor
    """Target reached. `bool`, shape (batch,)."""
    unstable: torch.Tensor
    """Ended by an action after which stability is not proven: the state is unstable, slides or is open. `bool`, shape
    (batch,)."""
    mask: torch.Tensor
    """Legal actions of the new states, `bool`, shape (batch, 2 parts)."""


@dataclass(frozen=True, eq=False)
class Rollouts:
    """Outcome of a batch of rollouts."""

    states: torch.Tensor
    """`uint8`, shape (steps + 1, batch, parts). Row `t` of a rollout that ended before is its last state again. If only
    ends are kept, shape (2, batch, parts): first and last states."""
    actions: torch.Tensor
    """`int16`, shape (steps, batch), -1 after the end; empty if only ends are kept."""
    length: torch.Tensor
    """Actions taken, the one that led to an unstable state included. `int64`, shape (batch,)."""
    success: torch.Tensor
    """Target reached. `bool`, shape (batch,)."""
    unstable: torch.Tensor
    """Ended by an action after which stability is not proven; the last state is then that one. `bool`, shape (batch,).
    A rollout that is neither ended in a state without a legal action."""

    @property
    def stuck(self) -> torch.Tensor:
        """Ended in a stable state without a legal action that is not the target. `bool`, shape (batch,)."""
        return ~self.success & ~self.unstable

    @property
    def last(self) -> torch.Tensor:
        """State in which each ended, shape (batch, parts)."""
        return self.states[-1]

    def passed(self) -> torch.Tensor:
        """Return which of `states` are proven stable and not repetitions of the end. `bool`, shape (steps + 1, batch).

        Only if all states were kept.
        """
        place = torch.arange(len(self.states), device=self.states.device)[:, None]
        return place <= (self.length - self.unstable.long())[None]


@dataclass
class EnvironmentCounters:
    """Work done so far, and the time it took.

    On a GPU the seconds are those of the host unless `Environment.measure` is set, which waits after each part.
    """

    steps: int = 0
    """Actions carried out, over all rollouts."""
    states_asked: int = 0
    """States checked by the oracle: each distinct one once, and not known before."""
    seconds_network: float = 0.0
    """In the policy, choice of the action included."""
    seconds_verdicts: float = 0.0
    """In verdicts, lookups included."""
    seconds_rules: float = 0.0
    """In masks, transitions and rewards."""

    def to_dict(self) -> dict[str, int | float]:
        """Return plain numbers for reports, with the share of each kind of work in their sum."""
        numbers = asdict(self)
        seconds = {name: value for name, value in numbers.items() if name.startswith("seconds_")}
        total = sum(seconds.values())
        shares = {name.replace("seconds", "share"): s / total if total else 0.0 for name, s in seconds.items()}
        return {**numbers, **shares}


class Environment:
    """Environment that disassembles one structure, batched as tensors (paper, section 5.2).

    Rewards: +1 when all removable parts are removed or the goal is reached, -1 at the first state that is not stable,
    0 otherwise. A rollout that reaches a state without a legal action, which robots that wait for each other or a
    clearance table can cause, fails with -1. Every action needs a verdict; under the criterion `equilibrium` only
    removals do, since there a hold never destabilises. Start states are assumed to be stable.
    """

    def __init__(
        self,
        assembly: Assembly,
        robots: int = 2,
        *,
        oracle: Oracle | None = None,
        device: torch.device | str = "auto",
        removable_only_if_clear: bool = False,
        fixed: Sequence[int] = (),
    ) -> None:
        """Copy rules and problem to the device.

        Args:
            robots: number of parts that may be held at once.
            oracle: decides stability; pass an existing `StabilityOracle` to reuse its cache.
            device: where states, rules and verdicts live: `auto`, `cpu`, `cuda`, `cuda:1`.
            removable_only_if_clear: remove a part only if it has a free exit direction.
            fixed: parts that are never touched.

        Raises:
            DependencyError: a package that the device needs is not installed.
            InputError: no such device, fewer than one robot, or a fixed part that does not exist.
        """
        self.assembly = assembly
        self.device = choose_device(device) if isinstance(device, str) else torch.device(device)
        self.oracle: Oracle = StabilityOracle(assembly) if oracle is None else oracle
        table = assembly.clearance if removable_only_if_clear else None
        task = Task.from_rules(assembly.boundary, robots, fixed=fixed, clearance=table, identity=assembly.identity)
        self.rules = TensorRules(task.judged_by(self.oracle), self.device)
        self.counters = EnvironmentCounters()
        self.measure = False
        """Synchronise the device around each kind of work, so that times are exact."""
        self.rows_at_once = 1 << 13
        """Largest batch of states for the policy."""
        self.exact = True
        """Send the few states that the GPU solver leaves undecided to the exact solver, which runs on the CPU while all
        rollouts wait; otherwise they count as not proven stable."""
        self.record: Callable[[torch.Tensor], object] | None = None
        """Called with the states after every step, shape (batch, parts)."""
        self.on_device = _tensor_oracle(self.oracle, self.device)
        self.verdict_cache = VerdictTable(self.rules)

    @property
    def part_count(self) -> int:
        """Number of parts, boundary included."""
        return self.rules.part_count

    def generator(self, seed: int) -> torch.Generator:
        """Make a random number generator on the device of this environment."""
        return torch.Generator(self.device).manual_seed(seed)

    def stable(
        self, states: torch.Tensor, parents: torch.Tensor | None = None, *, needed: torch.Tensor | None = None
    ) -> torch.Tensor:
        """Return which states are proven stable; verdicts are cached, and equal rows are checked once.

        Args:
            states: `uint8` on the device, shape (batch, parts).
            parents: for each a stable state that is one action away, shape (batch, parts); under `equilibrium` the
                solver on the processor starts from its solution. Under `contact` it starts from rest, as a GPU does:
                some states that stand from rest are not found at rest from the displacement of another one.
            needed: rows that need a verdict; the others are returned as stable. All if None. Shape (batch,).

        Returns:
            `bool`, shape (batch,).
        """

        def ask(asked: torch.Tensor, rows: torch.Tensor) -> torch.Tensor:
            self.counters.states_asked += len(asked)
            oracle = self.on_device if self.exact else without_fallback(self.on_device)
            if parents is not None and self.oracle.holds_keep_stable:
                return oracle(asked.contiguous(), parents[rows].contiguous())
            if isinstance(oracle, HostOracle):
                return put(self.oracle.verdicts(asked.cpu().numpy()).verdict, self.device)
            return oracle(asked, asked)

        with self.timed("seconds_verdicts"):
            return self.verdict_cache.stable(states, needed, ask, final=self.exact)

    def step(
        self,
        states: torch.Tensor,
        actions: torch.Tensor,
        targets: torch.Tensor | None = None,
    ) -> Step:
        """Carry out one action in each state.

        Args:
            states: stable, not done, shape (batch, parts).
            actions: legal in the states, which is not checked, shape (batch,).
            targets: shape (batch, parts); None takes everything away that is not fixed.
        """
        rules = self.rules
        with self.timed("seconds_rules"):
            after = rules.follow(states, actions)
            needed = rules.needs_verdict(actions)
        stable = self.stable(after, states, needed=needed)
        with self.timed("seconds_rules"):
            mask = rules.moves(after, targets)
            success = rules.reached(after, targets) & stable
            failed = ~stable | ~(success | mask.any(dim=1))
            reward = success.float() - failed.float()
        self.counters.steps += len(states)
        if self.record is not None:
            self.record(after)
        return Step(after, reward, success | failed, success, ~stable, mask)

    @contextmanager
    def timed(self, name: str) -> Iterator[None]:
        """Add the seconds of some work to a counter."""
        self._wait()
        begun = time.perf_counter()
        yield
        self._wait()
        setattr(self.counters, name, getattr(self.counters, name) + time.perf_counter() - begun)

    def _wait(self) -> None:
        if self.measure and self.device.type == "cuda":
            torch.cuda.synchronize(self.device)


def _tensor_oracle(oracle: Oracle, device: torch.device) -> TensorOracle:
    """Return the solver on the device, unless the oracle is set to be exact, or is of another kind.

    An oracle for the processor, which is the default, says nothing about where rollouts are to be judged: states would
    leave the device at every step, and a GPU would wait for two cores.
    """
    if (
        device.type == "cuda"
        and isinstance(oracle, StabilityOracle)
        and oracle.settings.solver in ("auto", "cpu", "gpu")
    ):
        return tensor_oracle(oracle, device)
    return HostOracle(oracle)
