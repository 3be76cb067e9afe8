"""Which network a policy is, and how large: read without torch."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Literal, get_args

from falsework.errors import InputError

Kind = Literal["resmlp", "transformer", "gat", "mlp"]

_DEFAULTS: dict[str, dict[str, int]] = {
    "resmlp": {"layers": 4, "channels": 512, "heads": 1},
    "transformer": {"layers": 4, "channels": 128, "heads": 8},
    "gat": {"layers": 8, "channels": 16, "heads": 2},
    "mlp": {"layers": 3, "channels": 64, "heads": 1},
}
"""What a size of 0 stands for. The sizes of `gat` and `mlp` are those of the paper (section 5.4)."""
EXPANSION = 2
"""Hidden channels of a feed-forward layer of `resmlp` and `transformer`, by channels."""
_FEW = 20
"""Parts up to which a policy can know all pairs of states by heart."""


@dataclass(frozen=True)
class PolicySettings:
    """A kind of network and its sizes; a size of 0 is the default of the kind."""

    kind: Kind = "resmlp"
    """`resmlp`: layers over the plain state, quick; `transformer`: attention between parts; `gat`: the paper's
    force-torque graph; `mlp`: the paper's baseline."""
    goal_conditioned: bool = False
    """Whether the policy is conditioned on a goal state; without, it disassembles everything that is not fixed."""
    layers: int = 0
    """0: residual and parts 4, graph 8, mlp 3."""
    channels: int = 0
    """0: residual 512, parts 128, graph 16, mlp 64."""
    heads: int = 0
    """Heads of attention, which share the channels; 0: parts 8, graph 2."""

    def __post_init__(self) -> None:
        if self.kind not in get_args(Kind):
            raise InputError(f"unknown policy kind {self.kind!r}; choose {', '.join(get_args(Kind))}")
        for name in ("layers", "channels", "heads"):
            value = getattr(self, name)
            if not isinstance(value, int) or value < 0:
                raise InputError(f"policy {name} is {value!r}; give a positive number, or 0 for the default")
        sizes = self.resolved()
        if self.kind in ("transformer", "gat") and sizes.channels % sizes.heads:
            raise InputError(
                f"policy channels {sizes.channels} do not divide among {sizes.heads} heads; choose a multiple"
            )

    def resolved(self) -> PolicySettings:
        """The same settings with every 0 replaced by the default of the kind."""
        values = asdict(self)
        for name, default in _DEFAULTS[self.kind].items():
            values[name] = values[name] or default
        made = object.__new__(PolicySettings)
        for name, value in values.items():
            object.__setattr__(made, name, value)
        return made

    @property
    def transfers(self) -> bool:
        """Whether the weights fit any structure."""
        return self.kind in ("transformer", "gat")


def recommended(parts: int, *, goal_conditioned: bool = False, kind: Kind | None = None) -> PolicySettings:
    """The network that comes furthest in a given time.

    With one end for all states that is the quickest one, since rollouts count. States with targets of their own are too
    many for that where there are more than a few parts: a network that knows parts by their contacts is then right
    about pairs that it has not seen for the same reason as about those that it has. Rollouts still count, so it is a
    small one.

    Args:
        parts: number of parts.
        goal_conditioned: whether the policy is conditioned on a goal.
        kind: of the network, if that is chosen already.
    """
    usual: Kind = kind or ("transformer" if goal_conditioned and parts > _FEW else "resmlp")
    if usual == "transformer" and goal_conditioned:
        return PolicySettings(usual, goal_conditioned=True, layers=3, channels=64, heads=4)
    return PolicySettings(usual, goal_conditioned=goal_conditioned)
