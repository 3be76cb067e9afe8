"""Torch imports on demand, and integer arithmetic on tensors that gives the same bits on every device."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import numpy as np

from falsework.errors import DependencyError, InputError
from falsework.utils.lazy import importing

if TYPE_CHECKING:
    import torch


def import_torch() -> Any:
    """Return the module torch."""
    with importing("a search on tensors needs torch; pip install 'falsework[gpu]'"):
        import torch
    return torch


def check_torch() -> None:
    """Look for the packages that learning cannot do without."""
    for name in ("torch", "safetensors"):
        if find_spec(name) is None:
            raise DependencyError(f"learning needs {name}; pip install 'falsework[learn]'")


def choose_device(name: str = "auto") -> torch.device:
    """Return the device of a name such as `auto`, `cpu`, `cuda` or `cuda:1`; `auto` is a GPU if there is one."""
    torch = import_torch()
    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if name == "auto":
        return torch.device("cuda", torch.cuda.current_device()) if count else torch.device("cpu")
    try:
        device = torch.device(name)
    except RuntimeError:
        raise InputError(f"unknown device {name!r}; choose auto, cpu or cuda") from None
    if device.type == "cpu":
        return device
    if device.type != "cuda":
        raise InputError(f"device {name!r} is not supported; choose auto, cpu or cuda")
    if (device.index or 0) >= count:
        raise InputError(f"device {name!r} is not available: {count} CUDA devices were found; choose auto or cpu")
    return torch.device("cuda", torch.cuda.current_device()) if device.index is None else device


def put(array: np.ndarray, device: torch.device) -> torch.Tensor:
    """Copy an array to a device; unsigned 64-bit words keep their bits as signed ones."""
    if array.dtype == np.uint64:
        array = array.view(np.int64)
    return import_torch().from_numpy(np.array(array)).to(device)


def mix(keys: torch.Tensor, salt: int) -> torch.Tensor:
    """Return random words that depend on nothing but each key and the salt: the finaliser of SplitMix64.

    A state's random numbers are made from its hash, not drawn in turn, so that they are the same wherever the state
    stands in a list and whichever process examines it.

    Args:
        keys: int64, any shape.
        salt: any integer.

    Returns:
        int64, all 64 bits random, same shape.
    """
    words = keys ^ _signed(_mix_integer(salt))
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
        words = (words ^ _shifted(words, shift)) * _signed(factor)
    return words ^ _shifted(words, 31)


def uniform(words: torch.Tensor) -> torch.Tensor:
    """Return numbers strictly between 0 and 1 from random words, float64; exact, so the same on every device."""
    return (_shifted(words, 12).double() + 0.5) * 2.0**-52


def place_in_group(groups: torch.Tensor) -> torch.Tensor:
    """Return the index of each entry in its group, from 0; groups are contiguous. Shape of `groups`."""
    torch = import_torch()
    place = torch.arange(len(groups), device=groups.device)
    begins = torch.ones_like(groups, dtype=torch.bool)
    begins[1:] = groups[1:] != groups[:-1]
    return place - torch.cummax(torch.where(begins, place, 0), dim=0).values


def in_sorted(ordered: torch.Tensor, words: torch.Tensor) -> torch.Tensor:
    """Return whether words are in an ascending list; no size leaves the device. Shape of `words`."""
    torch = import_torch()
    if len(ordered) == 0:
        return torch.zeros_like(words, dtype=torch.bool)
    slot = torch.searchsorted(ordered, words).clamp_(max=len(ordered) - 1)
    return ordered[slot] == words


def _mix_integer(salt: int) -> int:
    word = (salt + 0x9E3779B97F4A7C15) % 2**64
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
        word = (word ^ (word >> shift)) * factor % 2**64
    return word ^ (word >> 31)


def _signed(word: int) -> int:
    return word - 2**64 if word >= 2**63 else word


def _shifted(words: torch.Tensor, bits: int) -> torch.Tensor:
    """Shift to the right, filling with zeros."""
    return (words >> bits) & ((1 << (64 - bits)) - 1)


def below(prefix: str, values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values under names that begin with a prefix, with the prefix taken off."""
    return {name[len(prefix) :]: value for name, value in values.items() if name.startswith(prefix)}
