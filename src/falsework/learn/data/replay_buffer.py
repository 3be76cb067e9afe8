"""Replay buffer: a ring of rows in columns on one device."""

from __future__ import annotations

import torch


class Memory:
    """The last so many rows of several columns, on one device; old ones are overwritten in turn."""

    def __init__(self, capacity: int, columns: dict[str, torch.Tensor]) -> None:
        """Begin empty.

        Args:
            capacity: rows kept.
            columns: for each name one example row with the right type and device.
        """
        self.capacity = capacity
        self._columns = {
            name: torch.zeros((capacity, *row.shape), dtype=row.dtype, device=row.device)
            for name, row in columns.items()
        }
        self._written = 0

    def __len__(self) -> int:
        return min(self._written, self.capacity)

    def add(self, **columns: torch.Tensor) -> None:
        """Write rows, each column of shape (count, ...)."""
        count = len(next(iter(columns.values())))
        count, skipped = min(count, self.capacity), max(count - self.capacity, 0)
        if count == 0:
            return
        device = next(iter(self._columns.values())).device
        place = (torch.arange(count, device=device) + self._written + skipped) % self.capacity
        for name, rows in columns.items():
            self._columns[name][place] = rows[skipped:]
        self._written += count + skipped

    def draw(self, count: int, generator: torch.Generator) -> dict[str, torch.Tensor]:
        """Rows drawn evenly, with repetition; only if there are any."""
        device = next(iter(self._columns.values())).device
        rows = torch.randint(len(self), (count,), generator=generator, device=device)
        return {name: column[rows] for name, column in self._columns.items()}

    def tensors(self) -> dict[str, torch.Tensor]:
        """All that there is to save, for `load`."""
        kept = {name: column[: len(self)] for name, column in self._columns.items()}
        return {**kept, "written": torch.tensor([self._written])}

    def load(self, tensors: dict[str, torch.Tensor]) -> None:
        """Go back to what `tensors` gave."""
        self._written = int(tensors["written"][0])
        for name, column in self._columns.items():
            column[: len(self)] = tensors[name].to(column.device)
