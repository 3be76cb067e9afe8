"""Tasks of a symmetric structure, turned and reflected: what was found on one side holds on all others."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from falsework.assembly.state import States
from falsework.learn.data.random_walks import TaskSource
from falsework.search.device.rules import hash_states
from falsework.search.problem.hashing import StateHash
from falsework.utils.tensors import in_sorted, put


class TurnedTasks:
    """Tasks of another source under symmetries drawn at random; a `TaskSource`."""

    def __init__(
        self, tasks: TaskSource, images: NDArray[np.intp], *, device: torch.device, forbidden: States | None = None
    ) -> None:
        """Put the symmetries on a device.

        Args:
            tasks: what is turned.
            images: as of `falsework.assembly.symmetry.symmetries`, shape (symmetries, parts).
            device: where tasks are drawn.
            forbidden: states that no task may begin or end with; what would is left as it was. Shape (count, parts).
        """
        parts = images.shape[1]
        self._tasks = tasks
        self._images = put(np.asarray(images, dtype=np.int64), device)
        self._words = put(StateHash.for_parts(parts).words, device)
        none = torch.empty((0, parts), dtype=torch.uint8, device=device)
        kept = none if forbidden is None else put(np.unique(forbidden, axis=0), device)
        self._forbidden = torch.sort(hash_states(kept, self._words)).values

    def draw(self, count: int, generator: torch.Generator) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """As `TaskSource`."""
        drawn = self._tasks.draw(count, generator)
        which = torch.randint(len(self._images), (count,), generator=generator, device=self._images.device)
        image = self._images[which]
        both = torch.cat([image, image + image.shape[1]], dim=1)
        turned = [
            torch.empty_like(one).scatter_(1, index, one)
            for one, index in zip(drawn, (image, image, both), strict=True)
        ]
        taboo = self._is_forbidden(turned[0]) | self._is_forbidden(turned[1])
        states, targets, valid = (
            torch.where(taboo[:, None], one, other) for one, other in zip(drawn, turned, strict=True)
        )
        return states, targets, valid

    def _is_forbidden(self, states: torch.Tensor) -> torch.Tensor:
        return in_sorted(self._forbidden, hash_states(states, self._words))
