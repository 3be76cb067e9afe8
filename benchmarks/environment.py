"""Time the environment on tensors and reinforcement learning on it: one JSON object per line.

    python benchmarks/environment.py
    python benchmarks/environment.py --structure vault-62 --rollouts 4096 --device cuda
    torchrun --nproc-per-node 4 benchmarks/environment.py --structure vault-62 --seconds 20 --no-others

A structure is the name of a real one (FALSEWORK_DATA, else the folder `shared` beside the repository), of a built-in
one, or a path. All rows start from the states of one beam search, which is not timed, and after a warm-up. `rollouts`:
rollouts with sampled actions, without learning, steps a second over all processes. `rollouts known`: the same rollouts
again, with all verdicts cached. `ppo`: whole updates of PPO, rollouts and learning. `sb3`: sb3-contrib's MaskablePPO
through the Gymnasium environment, in this process, with a network of the same size and as many epochs, and `sb3
rollouts` its collection of rollouts alone. The rows of one run share a structure, start states and machine. Shares are
of the time in rollouts; on a GPU, `shares_measured` comes from a second run of the same length that synchronises after
each kind of work, since otherwise they are those of the host. Each row has the speed relative to `sb3` if that ran.
With several processes, each runs as many rollouts, and their steps are summed.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from record import report, write_to
from states import find

from falsework import Assembly, StabilityOracle, StateGraph, load_structure
from falsework.learn import (
    PPO,
    REINFORCEMENT,
    Curriculum,
    Environment,
    LearnerContext,
    PolicySettings,
    make_policy,
    roll_out,
)
from falsework.learn.data.dataset import search_states, training_task
from falsework.search.device.oracle import tensor_oracle
from falsework.utils.collectives import same_weights, summed
from falsework.utils.distributed import ProcessGroup, init_distributed


@dataclass(frozen=True)
class Options:
    """Structure, networks and settings to time."""

    structure: str = "bottle-12"
    """Name or path."""
    robots: int = 2
    """Parts that may be held at once."""
    kind: str = "mlp"
    """Kind of policy: mlp, parts or graph."""
    rollouts: int = 0
    """Simultaneous rollouts in each process; 0: 4096 on a GPU, 256 on the CPU."""
    width: int = 64
    """Width of the search that the start states come from."""
    seconds: float = 10.0
    """Duration of each row."""
    device: str = "auto"
    """`auto`, `cpu` or `cuda`."""
    others: bool = True
    """Time sb3-contrib's MaskablePPO too, in the first process."""
    threads: int = 0
    """Threads of torch on the CPU; 0 leaves it to torch."""
    out: Path | None = None
    """File to which the records are appended."""


