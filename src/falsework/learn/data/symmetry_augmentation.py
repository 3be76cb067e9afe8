"""Symmetry augmentation: states and tasks of a symmetric structure, rotated and reflected."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from falsework.assembly.state import States
from falsework.learn.data.random_walks import GoalSampler
from falsework.search.device.rules import hash_states
from falsework.search.problem.hashing import StateHash, merge
from falsework.utils.tensors import in_sorted, put


def symmetric_images(states: States, images: NDArray[np.intp]) -> States:
    """Return states and their images under all symmetries of the structure, each once.

    A policy that has learned from an image of a state has learned from the state, so test states are held out with
    their images.

    Args:
        states: shape (count, parts).
        images: as of `falsework.learn.data.symmetry.symmetries`, shape (symmetries, parts).

    Returns:
        Shape (images, parts).
    """
    whole = np.empty((len(images), *states.shape), dtype=states.dtype)
    for number, image in enumerate(images):
        whole[number][:, image] = states
    every = whole.reshape(-1, states.shape[1])
    return every[merge(StateHash.for_parts(states.shape[1])(every), lambda rows: every[rows])[0]]


def turned_states(states: torch.Tensor, images: NDArray[np.intp], most: int) -> torch.Tensor:
    """Return states, then their images under as many symmetries of the structure as `most` allows.

    Args:
        states: shape (count, parts).
        images: as of `falsework.learn.data.symmetry.symmetries`, the first of which changes nothing, shape
            (symmetries, parts).
        most: number of states.

    Returns:
        Shape (images, parts), on the device of the states.
    """
    whole = [states]
    for image in put(np.asarray(images[1 : most // max(len(states), 1)], dtype=np.int64), states.device):
        turned = torch.empty_like(states)
        turned[:, image] = states
        whole.append(turned)
    return torch.cat(whole)


class SymmetryAugmentation:
    """Sampler of tasks of another sampler under symmetries drawn at random; a `GoalSampler`."""

    def __init__(
        self, tasks: GoalSampler, images: NDArray[np.intp], *, device: torch.device, held_out: States | None = None
    ) -> None:
        """Put the symmetries on a device.

        Args:
            tasks: sampler whose tasks are transformed.
            images: as of `falsework.learn.data.symmetry.symmetries`, shape (symmetries, parts).
            device: where tasks are drawn.
            held_out: states that no task may begin or end with; a task that would is left unchanged. Shape (count,
                parts).
        """
        parts = images.shape[1]
        self._tasks = tasks
        self._images = put(np.asarray(images, dtype=np.int64), device)
        self._words = put(StateHash.for_parts(parts).words, device)
        none = torch.empty((0, parts), dtype=torch.uint8, device=device)
        kept = none if held_out is None else put(np.unique(held_out, axis=0), device)
        self._held_out = torch.sort(hash_states(kept, self._words)).values

    def draw(self, count: int, generator: torch.Generator) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """See `GoalSampler`."""
        drawn = self._tasks.draw(count, generator)
        which = torch.randint(len(self._images), (count,), generator=generator, device=self._images.device)
        image = self._images[which]
        both = torch.cat([image, image + image.shape[1]], dim=1)
        turned = [
            torch.empty_like(one).scatter_(1, index, one)
            for one, index in zip(drawn, (image, image, both), strict=True)
        ]
        held_out = self._is_held_out(turned[0]) | self._is_held_out(turned[1])
        states, targets, valid = (
            torch.where(held_out[:, None], one, other) for one, other in zip(drawn, turned, strict=True)
        )
        return states, targets, valid

    def _is_held_out(self, states: torch.Tensor) -> torch.Tensor:
        return in_sorted(self._held_out, hash_states(states, self._words))
