"""`falsework train`: policy that proposes the next action in any state of one structure."""

from __future__ import annotations

import os
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from tyro.conf import arg

from falsework.cli.arguments import spell_options
from falsework.cli.command import UNSET, DeviceOption, JudgingCommand, StructureOptions
from falsework.cli.exit_code import Exit
from falsework.cli.planning import refuse_unstable
from falsework.errors import InputError
from falsework.learn.config.policy import recommended
from falsework.learn.config.train import Method, TrainSettings, phases_of
from falsework.utils.quantity import counted

if TYPE_CHECKING:
    from falsework.cli.output import Output
    from falsework.learn.training.train import TrainResult


@dataclass(frozen=True, kw_only=True)
class Train(JudgingCommand):
    """Train a policy that proposes the next action from any state of a structure.

    The policy imitates the actions that searches found, then improves by its own rollouts. The weights with the highest
    success on a validation set are kept, and training ends when it no longer rises. The result is a folder, the run,
    with weights, configuration and logs. An interrupted training is continued by the same command with --resume.
    Under torchrun several processes share the work. Exit code 1 if the time was up before the first step.
    """

    rare: ClassVar[tuple[str, ...]] = (
        "begin",
        "goal_conditioned",
        "removable_only_if_clear",
        "reward",
        "learner",
        "data",
        "seed",
        "device",
        "log",
    )

    examples: ClassVar[tuple[str, ...]] = (
        "falsework train bottle --robots 2 --out run --minutes 1",
        "falsework train bottle --out run --resume --minutes 2",
    )

    structure: StructureOptions
    out: Annotated[Path, arg(metavar="RUN")] = Path("run")
    """Folder to write."""
    robots: int = 2
    """Number of robots: parts that can be held at a time."""
    minutes: Annotated[float | None, arg(metavar="M", help_behavior_hint="(default: by structure and device)")] = None
    """Total time, the search for data and earlier sessions included."""
    steps: Annotated[int | None, arg(metavar="N", help_behavior_hint=UNSET)] = None
    """Optimizer steps in place of a time limit, for a reproducible run."""
    resume: bool = False
    """Resume the run in the folder; of the other options only --minutes, --steps, --device and --log apply."""
    begin: Annotated[Path | None, arg(metavar="RUN", help_behavior_hint=UNSET)] = None
    """Run whose weights and network to begin with: of this structure, of another one (`transformer`, `gat`), or of a
    policy for any structure."""
    method: Method = "default"
    """Preset: a short imitation of searches, which is left out with `--begin`, and then PPO from many rollouts
    (`default`), or PPO from scratch with a curriculum of start states (`reinforcement`), which does better where few
    states are known (`--data width64`)."""
    policy: Annotated[
        str | None, arg(metavar="KIND", help_behavior_hint="(default: resmlp; transformer above 20 parts)")
    ] = None
    """Network: residual layers over the state (`resmlp`), attention between parts (`transformer`), the paper's graph
    attention (`gat`), its baseline (`mlp`), or a class of your own (`package.module:Class`). The weights of transformer
    and gat fit other structures."""
    reward: Annotated[str | None, arg(metavar="MODULE:FUNCTION", help_behavior_hint=UNSET)] = None
    """Reward of your own for PPO."""
    learner: Annotated[str | None, arg(metavar="MODULE:CLASS", help_behavior_hint=UNSET)] = None
    """Learner of your own in place of PPO."""
    goal_conditioned: bool = False
    """Train a goal-conditioned policy."""
    removable_only_if_clear: bool = False
    """Remove a part only if it has a collision-free straight exit."""
    data: Literal["wide", "width64"] = "wide"
    """Training data: wide searches, or the paper's training set alone."""
    seed: int = 0
    """Random seed of weights, batches and rollouts."""
    device: DeviceOption = "auto"
    log: tuple[Literal["tensorboard", "wandb"], ...] = ("tensorboard",)
    """Loggers in addition to progress.jsonl in the folder."""

    def run(self, output: Output) -> Exit:
        """Search, train and save."""
        from falsework.utils.tensors import check_torch

        check_torch()
        from falsework.learn.data.dataset import training_task
        from falsework.learn.training.train import train
        from falsework.stability.oracle import StabilityOracle
        from falsework.stability.settings import StabilitySettings

        for name, given in (("--minutes", self.minutes), ("--steps", self.steps)):
            if given is not None and not given > 0:
                raise InputError(f"{name} {given} leaves no time to learn; give more than 0")
        assembly = self.structure.load()
        settings = TrainSettings(
            phases=phases_of(self.method, begun=self.begin is not None),
            robots=self.robots,
            policy=recommended(assembly.part_count, goal_conditioned=self.goal_conditioned, kind=self.policy),
            reward=self.reward or "",
            learner=self.learner or "",
            removable_only_if_clear=self.removable_only_if_clear,
            criterion=self.criterion,
            data=self.data,
            minutes=self.minutes or 0.0,
            steps=self.steps or 0,
            seed=self.seed,
        )
        task = training_task(assembly, self.robots, self.removable_only_if_clear)
        oracle = StabilityOracle(assembly, StabilitySettings(criterion=self.criterion))
        if not self.resume and refuse_unstable(assembly, oracle, task, output):
            return Exit.NO
        first = os.environ.get("RANK", "0") == "0"  # only one of several processes shows progress
        try:
            with output.bar("training") as show:
                result = train(
                    assembly,
                    settings,
                    folder=self.out,
                    begin=self.begin,
                    source=self.structure.source(self.out / "run.json"),
                    device=self.device,
                    resume=self.resume,
                    logs=self.log,
                    report=lambda done, text: show(round(1000 * done), 1000, text) if first else None,
                )
        except KeyboardInterrupt:
            begun = (self.out / "run.json").is_file()
            output.note(self._interrupted if begun else "interrupted before anything was kept")
            return Exit.INTERRUPTED
        return self._tell(result, output)

    @property
    def _interrupted(self) -> str:
        structure = " ".join(filter(None, (shlex.quote(self.structure.spec), spell_options(self.structure.given()))))
        return f"interrupted; falsework train {structure} --out {shlex.quote(str(self.out))} --resume continues"

    def _tell(self, result: TrainResult, output: Output) -> Exit:
        if not result.first:
            return Exit.DONE
        for note in result.notes:
            output.note(note)
        output.file(self.out)
        output.record(result.to_dict())
        train, test = result.train, result.test
        tested = f"{100 * test.share:.1f} % of {test.states} test states and "
        output.say(
            f"{self.out}: {tested if test.states else 'no states are left to test on; '}"
            f"{100 * train.share:.1f} % of {train.states} training states succeed, "
            f"{counted(result.steps, 'step')} in {result.seconds:.0f} s; {counted(result.solved, 'state')} learned from"
        )
        if result.interrupted:
            output.note(self._interrupted)
            return Exit.INTERRUPTED
        return Exit.DONE if result.steps else output.outcome("untrained")