def wait(device: torch.device) -> None:
    """Wait until all queued work on a device is done."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


class Bench:
    """Rows of one run."""

    def __init__(self, options: Options, shards: ProcessGroup, device: torch.device) -> None:
        self.options, self.shards, self.device = options, shards, device
        self.assembly: Assembly = load_structure(find(options.structure))
        self.task = training_task(self.assembly, options.robots)
        oracle = StabilityOracle(self.assembly)
        states, _ = search_states(
            self.task, tensor_oracle(oracle, device), options.width, 0, device=device, shards=shards
        )
        self.graph = StateGraph.from_states(self.task, states)
        self.rows: dict[str, float] = {}
        self.count = options.rollouts or (4096 if device.type == "cuda" else 256)

    def run(self) -> None:
        """Print all rows."""
        if self.options.others and self.shards.is_main_process:
            self.sb3()
        wait(self.device)
        self.rollouts()
        self.ppo()

    def environment(self) -> Environment:
        """Return an environment with an empty verdict cache."""
        return Environment(
            self.assembly, self.options.robots, oracle=StabilityOracle(self.assembly), device=self.device
        )

    def policy(self) -> Any:
        """Return a policy with random weights, the same in all processes."""
        policy = make_policy(self.assembly, PolicySettings(kind=self.options.kind), self.device)  # type: ignore[arg-type]
        same_weights(policy, self.shards)
        return policy

    def starts(self, environment: Environment, seed: int) -> torch.Tensor:
        """Return start states from the state graph."""
        rows = np.random.default_rng((seed, self.shards.rank)).integers(len(self.graph), size=self.count)
        return environment.rules.put(self.graph.states[rows])

    def play(self, environment: Environment, policy: Any, seconds: float, seed: int) -> tuple[int, float, int]:
        """Run rollouts until the time is over; return steps, seconds and rounds."""
        generator = environment.generator(seed + self.shards.rank)
        before, rounds, begin = environment.counters.steps, 0, time.perf_counter()
        while time.perf_counter() - begin < seconds:
            starts = self.starts(environment, seed + rounds)
            roll_out(environment, policy, starts, greedy=False, generator=generator, keep="ends")
            wait(self.device)
            rounds += 1
        return environment.counters.steps - before, time.perf_counter() - begin, rounds

    def rollouts(self) -> None:
        """Time rollouts alone, with new and with cached verdicts."""
        policy = self.policy()
        self.play(self.environment(), policy, min(2.0, self.options.seconds / 3), 0)
        environment = self.environment()
        for name in ("rollouts", "rollouts known"):  # the same seed: the second time nothing is new
            asked = environment.counters.states_asked
            steps, seconds, rounds = self.play(environment, policy, self.options.seconds, 1)
            extra: dict[str, Any] = {"asked": environment.counters.states_asked - asked, "rounds": rounds}
            if name == "rollouts":
                extra["shares_measured"] = self.shares(policy)
            self.row(name, steps, seconds, policy, **extra)

    def shares(self, policy: Any) -> dict[str, float]:
        """Return the shares of time in rollouts by kind of work, measured with synchronisation after each."""
        environment = self.environment()
        environment.measure = True
        _, seconds, _ = self.play(environment, policy, self.options.seconds, 1)
        counters = environment.counters
        parts = {
            "network": counters.seconds_network,
            "verdicts": counters.seconds_verdicts,
            "rules": counters.seconds_rules,
        }
        shares = {name: round(spent / seconds, 3) for name, spent in parts.items()}
        return {**shares, "rest": round(1 - sum(parts.values()) / seconds, 3)}

    def ppo(self) -> None:
        """Time complete PPO updates."""
        environment, policy = self.environment(), self.policy()
        starts = environment.rules.put(self.graph.states)
        curriculum = Curriculum(starts, environment.rules, shards=self.shards)
        settings = REINFORCEMENT.resolved(self.device.type)
        ppo = PPO(LearnerContext(environment, policy, curriculum, settings, shards=self.shards))
        generator = environment.generator(self.shards.rank)
        ppo.update(curriculum.sample(self.count, generator))
        before, updates, begin = environment.counters.steps, 0, time.perf_counter()
        going = True
        while going:
            ppo.update(curriculum.sample(self.count, generator))
            wait(self.device)
            updates += 1
            late = time.perf_counter() - begin >= self.options.seconds
            going = summed([float(late)], self.shards, self.device)[0] == 0  # all stop together
        steps, seconds = environment.counters.steps - before, time.perf_counter() - begin
        self.row("ppo", steps, seconds, policy, updates=updates)

    def sb3(self) -> None:
        """Time sb3-contrib's MaskablePPO on the same structure."""
        import gymnasium
        import sb3_contrib
        from sb3_contrib import MaskablePPO
        from stable_baselines3.common.callbacks import BaseCallback

        from falsework.learn.env.gymnasium_env import ID

        class Clock(BaseCallback):
            """Callback that measures the time in rollouts and stops after a while."""

            def __init__(self, seconds: float) -> None:
                super().__init__()
                self.limit, self.in_rollouts, self.counted = seconds, 0.0, 0
                self.begin = self.started = time.perf_counter()

            def _on_rollout_start(self) -> None:
                self.started = time.perf_counter()

            def _on_rollout_end(self) -> None:
                self.in_rollouts += time.perf_counter() - self.started
                self.counted = self.num_timesteps

            def _on_step(self) -> bool:
                return time.perf_counter() - self.begin < self.limit

        settings = PolicySettings(kind="mlp").resolved()
        environment = gymnasium.make(ID, structure=self.assembly, robots=self.options.robots, starts=self.graph)
        ppo = REINFORCEMENT.resolved("cpu")
        model = MaskablePPO(
            "MlpPolicy",
            environment,
            n_steps=2048,
            batch_size=ppo.batch,
            n_epochs=ppo.epochs,
            gamma=ppo.discount,
            gae_lambda=ppo.gae_lambda,
            learning_rate=ppo.learning_rate,
            policy_kwargs={"net_arch": [settings.channels] * settings.layers, "activation_fn": torch.nn.Tanh},
            device="cpu",
            seed=0,
        )
        model.learn(2048)
        clock = Clock(self.options.seconds)
        begin = time.perf_counter()
        model.learn(10**9, callback=clock)
        seconds = time.perf_counter() - begin
        version = {"sb3_contrib": sb3_contrib.__version__}
        self.row("sb3", model.num_timesteps, seconds, None, processes=1, sum_up=False, **version)
        self.row("sb3 rollouts", clock.counted, clock.in_rollouts, None, processes=1, sum_up=False, **version)

    def row(
        self,
        name: str,
        steps: int,
        seconds: float,
        policy: Any,
        *,
        sum_up: bool = True,
        processes: int = 0,
        **more: Any,
    ) -> None:
        """Print a row, summed over the processes."""
        rate = steps / seconds if seconds else 0.0
        if sum_up:
            rate = summed([rate], self.shards, self.device)[0]
        self.rows[name] = rate
        if not self.shards.is_main_process:
            return
        reference = self.rows.get("sb3 rollouts" if name.startswith("rollouts") else "sb3")
        gpu = self.device.type == "cuda" and not name.startswith("sb3")
        row = {
            "row": name,
            "structure": self.options.structure,
            "robots": self.options.robots,
            "policy": self.options.kind if policy is not None else "mlp",
            "parameters": None if policy is None else sum(weight.numel() for weight in policy.parameters()),
            "processes": processes or self.shards.size,
            "rollouts_at_once": 1 if name.startswith("sb3") else self.count * self.shards.size,
            "seconds": round(seconds, 2),
            "steps_a_second": round(rate),
            "times_sb3": round(rate / reference, 1) if reference else None,
            **more,
        }
        report("environment", **row, device="cuda" if gpu else "cpu", seeds=(0,))


def main(options: Options) -> None:
    """Run the benchmark."""
    write_to(options.out)
    if options.threads:
        torch.set_num_threads(options.threads)
    with init_distributed(options.device) as (shards, device):
        Bench(options, shards, device).run()


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
