"""Guard that stops training at the first non-finite loss and saves the batch that caused it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import torch

from falsework.errors import TrainingError
from falsework.utils.files.output_file import write_whole


class NanGuard:
    """Check of every step for a finite loss, one step late, so that the host never waits for the device.

    A step that is not finite must not be taken: give the optimizer `found_inf`, or call the guard before it.
    """

    def __init__(self, folder: Path | str | None = None, *, rank: int = 0) -> None:
        """Save failing batches in `folder`; nowhere if None. Processes need different ranks."""
        self._folder = None if folder is None else Path(folder)
        self._rank = rank
        self._pending: tuple[torch.Tensor, torch.cuda.Event | None, Mapping[str, torch.Tensor], str] | None = None

    def watch(self, value: torch.Tensor, batch: Mapping[str, torch.Tensor], step: str) -> None:
        """Check the last step, and store this one.

        Args:
            value: loss or norm of the gradient of this step, any shape.
            batch: its input; must not change until the next call.
            step: where this is, such as `step 12`; part of the file name.

        Raises:
            TrainingError: the last step was not finite.
        """
        self.check()
        finite = torch.isfinite(value.detach()).all()
        event = None
        if finite.is_cuda:
            finite = finite.to("cpu", non_blocking=True)
            event = torch.cuda.Event()
            event.record()
        self._pending = (finite, event, batch, step)

    def check(self) -> None:
        """Check the last step now, for instance at the end of an update.

        Raises:
            TrainingError: it was not finite.
        """
        if self._pending is None:
            return
        finite, event, batch, step = self._pending
        self._pending = None
        if event is not None:
            event.synchronize()
        if bool(finite):
            return
        raise TrainingError(
            f"the loss is not a finite number at {step}{self._save(batch, step)}; "
            "continue from the last checkpoint with a lower learning rate"
        )

    def _save(self, batch: Mapping[str, torch.Tensor], step: str) -> str:
        """Write the batch, and return where it is."""
        if self._folder is None:
            return ""
        from safetensors.torch import save

        name = "-".join(["not-finite", *step.split(), *([str(self._rank)] if self._rank else [])])
        path = self._folder / f"{name}.safetensors"
        tensors = {name: tensor.detach().cpu().clone().contiguous() for name, tensor in batch.items()}
        content = save(tensors, {"format": "falsework.batch/1", "step": json.dumps(step)})
        try:
            write_whole(path, lambda file: file.write(content))
        except (OSError, ValueError) as error:  # only the first failure matters
            return f" (its batch could not be saved: {error})"
        return f"; the batch that caused it is in {path}"
