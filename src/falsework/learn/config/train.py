"""Settings of a training run, one tree of frozen dataclasses; read without torch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any, Literal, TypeVar, get_args, get_type_hints

from falsework.assembly.state import check_robots
from falsework.errors import InputError
from falsework.learn.config.imitation import ImitationPhase
from falsework.learn.config.import_path import is_import_path
from falsework.learn.config.policy import PolicySettings
from falsework.learn.config.ppo import REINFORCEMENT, PpoPhase
from falsework.utils.quantity import check_seed

Phase = ImitationPhase | PpoPhase
Method = Literal["default", "reinforcement"]
Data = Literal["wide", "width64"]
Criterion = Literal["contact", "equilibrium"]
"""As `falsework.stability.verdict.Criterion`, which would load more than the command line needs to show its help."""

# More imitation overfits the states of the searches, which makes what follows slower and worse.
_IMITATION = ImitationPhase(until=0.5, steps=1000)
METHODS: dict[Method, tuple[Phase, ...]] = {"default": (_IMITATION, PpoPhase()), "reinforcement": (REINFORCEMENT,)}
"""Presets of `TrainSettings.phases` by the name that `falsework train --method` takes."""


def phases_of(method: Method = "default", *, begun: bool = False) -> tuple[Phase, ...]:
    """Return the phases of a preset; imitation is left out of a run that begins with the weights of another one."""
    phases = METHODS[method]
    return phases[-1:] if begun else phases


_EVALUATE_EVERY = 25.0
"""Seconds between two evaluations."""

_FORMER = {
    "PpoPhase": ("hindsight", "curriculum", "target_divergence", "betas", "epsilon", "weight_decay"),
    "TrainSettings": ("pairs",),
}
"""Settings in the files of earlier versions that are none any more."""

T = TypeVar("T")


@dataclass(frozen=True)
class TrainSettings:
    """Settings of a training run."""

    phases: tuple[Phase, ...] = METHODS["default"]
    """Training phases in order; each continues with the weights of the one before. `METHODS` has presets."""
    robots: int = 2
    """Parts held at a time."""
    policy: PolicySettings = field(default_factory=PolicySettings)
    """Network; with `goal_conditioned`, it is conditioned on a goal."""
    reward: str = ""
    """Import path of the reward of PPO, `package.module:function` (`falsework.learn.algorithms.reward`); empty: that of
    the environment."""
    learner: str = ""
    """Import path of the learner in place of PPO, `package.module:Class`; empty: PPO."""
    removable_only_if_clear: bool = False
    """Remove a part only if it has a free straight exit."""
    criterion: Criterion = "contact"
    """Stability criterion of training and test states."""
    data: Data = "wide"
    """`width64`: the paper's training set alone; `wide`: that and the states of wider searches."""
    widths: tuple[int, ...] = ()
    """Widths of the wider searches; none given: by the number of parts and the device."""
    minutes: float = 0.0
    """Total time, data included; 0: by the number of parts and the device."""
    steps: int = 0
    """Optimizer steps instead of a time limit: the run then depends on the seed alone; 0: use `minutes`."""
    seed: int = 0
    """Random seed of weights, batches and rollouts; not of the searches, so that runs with different seeds share one
    test set."""
    block: int = 0
    """Steps between two checks of the time; 0: 200 on a GPU, 20 on a processor."""
    evaluations: int = 0
    """Evaluations on the validation set, in equal shares of the budget; 0: one every 25 s, but at least ten. The best
    weights of these are the result."""
    patience: float = 0.5
    """Share of the budget after whose passing in one phase without a rise of validation the training ends; 0: never.
    The learning rate falls over the whole budget, and validation rises last where it is low."""
    evaluation_states: int = 512
    """Validation states of the curve, at most, and a quarter as many training states; a fixed sample."""
    checkpoint_every: float = 30.0
    """Seconds between two checkpoints, as near as blocks allow."""
    progress_every: float = 1.0
    """Seconds between two lines of progress, at least."""
    random_tries: int = 16
    """Rollouts of random actions none of which may solve a pair that a goal-conditioned policy is tested on."""
    threads: int = 0
    """Threads of torch on a processor; 0: half of its cores, since threads that wait for each other lose more to other
    work on the machine than they win."""
    precision: Literal["auto", "float32", "bfloat16"] = "auto"
    """Precision of the network; `auto` is bfloat16 on a GPU. Verdicts are not affected."""

    def __post_init__(self) -> None:
        if not self.phases or any(not isinstance(one, ImitationPhase) for one in self.phases[:-1]):
            raise InputError("phases of training are imitation, PPO, or imitation followed by PPO; give at least one")
        for role in ("reward", "learner"):
            path = getattr(self, role)
            if path and not is_import_path(path):
                raise InputError(f"the {role} is {path!r}; give an import path, package.module:name")
            if path and not isinstance(self.phases[-1], PpoPhase):
                raise InputError(f"a {role} belongs to PPO, and no phase of this run is PPO; add PpoPhase()")
        if self.data not in get_args(Data):
            raise InputError(f"unknown data {self.data!r}; choose {' or '.join(get_args(Data))}")
        if self.criterion not in get_args(Criterion):
            raise InputError(f"unknown criterion {self.criterion!r}; choose {' or '.join(get_args(Criterion))}")
        if self.minutes < 0 or self.steps < 0:
            raise InputError("minutes and steps are not negative; leave them out for the defaults")
        if self.evaluations < 0 or not 0 <= self.patience <= 1:
            raise InputError("evaluations are not negative, and patience is a share; give 0 or more, and at most 1")
        check_seed(self.seed)
        last = self.phases[-1]
        if self.policy.goal_conditioned and isinstance(last, PpoPhase) and last.starts != "mixed":
            raise InputError("PPO with a curriculum or from the complete structure has no goals; choose the default")
        check_robots(self.robots)

    def resolved(self, parts: int, device: str) -> TrainSettings:
        """Return the settings with all defaults that depend on structure and device.

        Args:
            device: kind of device, `cpu` or `cuda`.
        """
        gpu = device == "cuda"
        minutes = self.minutes or default_minutes(parts, device)
        two = self.policy.goal_conditioned
        widths = default_target_widths(parts, device, minutes) if two else default_widths(parts, device)
        return replace(
            self,
            policy=_policy(self.policy, gpu).resolved(),
            minutes=minutes,
            widths=self.widths or widths,
            phases=tuple(one.resolved(device) for one in self.phases),
            evaluations=self.evaluations or (10 if self.steps else max(10, round(60.0 * minutes / _EVALUATE_EVERY))),
            block=self.block or (200 if gpu else 20),
            precision=("bfloat16" if gpu else "float32") if self.precision == "auto" else self.precision,
        )


