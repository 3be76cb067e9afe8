"""Training run in one process: blocks of steps, phases, a curve, checkpoints."""

from __future__ import annotations

import platform
import time
from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch

from falsework import __version__
from falsework.assembly.model import Assembly
from falsework.errors import InputError
from falsework.learn.algorithms.learner import Learner
from falsework.learn.config.imitation import ImitationPhase
from falsework.learn.config.train import TrainSettings
from falsework.learn.data.dataset import Dataset
from falsework.learn.data.goal_dataset import GoalDataset
from falsework.learn.data.solvable_states import SolvableStates
from falsework.learn.env.environment import Environment
from falsework.learn.networks.autocast import Network
from falsework.learn.networks.custom_policy import why_not_again
from falsework.learn.networks.factory import describe, make_policy
from falsework.learn.networks.policy import Policy
from falsework.learn.training.budget import TrainingBudget
from falsework.learn.training.checkpoint import CheckpointFile, describe_structure, save_run, write_run
from falsework.learn.training.evaluate import Sets, Success, greedy_success, throughput
from falsework.learn.training.iteration import Iteration
from falsework.learn.training.learners import gather_local, learner_of, local_of, share_solved
from falsework.learn.training.logger import Journal, ProgressLines
from falsework.learn.training.plugins import Plugins
from falsework.learn.training.result import TrainResult
from falsework.learn.training.run_context import RunContext
from falsework.learn.training.selection import BestWeights
from falsework.learn.training.training_data import collect_training_data
from falsework.search.device.oracle import tensor_oracle
from falsework.stability.oracle import StabilityOracle
from falsework.stability.settings import StabilitySettings
from falsework.utils.collectives import decided, same_weights
from falsework.utils.distributed import ProcessGroup
from falsework.utils.quantity import format_quantity
from falsework.utils.tensors import below, put

Report = Callable[[float, str], None]
"""Progress callback `(share done, message)`."""

_SEARCHED_BY = 0.25
"""Share of the training time after which no further search for tasks with targets begins."""
_COMPILE_FROM = 10.0
"""Minutes of training from which compiling the network pays."""


