"""`falsework evaluate`: success rate of a policy on training states and on unseen states."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from tyro.conf import Positional, arg

from falsework.cli.command import UNSET, Command
from falsework.cli.exit_code import Exit
from falsework.errors import InputError

if TYPE_CHECKING:
    import torch

    from falsework.assembly.model import Assembly
    from falsework.cli.output import Output
    from falsework.learn.data.dataset import Dataset
    from falsework.learn.networks.policy import Policy
    from falsework.learn.training.checkpoint import Run
    from falsework.learn.training.evaluate import Sets
    from falsework.search.device.oracle import TensorOracle


@dataclass(frozen=True, kw_only=True)
class Evaluate(Command):
    """Evaluate a policy: follow its most probable actions from many states, and count how often they succeed.

    A rollout succeeds only if every state on its path is certified as stable. The training set is that of a narrow
    search; the test set has the states that a wider search finds beyond it, which training never uses.
    """

    rare: ClassVar[tuple[str, ...]] = ("device", "seed")

    examples: ClassVar[tuple[str, ...]] = (
        "falsework evaluate run",
        "falsework evaluate run --search --states 100 --json",
    )

    folder: Annotated[Positional[Path], arg(metavar="RUN")]
    """Folder that `falsework train` wrote; of a policy for any structure, or `general` for the one that comes with this
    program, with --structure."""
    structure: Annotated[str | None, arg(metavar="STRUCTURE", help_behavior_hint=UNSET)] = None
    """Evaluate the policy on a structure other than the one that it was trained for."""
    robots: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: that of the run)")] = None
    """Number of robots; with another number than that of the run, evaluate on states of new searches."""
    search: bool = False
    """Search where the policy fails, and report the share of test states with a proven plan."""
    targets: bool = False
    """Evaluate pairs of start and goal instead of complete disassembly. A policy trained without goals does not see
    the goal; the rules then protect its parts."""
    criterion: Annotated[
        Literal["contact", "equilibrium"] | None, arg(help_behavior_hint="(default: that of the run)")
    ] = None
    """Stability criterion. With another criterion than that of the run, evaluate on states of new searches."""
    states: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: all)")] = None
    """States of each set, a fixed sample."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Device; `auto` takes a GPU if there is one."""
    seed: int = 0
    """Random seed of samples and of rollouts in a search."""

    def run(self, output: Output) -> Exit:
        """Load, roll out, count."""
        from falsework.utils.optional_packages import check_torch

        check_torch()
        from falsework.learn.env.environment import Environment
        from falsework.learn.networks.autocast import Network
        from falsework.learn.training.evaluate import GoalBlindPolicy, evaluate
        from falsework.search.device.oracle import tensor_oracle
        from falsework.stability import StabilityOracle, StabilitySettings
        from falsework.utils.distributed import init_distributed

        if self.states is not None and self.states < 1:
            raise InputError(f"--states {self.states} leaves nothing to evaluate; give at least 1")
        begun = time.perf_counter()
        with init_distributed(self.device) as (shards, device):
            trained = self._trained(device)
            settings = trained.settings
            criterion = self.criterion or settings.criterion
            assembly, policy = self._subject(trained)
            if not settings.policy.custom:
                policy.of_task(settings.robots, equilibrium=criterion == "equilibrium")
            oracle = StabilityOracle(assembly, StabilitySettings(criterion=criterion))
            environment = Environment(
                assembly, settings.robots, oracle=oracle, device=device, clearance=settings.removable_only_if_clear
            )
            network: Any = Network(policy, settings.precision if device.type == "cuda" else "float32")
            if self.targets:
                sets = self._pairs(trained, assembly, tensor_oracle(oracle, device), device)
                network = network if settings.policy.goal_conditioned else GoalBlindPolicy(network)
            else:
                data = self._data(trained, assembly, tensor_oracle(oracle, device), device)
                sets = {name: (getattr(data, name), None) for name in ("train", "validation", "test")}
            with output.bar("evaluating") as show:
                found = evaluate(
                    environment,
                    network,
                    sets,
                    most=self.states or 0,
                    search=self.search,
                    seed=self.seed,
                    shards=shards,
                    report=show,
                )
            if not shards.is_main_process:
                return Exit.DONE
        record = {
            "structure": assembly.name,
            "trained_on": "" if trained.metadata["structure"] is None else trained.assembly.name,
            "robots": settings.robots,
            "criterion": criterion,
            "phases": [phase.algorithm for phase in settings.phases],
            "policy": settings.policy.kind,
            "goal_conditioned": settings.policy.goal_conditioned,
            "targets": self.targets,
            **found,
            "seconds": round(time.perf_counter() - begun, 3),
            "device": str(device),
        }
        output.record(record)
        for name, result in found.items():
            states = result["states"]
            share = (
                f"{100 * result['success']:.1f} % of {states} states succeed" if states else "there are no such states"
            )
            output.say(f"{name}: {share}")
        if self.search and found["test"]["states"]:
            searched = found["test"]["search"]
            output.say(f"with search: {100 * searched['share']:.2f} % of the test states have a proven plan")
        return Exit.DONE

    def _trained(self, device: torch.device) -> Run:
        """Load the run, one for any structure with the structure to evaluate it on, and with other robots if asked."""
        from dataclasses import replace

        from falsework.assembly import load_structure
        from falsework.learn.training.checkpoint import load_run, read_run, run_folder

        folder = run_folder(self.folder)
        assembly = None
        if self.structure is not None and read_run(folder)["structure"] is None:
            assembly = load_structure(self.structure)
        trained = load_run(folder, device, assembly=assembly)
        if self.robots is None:
            return trained
        return replace(trained, settings=replace(trained.settings, robots=self.robots))

    def _subject(self, trained: Run) -> tuple[Assembly, Policy]:
        """Return the structure and policy: those of the run, or the policy transferred to another structure."""
        from falsework.assembly import load_structure
        from falsework.learn.networks.factory import transfer

        if self.structure is None or trained.metadata["structure"] is None:
            return trained.assembly, trained.policy
        assembly = load_structure(self.structure)
        device = next(trained.policy.parameters()).device
        policy = transfer(trained.policy.state_dict(), trained.settings.policy, assembly, device)
        return assembly, policy.eval()

    def _pairs(self, trained: Run, assembly: Assembly, oracle: TensorOracle, device: torch.device) -> Sets:
        """Return pairs of states and targets, the same for all runs of a structure."""
        from dataclasses import replace

        from falsework.learn.training.run_context import RunContext
        from falsework.learn.training.training_data import find_pairs

        settings = replace(trained.settings, data="width64")  # data for training only are not needed
        pairs = find_pairs(RunContext(assembly, settings, oracle, device))
        sets = {name: getattr(pairs, name) for name in ("train", "validation", "test")}
        return {name: (one.states, one.targets) for name, one in sets.items()}

    def _data(self, trained: Run, assembly: Assembly, oracle: TensorOracle, device: torch.device) -> Dataset:
        """Return the states of the run if they fit structure and criterion, else states of the same searches."""
        from falsework.learn.data.dataset import build_dataset, load_dataset, training_task
        from falsework.learn.training.checkpoint import DATA

        settings: Any = trained.settings
        same = self.structure is None and self.robots is None and self.criterion in (None, settings.criterion)
        if same and (self.folder / DATA).is_file():
            return load_dataset(self.folder / DATA, assembly)
        task = training_task(assembly, settings.robots, settings.removable_only_if_clear)
        return build_dataset(assembly, task, oracle=oracle, device=str(device))
