"""Policies that users write: any module that maps states to logits and values.

The protocol: a `torch.nn.Module`, called as `policy(states, targets=None)` with states and targets of type `uint8` and
shape (batch, parts), returns logits of shape (batch, 2 parts), where `i` holds part `i` and `parts + i` removes it, and
values in [-1, 1] of shape (batch,), the expected sum of the rewards to come. Illegal actions are masked by the caller.
A class that is to be made anew, as when a run is loaded, is called with the assembly and its options. An attribute
`goal_conditioned = True` says that targets count; a policy without it is never given any.
"""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from copy import deepcopy
from functools import partial
from typing import Any

import torch
from torch import nn

from falsework.assembly.model import Assembly
from falsework.errors import InputError
from falsework.learn.config.import_path import import_by_path, import_path_of
from falsework.learn.config.policy import PolicySettings
from falsework.utils.quantity import format_quantity

PolicyOrClass = nn.Module | type[nn.Module] | partial[nn.Module]
"""A module, or a class that is called with the assembly, alone or as a `functools.partial` with its options."""


def settings_of_custom(policy: PolicyOrClass) -> PolicySettings:
    """Return the settings that name a policy: its import path, and the options of a partial.

    Raises:
        InputError: neither a module nor a class of modules, or options that JSON does not know.
    """
    options: Mapping[str, Any] = {}
    named: Any = policy
    if isinstance(policy, partial):
        named, options = policy.func, policy.keywords
        if policy.args:
            raise InputError("options of a policy have names; give partial(Class, name=value)")
    if not isinstance(named, nn.Module) and not _is_class(named):
        raise InputError(
            f"a policy is a torch.nn.Module, a class of such or a partial of one, not {str(policy)[:60]}; see "
            "the page on your own network"
        )
    conditioned = bool(getattr(named, "goal_conditioned", False))
    return PolicySettings(import_path_of(named), goal_conditioned=conditioned, options=dict(options))


def make_custom(
    settings: PolicySettings, assembly: Assembly, device: torch.device | str, given: PolicyOrClass | None = None
) -> Any:
    """Make a policy of a class that is no part of this package, with its initial weights.

    Args:
        settings: with its import path and options.
        assembly: structure whose actions it proposes.
        device: where it is to live.
        given: a module, which is copied, or a class, in place of the one that would be imported.

    Raises:
        InputError: the class cannot be imported, is no module, or does not take the options; or the policy breaks the
            protocol.
    """
    if isinstance(given, nn.Module):
        policy = deepcopy(given)
    else:
        kind = given.func if isinstance(given, partial) else given
        kind = import_by_path(settings.kind, "policy") if kind is None else kind
        if not _is_class(kind):
            raise InputError(f"the policy {settings.kind} is no class of torch.nn.Module; name one that is")
        try:
            inspect.signature(kind).bind(assembly, **settings.options)
        except TypeError as error:
            raise InputError(
                f"the policy {settings.kind} cannot be made from an assembly and the options "
                f"{dict(settings.options)} ({error}); give those that it takes as functools.partial(Class, name=value)"
            ) from None
        policy = kind(assembly, **settings.options)
    policy = policy.to(device)
    _check(policy, settings, assembly, torch.device(device))
    return policy


def why_not_again(policy: nn.Module, settings: PolicySettings, assembly: Assembly) -> str:
    """Return why a run could not make a policy anew from its settings alone; empty if it can."""
    try:
        again = make_custom(settings, assembly, "cpu")
    except InputError as error:
        return str(error)
    sizes, others = ({name: one.shape for name, one in of.state_dict().items()} for of in (policy, again))
    return "" if sizes == others else f"{settings.kind} called with the assembly alone has other weights"


def _is_class(value: Any) -> bool:
    return isinstance(value, type) and issubclass(value, nn.Module)


@torch.no_grad()
def _check(policy: nn.Module, settings: PolicySettings, assembly: Assembly, device: torch.device) -> None:
    """Evaluate two states, so that a policy that breaks the protocol is refused before the time is spent."""
    name, parts = settings.kind, assembly.part_count
    if settings.goal_conditioned != bool(getattr(policy, "goal_conditioned", False)):
        raise InputError(f"{name} and the settings differ on goals; set its attribute goal_conditioned alike")
    if not any(weight.requires_grad for weight in policy.parameters()):
        raise InputError(f"{name} has no weights to train; register them as parameters")
    fixed = torch.as_tensor(assembly.boundary.tolist(), device=device)
    states = torch.where(fixed, 2, torch.tensor([[1], [0]], device=device)).to(torch.uint8)
    mode = policy.training
    found = policy.eval()(states, states.flip(0) if settings.goal_conditioned else None)
    policy.train(mode)
    if not (isinstance(found, tuple) and len(found) == 2 and all(isinstance(one, torch.Tensor) for one in found)):
        raise InputError(f"{name} returned {type(found).__name__}; return logits and values, two tensors")
    for what, tensor, shape in (("logits", found[0], (2, 2 * parts)), ("values", found[1], (2,))):
        if tuple(tensor.shape) != shape:
            raise InputError(f"{name} returned {what} of shape {tuple(tensor.shape)} for two states; expected {shape}")
        if not tensor.is_floating_point() or not bool(tensor.isfinite().all()):
            raise InputError(f"{name} returned {what} that are no finite floating-point numbers; check its layers")
    largest = float(found[1].abs().max())
    if largest > 1.0:
        raise InputError(
            f"{name} returned a value of size {format_quantity(largest, 'factor')}; keep values in [-1, 1], for "
            f"instance by tanh"
        )