class Trainer:
    """Training run in one process."""

    def __init__(
        self,
        assembly: Assembly,
        settings: TrainSettings,
        folder: Path | None,
        source: dict[str, Any],
        device: torch.device,
        shards: ProcessGroup,
        plugins: Plugins = Plugins(),
        begin: Policy | None = None,
    ) -> None:
        self.plugins = plugins
        self.assembly, self.settings, self.folder = assembly, settings, folder
        self.device, self.shards = device, shards
        self.report: Report = lambda done, text: None
        self.notes: list[str] = []
        self.steps = 0
        self._phase = 0
        self._phase_begun, self._phase_steps = 0.0, 0
        self.data_seconds = 0.0
        self.budget = TrainingBudget(minutes=settings.minutes, steps=settings.steps, shards=shards, device=device)
        self._structure = describe_structure(assembly, source)
        self._results: dict[str, Any] = {}
        self._checkpoint = None if folder is None else CheckpointFile(folder)
        self._curve: list[dict[str, float]] = []
        self._saved = time.perf_counter()
        oracle = StabilityOracle(assembly, StabilitySettings(criterion=settings.criterion))
        self._run = RunContext(
            assembly,
            settings,
            tensor_oracle(oracle, device),
            device,
            shards,
            folder,
            report=lambda text: self.report(0.0, text),
            note=self.notes.append,
        )
        self.environment = Environment(
            assembly,
            settings.robots,
            oracle=oracle,
            device=device,
            removable_only_if_clear=settings.removable_only_if_clear,
        )
        self.solved = SolvableStates(self.environment.rules)
        self.policy = make_policy(assembly, settings.policy, device, settings.seed, given=plugins.policy)
        if begin is not None:
            self.policy.load_state_dict(begin.state_dict())
        if not settings.policy.custom:
            self.policy.of_task(settings.robots, equilibrium=settings.criterion == "equilibrium")
        self.exported = deepcopy(self.policy)
        """Weights that are evaluated, and in the end saved."""
        same_weights(self.policy, shards)
        self._asked = Network(self.exported, settings.precision)
        self._best = BestWeights(settings.patience)
        self._evaluations = settings.evaluations
        self._evaluated = 0
        self._ended = False
        """A callback has ended the training."""
        lost = why_not_again(self.policy, settings.policy, assembly) if settings.policy.custom and folder else ""
        if lost:
            self.notes.append(f"load_run will need the policy handed over: {lost}")

    def run(
        self, begun: float, *, resume: bool, logs: Sequence[str], dataset: Dataset | GoalDataset | None
    ) -> TrainResult:
        """Collect data, train in blocks, and return the result."""
        self.budget.before = time.perf_counter() - begun
        saved = None
        if resume and self._checkpoint is not None and self._checkpoint.exists():
            saved = self._checkpoint.load()
        if self.shards.is_main_process and self.folder is not None:
            self.folder.mkdir(parents=True, exist_ok=True)
            write_run(self.folder, self._metadata())
        self.data = collect_training_data(
            self._run,
            kept=resume,
            dataset=dataset,
            should_stop=lambda: self.budget.progress(self.steps) >= _SEARCHED_BY,
        )
        self.data_seconds = self.data.seconds
        self.solved.hold_out(self.data.held_out)
        self._record_visits(True)
        if saved is None:
            self.solved.add(self.data.starts)
        else:
            self._phase, self._phase_begun, self._phase_steps = (
                saved[1][name] for name in ("phase", "phase_begun", "phase_steps")
            )
            self.data_seconds = saved[1]["data_seconds"]
        if saved is None and not len(self.solved):
            raise InputError(f"no state of {self.assembly.name} is left to learn from; use wider searches")
        learner = self._learner()
        if saved is not None:
            self._load(learner, *saved)
        journal = None
        if self.shards.is_main_process and self.folder is not None:
            at = self.steps if saved is not None else None
            journal = Journal(self.folder, logs, configuration=self._metadata()["settings"], resumed_at=at)
            self.notes += journal.notes
        try:
            with self.budget.interruptible():
                return self._blocks(learner, journal)
        finally:
            if journal is not None:
                journal.close()

    def _blocks(self, learner: Learner, journal: Journal | None) -> TrainResult:
        settings, evaluated = self.settings, -1
        success = {name: Success(0, 0) for name in (*self.data.curve, *self.data.test)}
        numbers: dict[str, float] = {}
        blocks = interrupted = 0
        here, prepared, begun = time.perf_counter(), self.budget.seconds, self.steps
        lines = ProgressLines(journal, self.environment, self.budget, every=settings.progress_every)
        while not self._over():
            if self.budget.stop_requested():
                interrupted = decided(float(not self._ended), self.shards, self.device)
                break
            steps, progress = self.budget.next_block(self.steps, settings.block)
            if self._phase_is_over(progress[0]):
                learner = self._next_phase(learner, progress[0])
            known = len(self.solved)
            learner.listener = partial(self._listen, lines, learner, self.steps - learner.steps, self.steps + steps)
            numbers = learner.block(steps, progress)
            share_solved(self.solved, known, self.shards)
            self.steps += steps
            blocks += 1
            if self._evaluation_is_due():
                success, evaluated = self._evaluate(learner, self.data.curve), self.steps
                self._consider(learner, success["validation"])
                self._log(journal, numbers, success)
            self.report(self.budget.progress(self.steps), self._message(numbers, success["validation"]))
            since = decided(time.perf_counter() - self._saved, self.shards, self.device)
            if since >= settings.checkpoint_every:
                self._save(learner)
        if evaluated != self.steps:
            success = self._evaluate(learner, self.data.curve)
            self._consider(learner, success["validation"])
            self._log(journal, numbers, success)
        if not self.steps and not self._ended:
            self.notes.append(
                f"nothing was trained: the start took {prepared:.1f} s, the search for data "
                f"{self.data_seconds:.1f} s of them, and the run has "
                f"{format_quantity(60 * settings.minutes, 'duration')}; give more minutes"
            )
        elif self.steps == begun and self.budget.progress(begun) >= 1.0:
            self.notes.append(
                f"nothing more was trained: {begun} steps in {format_quantity(prepared, 'duration')} are all that "
                f"was asked for, in all sessions together; give more {'steps' if settings.steps else 'minutes'}"
            )
        self._best.write(self.exported)
        success |= self.succeeded({"train": self.data.curve["train"], **self.data.test})
        success["validation"] = self._best.success
        result = self._result(success, bool(interrupted), time.perf_counter() - here)
        self._results = result.to_dict()
        self._save(learner)
        if self.shards.is_main_process and self.folder is not None:
            save_run(self.folder, self.exported, self._metadata())
        return replace(result, notes=tuple(self.notes))

    def _listen(
        self, lines: ProgressLines, learner: Learner, before: int, most: int, numbers: dict[str, float]
    ) -> None:
        """Log the numbers of a learner at work, and tell callbacks of them; one that returns True ends the training."""
        lines.write(learner, before, most, numbers)
        if not self.shards.is_main_process:
            return
        step = min(before + learner.steps, most)
        now = Iteration(step, self.budget.seconds, self._phase, numbers, learner.policy, self._best.success)
        for callback in self.plugins.callbacks:
            self._ended |= callback(now) is True
        self.budget.stopped |= self._ended

    def _over(self) -> bool:
        """Return whether the budget is used up, or validation has not risen for long."""
        progress = self.budget.progress(self.steps)
        return progress >= 1.0 or self._best.over(progress)

    def _consider(self, learner: Learner, validation: Success) -> None:
        """Keep the evaluated weights if they are the best; a plateau while tasks still get harder is none."""
        progress = self.budget.progress(self.steps)
        self._best.consider(self.exported, validation, self.steps, progress, waiting=learner.widening)

    def _evaluation_is_due(self) -> bool:
        """Return whether the run has passed the next of its equally spaced evaluations, alike in all processes."""
        done = int(self.budget.progress(self.steps) * self._evaluations)
        due, self._evaluated = done > self._evaluated, done
        return due

    def _phase_is_over(self, progress: float) -> bool:
        """Return whether the next phase begins."""
        phase = self.settings.phases[self._phase]
        if phase is self.settings.phases[-1] or not isinstance(phase, ImitationPhase):
            return False
        searched = self.budget.share(self.data_seconds)
        steps = self.steps - self._phase_steps
        return progress >= searched + phase.until * (1.0 - searched) or 0 < phase.steps <= steps

    def _learner(self) -> Learner:
        """Make the learner of the present phase."""
        settings, phase = self.settings, self.settings.phases[self._phase]
        # Compiling takes longer than the little imitation before PPO, and has to be repeated for every size of batch.
        last = self._phase == len(settings.phases) - 1
        pays = self.device.type == "cuda" and settings.minutes >= _COMPILE_FROM and last and not settings.policy.custom
        return learner_of(
            self._run,
            self.environment,
            self.policy,
            self.solved,
            self.data,
            phase,
            begin=self._phase_begun,
            compiled=pays,
            plugins=self.plugins if last else Plugins(),
        )

    def _next_phase(self, learner: Learner, progress: float) -> Learner:
        """Begin the next phase with the final weights of the last one."""
        learner.export_policy(self.exported)
        self._phase += 1
        self._phase_begun, self._phase_steps = progress, self.steps
        self._best.wait(progress)
        following = self._learner()
        following.load_policy(self.exported)
        return following

    def _evaluate(self, learner: Learner, sets: Sets) -> dict[str, Success]:
        """Measure the present weights; states that the GPU leaves open count as failures, as in training."""
        learner.export_policy(self.exported)
        return self.succeeded(sets, exact=False)

    def succeeded(self, sets: Sets, *, exact: bool = True) -> dict[str, Success]:
        """Measure the weights that were exported last."""
        success = {}
        self._record_visits(False)
        self.environment.exact = exact
        for name, (states, targets) in sets.items():
            goals = None if targets is None else put(targets, self.device)
            success[name], _ = greedy_success(
                self.environment, self._asked, put(states, self.device), goals, shards=self.shards
            )
        self._record_visits(True)
        return success

    def _record_visits(self, training: bool) -> None:
        """Record visits to held-out states, and give up states that the GPU leaves open, while rollouts are trained on.

        Rollouts of an evaluation are not recorded, and leave no state open.
        """
        self.environment.record = self.solved.record_visits if training else None
        self.environment.exact = not training

    def _log(self, journal: Journal | None, numbers: dict[str, float], success: dict[str, Success]) -> None:
        line = {f"success/{name}": one.share for name, one in success.items()}
        line |= {"seconds": round(self.budget.seconds, 3), "held_out_visit_rate": self.solved.held_out_visit_rate}
        line |= {f"train/{name}": value for name, value in numbers.items()}
        self._curve.append({"step": self.steps, **line})
        if journal is not None:
            journal.write(self.steps, line)

    def _message(self, numbers: dict[str, float], held_out: Success) -> str:
        loss = f"loss {numbers['loss']:.3f}" if "loss" in numbers else ""
        tested = f"validation {100 * held_out.share:.1f} %" if held_out.states else ""
        return ", ".join(text for text in (f"step {self.steps}", loss, f"{len(self.solved)} states", tested) if text)

    def _save(self, learner: Learner) -> None:
        """Write a checkpoint, in all processes together; a full disk causes a note, and does not end the run."""
        if self._checkpoint is None:
            return
        local = gather_local(learner.local_state_dict(), self.shards, self.device)
        self._saved = time.perf_counter()
        if not self.shards.is_main_process:
            return
        tensors = {f"learner.{name}": tensor for name, tensor in learner.state_dict().items()}
        tensors |= {f"solved.{name}": tensor for name, tensor in self.solved.tensors().items()}
        tensors |= {f"best.{name}": tensor for name, tensor in self._best.tensors().items()}
        state = {
            "steps": self.steps,
            "phase": self._phase,
            "phase_begun": self._phase_begun,
            "phase_steps": self._phase_steps,
            "budget": self.budget.state_dict(),
            "data_seconds": self.data_seconds,
            "best": self._best.state_dict(),
            "evaluated": self._evaluated,
        }
        problem = self._checkpoint.save({**tensors, **local}, state)
        if problem:
            self.notes.append(f"no checkpoint at step {self.steps}: {problem}")
            self.report(self.budget.progress(self.steps), self.notes[-1])

    def _load(self, learner: Learner, tensors: dict[str, torch.Tensor], state: dict[str, Any]) -> None:
        self.steps = state["steps"]
        self.budget.load_state_dict(state["budget"])
        self.solved.load(below("solved.", tensors))
        self._best.load(tensors, state["best"], self.device)
        self._evaluated = state["evaluated"]
        local = local_of(tensors, self.shards)
        if local is None:
            self.notes.append("the number of processes has changed, so the run goes on with other random numbers")
        learner.load_state_dict(below("learner.", tensors), local)

    def _result(self, success: dict[str, Success], interrupted: bool, seconds: float) -> TrainResult:
        gpu = self.device.type == "cuda"
        return TrainResult(
            self.folder,
            self.steps,
            self.budget.seconds,
            self.data_seconds,
            success["train"],
            success["validation"],
            success["test"],
            len(self.solved),
            self.solved.held_out_visit_rate,
            interrupted,
            self.shards.size,
            torch.cuda.get_device_name(self.device) if gpu else platform.processor() or "cpu",
            throughput(self.environment, seconds, self.shards),
            self.exported,
            tuple(self._curve),
            first=self.shards.is_main_process,
        )

    def _metadata(self) -> dict[str, Any]:
        return {
            "structure": self._structure,
            "settings": asdict(self.settings),
            "policy": describe(self.policy, self.settings.policy),
            "results": self._results,
            "versions": {"falsework": __version__, "torch": torch.__version__, "python": platform.python_version()},
        }
