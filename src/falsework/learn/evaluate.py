"""Evaluation of a trained policy on the states of its run, or on another structure."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import torch

from falsework.assembly.load import AnyStructure, as_assembly
from falsework.assembly.model import Assembly
from falsework.errors import InputError
from falsework.learn.data.dataset import Dataset, build_dataset, load_dataset, training_task
from falsework.learn.env.environment import Environment
from falsework.learn.networks.autocast import Network
from falsework.learn.networks.factory import transfer
from falsework.learn.networks.policy import Policy
from falsework.learn.training.checkpoint import DATA, Run, load_run, read_run, run_folder
from falsework.learn.training.evaluate import Report, Sets, measure_success
from falsework.learn.training.run_context import RunContext
from falsework.learn.training.training_data import find_pairs
from falsework.search.device.oracle import TensorOracle, tensor_oracle
from falsework.stability.oracle import StabilityOracle
from falsework.stability.settings import StabilitySettings
from falsework.stability.verdict import Criterion
from falsework.utils.distributed import init_distributed


def evaluate(
    run: Path | str,
    structure: AnyStructure | None = None,
    *,
    robots: int | None = None,
    criterion: Criterion | None = None,
    targets: bool = False,
    search: bool = False,
    states: int | None = None,
    device: Literal["auto", "cpu", "cuda"] = "auto",
    seed: int = 0,
    progress: Report | None = None,
) -> dict[str, Any] | None:
    """Follow the most probable actions of a policy from many states, and count how often they succeed.

    Args:
        run: folder that `train` wrote; also of a policy for any structure, or `general` for the one that comes with
            the package, with a structure.
        structure: another structure than that of the run, its name or path.
        robots: robots; with another number than that of the run, states of new searches are taken.
        targets: pairs of start and goal instead of complete disassembly.
        search: search where the policy fails, for the share of test states with a proven plan.
        states: states of each set, a fixed sample; all if not given.
        device: `auto` takes a GPU if there is one.
        seed: of samples, and of rollouts in a search.
        progress: called with the number of sets done, of all, and a message.

    Returns:
        The settings of the evaluation, and for `train`, `validation` and `test` the number of states and the share of
        success, as `falsework evaluate --json` writes them; None on all but the main process.

    Raises:
        InputError: no such run, or fewer than one state.
        DependencyError: torch is missing.
    """
    if states is not None and states < 1:
        raise InputError(f"{states} states leave nothing to evaluate; give at least 1")
    begun, other = time.perf_counter(), None if structure is None else as_assembly(structure)
    with init_distributed(device) as (shards, chosen):
        trained = _trained(Path(run), other, robots, chosen)
        settings = trained.settings
        asked = criterion or settings.criterion
        assembly, policy = _subject(trained, other)
        if not settings.policy.custom:
            policy.of_task(settings.robots, equilibrium=asked == "equilibrium")
        oracle = StabilityOracle(assembly, StabilitySettings(criterion=asked))
        environment = Environment(
            assembly,
            settings.robots,
            oracle=oracle,
            device=chosen,
            removable_only_if_clear=settings.removable_only_if_clear,
        )
        network: Any = Network(policy, settings.precision if chosen.type == "cuda" else "float32")
        if targets:
            sets = _pairs(trained, assembly, tensor_oracle(oracle, chosen), chosen)
        else:
            own = other is None and robots is None and criterion in (None, settings.criterion)
            data = _data(Path(run) / DATA if own else None, settings, assembly, tensor_oracle(oracle, chosen), chosen)
            sets = {name: (getattr(data, name), None) for name in ("train", "validation", "test")}
        found = measure_success(
            environment, network, sets, most=states or 0, search=search, seed=seed, shards=shards, report=progress
        )
        if not shards.is_main_process:
            return None
    return {
        "structure": assembly.name,
        "trained_on": "" if trained.metadata["structure"] is None else trained.assembly.name,
        "robots": settings.robots,
        "criterion": asked,
        "phases": [phase.algorithm for phase in settings.phases],
        "policy": settings.policy.kind,
        "goal_conditioned": settings.policy.goal_conditioned,
        "targets": targets,
        **found,
        "seconds": round(time.perf_counter() - begun, 3),
        "device": str(chosen),
    }


def _trained(folder: Path, structure: Assembly | None, robots: int | None, device: torch.device) -> Run:
    """Load the run, one for any structure with the structure to evaluate it on, and with other robots if asked."""
    folder = run_folder(folder)
    for_any = structure is not None and read_run(folder)["structure"] is None
    trained = load_run(folder, device, assembly=structure if for_any else None)
    return trained if robots is None else replace(trained, settings=replace(trained.settings, robots=robots))


def _subject(trained: Run, structure: Assembly | None) -> tuple[Assembly, Policy]:
    """Return the structure and policy: those of the run, or the policy transferred to another structure."""
    if structure is None or trained.metadata["structure"] is None:
        return trained.assembly, trained.policy
    device = next(trained.policy.parameters()).device
    policy = transfer(trained.policy.state_dict(), trained.settings.policy, structure, device)
    return structure, policy.eval()


def _pairs(trained: Run, assembly: Assembly, oracle: TensorOracle, device: torch.device) -> Sets:
    """Return pairs of states and targets, the same for all runs of a structure."""
    settings = replace(trained.settings, data="width64")  # data for training only are not needed
    pairs = find_pairs(RunContext(assembly, settings, oracle, device))
    sets = {name: getattr(pairs, name) for name in ("train", "validation", "test")}
    return {name: (one.states, one.targets) for name, one in sets.items()}


def _data(file: Path | None, settings: Any, assembly: Assembly, oracle: TensorOracle, device: torch.device) -> Dataset:
    """Return the states of the run if they fit structure and criterion, else states of the same searches."""
    if file is not None and file.is_file():
        return load_dataset(file, assembly)
    task = training_task(assembly, settings.robots, settings.removable_only_if_clear)
    return build_dataset(assembly, task, oracle=oracle, device=str(device))
