"""Compare networks of policies: one JSON object per line.

    python benchmarks/policies.py cost --structures vault-62
    python benchmarks/policies.py speed --structures vault-62 --device cuda
    python benchmarks/policies.py learn --structures bottle-12 --seconds 60
    python benchmarks/policies.py transfer --seconds 60 --widths 1024

`cost`: weights and counted operations a state. `speed`: states a second, evaluated and trained on. `learn`: greedy
success on unseen states after the same time of imitation of the same data, the states of a search of width 64 (the
paper's Table 5). `transfer`: a policy trained on one structure (`bottle-12` where it is found, else `bottle`), on
another that it has never seen (`dog-35`, else a dome), before and after fine-tuning. One policy for all structures:
`benchmarks/general.py`.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import torch
import tyro
from experiments.policy_cost import policy_cost
from experiments.transfer import Budget, compare_networks, transfer_experiment
from record import report, write_to
from states import find, real_structures

from falsework import load_structure
from falsework.learn import PolicySettings, make_policy, masked_log_probabilities
from falsework.learn.config.policy import Kind
from falsework.learn.data.dataset import DataSettings
from falsework.utils.tensors import choose_device


@dataclass(frozen=True)
class Options:
    """Benchmark and its settings."""

    what: tyro.conf.Positional[Literal["cost", "speed", "learn", "transfer"]]
    """Benchmark."""
    structures: tuple[str, ...] = ()
    """Built-in names, paths, or names of real structures."""
    kinds: tuple[Kind, ...] = get_args(Kind)
    """Networks."""
    robots: int = 2
    """Parts that may be held at once."""
    seconds: float = 60.0
    """Time of training, for each network."""
    steps: int = 0
    """For `learn` and `transfer`: steps of training in place of the time."""
    widths: tuple[int, ...] = ()
    """For `transfer`: widths of further searches for states to learn from, on top of the paper's."""
    turns: int = 8
    """For `transfer`: copies of the structure to learn from, all but one turned about the vertical."""
    layers: int = 0
    """For `speed` and `transfer`: layers of the network; 0 for the default of its kind."""
    channels: int = 0
    """For `speed` and `transfer`: channels of the network; 0 for the default."""
    heads: int = 0
    """For `speed` and `transfer`: attention heads of the network; 0 for the default."""
    device: str = "auto"
    """auto, cpu or cuda."""
    batch: int = 0
    """States per batch; 0: 1,024 on a GPU, 128 on the CPU; for `speed` 8,192 and 64."""
    seed: int = 0
    """Seed of data, weights and batches."""
    compile: bool = False
    """Compile the networks with torch."""
    out: Path | None = None
    """File to which the records are appended."""


def default_structures(names: tuple[str, ...], fallback: tuple[str, ...]) -> tuple[str, ...]:
    """Return the available real structures of these names, else built-in ones."""
    return real_structures(names) or fallback


def cost(options: Options) -> None:
    """Count weights and operations."""
    for name in options.structures or default_structures(("bottle-12", "dome-37", "vault-62"), ("bottle", "vault")):
        assembly = load_structure(find(name))
        for row in policy_cost(assembly, [PolicySettings(kind) for kind in options.kinds]):
            report("policies cost", structure=name, **row)


def speed(options: Options, device: torch.device) -> None:
    """Measure states per second."""
    gpu = device.type == "cuda"
    batch = options.batch or (8192 if gpu else 64)
    for name in options.structures or default_structures(("vault-62",), ("vault",)):
        assembly = load_structure(find(name))
        for kind in options.kinds:
            sizes = PolicySettings(kind, layers=options.layers, channels=options.channels, heads=options.heads)
            policy = make_policy(assembly, sizes, device, options.seed)
            call: Any = torch.compile(policy) if options.compile else policy
            generator = torch.Generator(device).manual_seed(options.seed)
            states = torch.randint(0, 3, (batch, assembly.part_count), generator=generator, device=device)
            states = torch.where(policy.fixed, 2, states).to(torch.uint8)
            mask = torch.ones((batch, 2 * assembly.part_count), dtype=torch.bool, device=device)
            optimizer = torch.optim.AdamW(policy.parameters(), lr=1e-4, fused=gpu)

            def evaluate(call: Any = call, states: torch.Tensor = states) -> None:
                with torch.no_grad(), torch.autocast(device.type, torch.bfloat16, enabled=gpu):
                    call(states)

            def train(call: Any = call, states=states, mask=mask, optimizer=optimizer) -> None:
                with torch.autocast(device.type, torch.bfloat16, enabled=gpu):
                    logits, value = call(states)
                loss = -masked_log_probabilities(logits, mask)[:, 0].mean() + value.square().mean()
                optimizer.zero_grad(set_to_none=True)
                loss.backward()
                optimizer.step()

            rates = {}
            for what, function in (("evaluated", evaluate), ("trained", train)):
                for _ in range(3):
                    function()
                rates[what] = round(batch / timed(function, device, options.seconds / 20))
            memory = torch.cuda.max_memory_allocated(device) if gpu else None
            report(
                "policies speed", structure=name, kind=kind, batch=batch, compiled=options.compile,
                states_per_second=rates, peak_bytes=memory, device=device, seeds=(options.seed,),
            )  # fmt: skip
            if gpu:
                torch.cuda.reset_peak_memory_stats(device)


def timed(function: Any, device: torch.device, seconds: float) -> float:
    """Return seconds per call, over about the given number of seconds."""
    calls, begin = 0, time.perf_counter()
    while True:
        for _ in range(10 if device.type == "cuda" else 1):
            function()
            calls += 1
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        taken = time.perf_counter() - begin
        if taken > seconds:
            return taken / calls


def main() -> None:
    """Run the benchmark of the command line."""
    options = tyro.cli(Options, description=__doc__)
    device = choose_device(options.device)
    write_to(options.out)
    budget = Budget(options.seconds, options.steps)
    if options.what == "cost":
        cost(options)
    elif options.what == "speed":
        speed(options, device)
    elif options.what == "learn":
        for name in options.structures or default_structures(("bottle-12",), ("bottle",)):
            assembly = load_structure(find(name))
            for row in compare_networks(
                assembly, [PolicySettings(kind) for kind in options.kinds], budget=budget,
                robots=options.robots, device=device, batch=options.batch, seed=options.seed,
            ):  # fmt: skip
                report(
                    "policies learn", structure=name, robots=options.robots, **row, device=device, seeds=(options.seed,)
                )  # fmt: skip
    else:
        names = options.structures or default_structures(("bottle-12", "dog-35"), ("bottle", "dome:rings=2,blocks=5"))
        source, *others = (load_structure(find(name)) for name in names)
        for kind in options.kinds:
            if not PolicySettings(kind).transfers:
                continue
            sizes = PolicySettings(kind, layers=options.layers, channels=options.channels, heads=options.heads)
            about = {"kind": kind, "widths": options.widths, "turns": options.turns}
            for row in transfer_experiment(
                source, others, sizes, budget=budget, robots=options.robots, device=device, batch=options.batch,
                seed=options.seed, data=DataSettings(widths=options.widths), turns=options.turns,
            ):  # fmt: skip
                report("policies transfer", **about, **row, device=device, seeds=(options.seed,))


if __name__ == "__main__":
    main()
