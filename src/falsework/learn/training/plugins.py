"""Components of a training run that users supply: policy, reward, learner and callbacks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from falsework.errors import InputError
from falsework.learn.algorithms.learner import Learner
from falsework.learn.algorithms.learner_context import LearnerContext
from falsework.learn.algorithms.reward import Reward, environment_reward
from falsework.learn.config.import_path import import_by_path, import_path_of
from falsework.learn.config.train import TrainSettings
from falsework.learn.networks.custom_policy import PolicyOrClass, settings_of_custom
from falsework.learn.training.iteration import Callback

LearnerMaker = Callable[[LearnerContext], Learner]
"""Function, or class, that makes the learner in place of PPO."""


@dataclass(frozen=True, eq=False)
class Plugins:
    """Parts of a training run that users bring."""

    policy: PolicyOrClass | None = None
    reward: Reward = environment_reward
    learner: LearnerMaker | None = None
    callbacks: tuple[Callback, ...] = ()

    def named_in(self, settings: TrainSettings) -> TrainSettings:
        """Return the settings of a run with the import paths of what is brought along.

        Raises:
            InputError: a policy that is no module or class, a reward or learner that cannot be called, or no phase in
                which it would have a part.
        """
        if self.policy is not None:
            settings = replace(settings, policy=settings_of_custom(self.policy))
        if self.reward is not environment_reward:
            _check_callable("reward", self.reward)
            settings = replace(settings, reward=import_path_of(self.reward))
        if self.learner is not None:
            _check_callable("learner", self.learner)
            settings = replace(settings, learner=import_path_of(self.learner))
        return settings

    def filled_from(self, settings: TrainSettings) -> Plugins:
        """Return these with the reward and learner that settings name imported, where they are not handed over.

        Raises:
            InputError: one cannot be imported or called.
        """
        found: dict[str, Any] = {}
        if settings.reward and self.reward is environment_reward:
            found["reward"] = import_by_path(settings.reward, "reward")
        if settings.learner and self.learner is None:
            found["learner"] = import_by_path(settings.learner, "learner")
        for role, thing in found.items():
            _check_callable(role, thing)
        return replace(self, **found)


def _check_callable(role: str, thing: Any) -> None:
    if not callable(thing):
        raise InputError(f"the {role} is {str(thing)[:60]}, which cannot be called; give a function or a class")
