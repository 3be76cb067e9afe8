"""Settings of policy networks, which load without torch."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Literal, get_args

from falsework.errors import InputError
from falsework.learn.config.import_path import is_import_path

Kind = Literal["resmlp", "transformer", "local", "gat", "mlp"]

_DEFAULTS: dict[str, dict[str, int]] = {
    "resmlp": {"layers": 4, "channels": 512, "heads": 1},
    "transformer": {"layers": 4, "channels": 128, "heads": 8},
    "local": {"layers": 5, "channels": 64, "heads": 4},
    "gat": {"layers": 8, "channels": 16, "heads": 2},
    "mlp": {"layers": 3, "channels": 64, "heads": 1},
}
"""Sizes that 0 stands for. The sizes of `gat` and `mlp` are those of the paper (section 5.4)."""
EXPANSION = 2
"""Hidden channels of a feed-forward layer of `resmlp`, `transformer` and `local`, as a multiple of the channels."""
_FEW = 20
"""Number of parts up to which a policy can memorise the states of many searches, and all pairs of them."""


@dataclass(frozen=True)
class PolicySettings:
    """Kind and sizes of a network; a size of 0 is the default of the kind."""

    kind: str = "resmlp"
    """`resmlp`: residual layers over the state vector; `transformer`: attention between parts; `local`: attention of
    parts to their neighbours, for any structure; `gat`: the paper's force-torque graph; `mlp`: its baseline; or the
    import path of a class of your own, `package.module:Class` (`falsework.learn.networks.custom_policy`)."""
    goal_conditioned: bool = False
    """Whether the policy is conditioned on a goal state; without, it disassembles everything that is not fixed."""
    layers: int = 0
    """0: resmlp and transformer 4, local 5, gat 8, mlp 3."""
    channels: int = 0
    """0: resmlp 512, transformer 128, local 64, gat 16, mlp 64."""
    heads: int = 0
    """Attention heads, which share the channels; 0: transformer 8, local 4, gat 2."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """Arguments of a class of your own beside the assembly, JSON values; it has no layers, channels and heads here."""

    def __post_init__(self) -> None:
        if self.kind not in get_args(Kind) and not is_import_path(self.kind):
            raise InputError(
                f"unknown policy kind {self.kind!r}; choose {', '.join(get_args(Kind))}, or the import path of your "
                "own, package.module:Class"
            )
        for name in ("layers", "channels", "heads"):
            value = getattr(self, name)
            if not isinstance(value, int) or value < 0:
                raise InputError(f"policy {name} is {value!r}; give a positive number, or 0 for the default")
        if self.custom and (self.layers or self.channels or self.heads):
            raise InputError(f"sizes of {self.kind} are its own; give them as options")
        if self.options and not (self.custom and isinstance(self.options, Mapping) and _is_json(dict(self.options))):
            raise InputError("options of a policy are JSON values by name, for a class of your own alone; change them")
        sizes = self.resolved()
        if self.kind in ("transformer", "local", "gat") and sizes.channels % sizes.heads:
            raise InputError(
                f"policy channels {sizes.channels} do not divide among {sizes.heads} heads; choose a multiple"
            )

    def resolved(self) -> PolicySettings:
        """Return the settings with every 0 replaced by the default of the kind."""
        values = asdict(self)
        for name, default in _DEFAULTS.get(self.kind, {}).items():
            values[name] = values[name] or default
        made = object.__new__(PolicySettings)
        for name, value in values.items():
            object.__setattr__(made, name, value)
        return made

    @property
    def custom(self) -> bool:
        """Whether the network is of a class that is no part of this package."""
        return self.kind not in get_args(Kind)

    @property
    def transfers(self) -> bool:
        """Whether the weights are known to fit any structure."""
        return self.kind in ("transformer", "local", "gat")


def _is_json(value: dict[str, Any]) -> bool:
    """Return whether a value comes back from JSON as it was."""
    try:
        return json.loads(json.dumps(value, allow_nan=False)) == value
    except (TypeError, ValueError):
        return False


def recommended(parts: int, *, goal_conditioned: bool = False, kind: str | None = None) -> PolicySettings:
    """Return the settings of the network with the highest success after a given training time.

    For few parts that is the fastest network, since the number of rollouts decides. States of more parts are too many
    to memorise: a network that describes parts by their contacts then generalises to unseen ones. It is a small one
    without goals, since rollouts still count; there are far more pairs than states.

    Args:
        goal_conditioned: whether the policy is conditioned on a goal.
        kind: kind of the network, if it is chosen already.
    """
    large = parts > _FEW
    usual = kind or ("transformer" if large else "resmlp")
    if usual == "transformer" and large and not goal_conditioned:
        return PolicySettings(usual, layers=3, channels=64, heads=4)
    return PolicySettings(usual, goal_conditioned=goal_conditioned)
