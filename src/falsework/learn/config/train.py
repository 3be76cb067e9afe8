"""Every choice that training leaves open, in one tree of frozen dataclasses; read without torch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, is_dataclass, replace
from types import UnionType
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

from falsework.errors import InputError
from falsework.learn.config.policy import PolicySettings
from falsework.learn.config.policy_gradient import RefineSettings
from falsework.learn.config.ppo import PpoSettings

Method = Literal["search", "refine", "imitation", "ppo", "imitation+ppo", "ppo-complete"]
Data = Literal["wide", "width64"]
Criterion = Literal["contact", "equilibrium"]
"""As `falsework.stability.verdict.Criterion`, which would load more than the command line needs to show its help."""

METHODS: tuple[str, ...] = get_args(Method)

T = TypeVar("T")


@dataclass(frozen=True)
class ImitationSettings:
    """How a policy is made to take actions that are known to be valid."""

    batch: int = 0
    """States a step, over all processes; 0: 1,024 on a GPU, 128 on a processor."""
    learning_rate: float = 0.0
    """Largest step of AdamW; 0: 1e-3 on a GPU, 2e-3 on a processor."""
    least_learning_rate: float = 0.01
    """What the learning rate falls to, as a share of the largest."""
    weight_decay: float = 0.01
    """Of AdamW."""
    warm_up: int = 100
    """Steps in which the learning rate rises."""
    decay: float = 0.5
    """Share of the training at the end of which the learning rate falls along half a cosine."""
    clip: float = 1.0
    """Largest norm of the gradient."""
    average: float = 0.998
    """Decay of the moving average of the weights that is evaluated and saved."""
    value: float = 0.1
    """Weight of the error of the value head."""
    unstable: float = 0.1
    """Weight of the probability given to actions after which something fell in a rollout."""
    mistakes: int = 0
    """States a step at which such actions are unlearned; 0: a quarter of the batch."""
    memory: int = 200_000
    """Mistakes and outcomes of rollouts that are remembered."""


@dataclass(frozen=True)
class ImproveRounds:
    """When and from where rollouts of the policy itself look for what is still to be learned."""

    first: float = 0.15
    """Share of the training that is imitation alone, before the first round."""
    every: int = 5
    """Blocks of imitation from one round to the next."""
    starts: int = 0
    """Start states a round, over all processes; 0: 4,096 on a GPU, 256 on a processor."""
    last: float = 0.95
    """Share of the training after which there are no more rounds, so that the last finds are still learned."""


@dataclass(frozen=True)
class PpoPhase:
    """Reinforcement learning with the curriculum of the paper (section 5.2)."""

    rollouts: int = 0
    """Rollouts an update, over all processes; 0: 1,024 on a GPU, 64 on a processor."""
    imitation: float = 0.4
    """Share of the training that is imitation, where that goes before; searches do not count."""
    settings: PpoSettings = field(default_factory=PpoSettings)
    """Of the method."""


@dataclass(frozen=True)
class RefinePhase:
    """Policy gradients from many rollouts that start where searches found states."""

    imitation: float = 0.5
    """Share of the training that is imitation before, at most; searches do not count."""
    imitation_steps: int = 1000
    """Steps of it, at most; 0: any number. What is learned by heart makes the refinement slower and worse."""
    settings: RefineSettings = field(default_factory=RefineSettings)
    """Of the method."""


@dataclass(frozen=True)
class TrainSettings:
    """A whole training run."""

    method: Method = "refine"
    """`search`: imitation of wide searches, then rounds of rollouts whose failures are searched; `refine`: imitation,
    then policy gradients from many rollouts; `imitation`: of the data alone; `ppo`: reinforcement learning with a
    curriculum; `imitation+ppo`: one, then the other; `ppo-complete`: reinforcement learning that always starts from the
    complete structure, as a baseline."""
    robots: int = 2
    """Parts held at a time."""
    policy: PolicySettings = field(default_factory=PolicySettings)
    """Network; with `two_states`, it is told a target."""
    removable_only_if_clear: bool = False
    """Remove a part only if it has a straight way out."""
    criterion: Criterion = "contact"
    """What stable means for the states that the policy learns from and is tested on."""
    data: Data = "wide"
    """`width64`: the paper's training set alone; `wide`: that and the states of wider searches."""
    widths: tuple[int, ...] = ()
    """Widths of the wider searches; none given: by the number of parts and the device."""
    pairs: int = 20_000
    """Pairs of state and target in the training set of a policy of two states, drawn from its first search."""
    data_seed: int = 0
    """Of the searches: training runs with different seeds share one test set."""
    minutes: float = 0.0
    """Time for everything, data included; 0: by the number of parts and the device."""
    steps: int = 0
    """Steps of the optimizer in place of a time: the run then depends on the seed alone; 0: go by `minutes`."""
    seed: int = 0
    """Of weights, batches and rollouts."""
    imitation: ImitationSettings = ImitationSettings()
    """Supervised learning."""
    improve: ImproveRounds = ImproveRounds()
    """Learning from verified search."""
    ppo: PpoPhase = PpoPhase()
    """Reinforcement learning."""
    refine: RefinePhase = RefinePhase()
    """Policy gradients."""
    block: int = 0
    """Steps between two looks at the clock; 0: 200 on a GPU, 20 on a processor."""
    evaluate_every: int = 5
    """Blocks from one point of the curve to the next."""
    evaluation_states: int = 512
    """Test states of the curve, at most, and as many training states; a fixed sample."""
    checkpoint_every: float = 30.0
    """Seconds between two checkpoints, as near as blocks allow."""
    patience: int = 3
    """Rounds in a row in which every rollout succeeded, after which there is nothing left to learn; 0: never stop."""
    threads: int = 0
    """Threads of torch on a processor; 0: half of its cores, since threads that wait for each other lose more to other
    work on the machine than they win."""
    precision: Literal["auto", "float32", "bfloat16"] = "auto"
    """Of the network; `auto` is bfloat16 on a GPU. Verdicts are not affected."""
    compile: Literal["auto", "on", "off"] = "auto"
    """Compile the network with torch; `auto` does on a GPU where there are minutes enough to pay for it."""

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise InputError(f"unknown method {self.method!r}; choose {', '.join(METHODS)}")
        if self.data not in get_args(Data):
            raise InputError(f"unknown data {self.data!r}; choose {' or '.join(get_args(Data))}")
        if self.criterion not in get_args(Criterion):
            raise InputError(f"unknown criterion {self.criterion!r}; choose {' or '.join(get_args(Criterion))}")
        if self.minutes < 0 or self.steps < 0:
            raise InputError("minutes and steps are not negative; leave them out for the defaults")
        if self.seed < 0 or self.data_seed < 0:
            raise InputError("seeds are not negative")
        if self.policy.two_states and self.method in ("search", "ppo-complete"):
            raise InputError(f"method {self.method} knows no targets; choose refine, imitation, ppo or imitation+ppo")
        if self.robots < 1:
            raise InputError(f"{self.robots} robots cannot hold anything; give at least 1")

    def resolved(self, parts: int, device: str) -> TrainSettings:
        """The same settings with everything filled in that depends on structure and device.

        Args:
            parts: number of parts.
            device: kind of device, `cpu` or `cuda`.
        """
        gpu = device == "cuda"
        imitation = self.imitation
        minutes = self.minutes or default_minutes(parts, device)
        two = self.policy.two_states
        widths = default_target_widths(parts, device, minutes) if two else default_widths(parts, device)
        batch = imitation.batch or (1024 if gpu else 128)
        return replace(
            self,
            policy=_policy(self.policy, gpu).resolved(),
            minutes=minutes,
            widths=self.widths or widths,
            imitation=replace(
                imitation,
                batch=batch,
                learning_rate=imitation.learning_rate or (1e-3 if gpu else 2e-3),
                mistakes=imitation.mistakes or max(batch // 4, 1),
            ),
            improve=replace(self.improve, starts=self.improve.starts or (4096 if gpu else 256)),
            ppo=replace(self.ppo, rollouts=self.ppo.rollouts or (1024 if gpu else 64)),
            refine=replace(self.refine, settings=self.refine.settings.resolved(device, two_states=two)),
            block=self.block or (200 if gpu else 20),
            precision=("bfloat16" if gpu else "float32") if self.precision == "auto" else self.precision,
        )


def _policy(policy: PolicySettings, gpu: bool) -> PolicySettings:
    """A quick network as large as the device can play with at leisure, and an attentive one as it can wait for."""
    if policy.kind == "residual":
        return replace(policy, channels=policy.channels or (1024 if gpu else 256))
    if policy.kind == "parts" and not gpu:
        return replace(policy, layers=policy.layers or 3, channels=policy.channels or 64)
    return policy


def default_minutes(parts: int, device: str) -> float:
    """Minutes that training takes if nothing is said: enough on a GPU for the figures in the documentation."""
    minutes = 2.0 if parts <= 20 else 5.0 if parts <= 50 else 15.0
    return minutes if device == "cuda" else 2.0 * minutes


def default_widths(parts: int, device: str) -> tuple[int, ...]:
    """Widths of the searches that make data beyond the paper's: one wide one, and narrow ones that stray further."""
    if device == "cuda":
        return (*[128] * (4 if parts <= 20 else 8 if parts <= 50 else 16), 1024 if parts <= 20 else 4096)
    return (128, 128, 256) if parts <= 20 else (128, 256)


def default_target_widths(parts: int, device: str, minutes: float) -> tuple[int, ...]:
    """The same for tasks with targets, which are far more than states: as many searches as time allows.

    That is some tenth of it on a GPU and some quarter on a processor. Nothing but many states keeps a network from
    learning by heart where the ways of some searches lead.
    """
    if parts <= 20:
        return default_widths(parts, device)
    # A search of 37 parts takes two seconds on one core, and that grows with more than the square of their number.
    if device == "cuda":
        return (256,) * min(max(round(36 * minutes * (37 / parts) ** 1.5), 24), 400)
    return (128,) * min(max(round(6 * minutes * (37 / parts) ** 3), 12), 120)


def as_json(settings: Any) -> dict[str, Any]:
    """Settings as plain JSON values."""
    return asdict(settings)


def from_json(kind: type[T], values: Mapping[str, Any]) -> T:
    """Settings from what `as_json` gave.

    Raises:
        InputError: a name that is no setting, or a value of another type.
    """
    if not isinstance(values, Mapping):
        raise InputError(f"settings of {kind.__name__} are {type(values).__name__}; expected names and values")
    hints = get_type_hints(kind)
    known = {one.name for one in fields(kind)}  # type: ignore[arg-type]
    odd = sorted(set(values) - known)
    if odd:
        raise InputError(f"{odd[0]!r} is no setting of {kind.__name__}")
    return kind(**{name: _read(hints[name], value, f"{kind.__name__}.{name}") for name, value in values.items()})


def _read(hint: Any, value: Any, name: str) -> Any:
    origin = get_origin(hint)
    if is_dataclass(hint):
        return from_json(hint, value)  # type: ignore[arg-type]
    if origin is Literal:
        good = value in get_args(hint)
    elif origin is tuple:
        good = isinstance(value, (list, tuple))
        value = tuple(value) if good else value
    elif origin is UnionType:
        good = isinstance(value, get_args(hint))
    else:
        good = isinstance(value, (int, float) if hint is float else hint) and (hint is bool or value is not True)
    if not good:
        raise InputError(f"{name} is {value!r}, which it cannot be")
    return value