def _policy(policy: PolicySettings, gpu: bool) -> PolicySettings:
    """Return the settings of the network, sized for the speed of the device."""
    if policy.kind == "resmlp":
        return replace(policy, channels=policy.channels or (1024 if gpu else 256))
    if policy.kind == "transformer" and not gpu:
        return replace(policy, layers=policy.layers or 3, channels=policy.channels or 64)
    return policy


def default_minutes(parts: int, device: str) -> float:
    """Return the default training time in minutes: enough on a GPU for the figures in the documentation."""
    minutes = 2.0 if parts <= 20 else 5.0 if parts <= 50 else 15.0
    return minutes if device == "cuda" else 2.0 * minutes


def default_widths(parts: int, device: str) -> tuple[int, ...]:
    """Return the widths of the searches for data beyond the paper's.

    Many narrow searches take many paths through the bottlenecks of a structure, a wide one only a few.
    """
    if device == "cuda":
        return (*[128] * 16, 1024) if parts <= 20 else (128,) * 64
    return (128, 128, 256) if parts <= 20 else (128, 256)


def default_target_widths(parts: int, device: str, minutes: float) -> tuple[int, ...]:
    """Return the same for goal-conditioned tasks, far more numerous than states: as many searches as time allows.

    Only many states keep a network from overfitting the paths of a few searches. On a GPU those of more searches than
    these were not tried.
    """
    if parts <= 20:
        return default_widths(parts, device)
    if device == "cuda":
        return (32,) * 192
    # A search of 37 parts takes two seconds on one core, and that grows with more than the square of their number.
    return (128,) * min(max(round(6 * minutes * (37 / parts) ** 3), 12), 120)


def from_dict(kind: type[T], values: Mapping[str, Any]) -> T:
    """Read settings that `asdict` gave, without those that earlier versions had.

    Raises:
        InputError: a name that is no setting, or a value of another type.
    """
    if not isinstance(values, Mapping):
        raise InputError(f"settings of {kind.__name__} are {type(values).__name__}; expected names and values")
    hints, former = get_type_hints(kind), _FORMER.get(kind.__name__, ())
    known = {one.name for one in fields(kind)}  # type: ignore[arg-type]
    given = {name: value for name, value in values.items() if name not in former}
    odd = sorted(set(given) - known)
    if odd:
        raise InputError(f"{odd[0]!r} is not a setting of {kind.__name__}")
    return kind(**{name: _read(hints[name], value, f"{kind.__name__}.{name}") for name, value in given.items()})


def _read(hint: Any, value: Any, name: str) -> Any:
    from falsework.utils.models import plain, read_model  # which the help of the command line does not need

    if is_dataclass(hint):
        return from_dict(hint, value)  # type: ignore[arg-type]
    if hint == tuple[Phase, ...]:
        return tuple(_read_phase(one, name) for one in (value if isinstance(value, (list, tuple)) else [value]))
    return read_model(hint, plain(value), "", InputError, name)


def _read_phase(value: Any, name: str) -> Phase:
    algorithm = value.get("algorithm") if isinstance(value, Mapping) else None
    if algorithm not in ("imitation", "ppo"):
        raise InputError(f"{name} has a phase of the algorithm {algorithm!r}; choose imitation or ppo")
    return from_dict(ImitationPhase if algorithm == "imitation" else PpoPhase, value)
