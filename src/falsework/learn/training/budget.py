"""Budget of a training run: in steps, which depends on the seed alone, or in minutes."""

from __future__ import annotations

import contextlib
import signal
import threading
import time
from collections.abc import Iterator
from typing import Any

import torch

from falsework.utils.collectives import decided, summed
from falsework.utils.distributed import ProcessGroup

_LONGEST = 0.05
"""Share of a run that one block may take."""
_FIRST_BLOCK = 10
"""Times shorter than others the first block is, because the step time is not known yet."""


class TrainingBudget:
    """Progress between 0 and 1, alike in all processes; survives interruptions."""

    def __init__(
        self,
        *,
        minutes: float,
        steps: int,
        shards: ProcessGroup = ProcessGroup(),
        device: torch.device = torch.device("cpu"),
    ) -> None:
        """Start the clock.

        Args:
            minutes: time for everything, unless `steps` says how many.
            steps: steps of the optimizer in place of a time.
            shards: processes, of which the first has the clock.
            device: for exchanged tensors.
        """
        self.before = 0.0
        """Seconds spent in earlier sessions of this run."""
        self.stopped = False
        """A signal has asked this process to stop."""
        self._budget, self._steps = 60.0 * minutes, steps
        self._shards, self._device = shards, device
        self._begun = time.perf_counter()
        self._last, self._slope, self._took = 0.0, 0.0, 0

    @property
    def seconds(self) -> float:
        """Seconds spent on this run so far, earlier sessions included; by the clock of this process."""
        return self.before + time.perf_counter() - self._begun

    def progress(self, steps: int) -> float:
        """Return the share of the run that is done after so many steps."""
        if self._steps:
            return min(steps / self._steps, 1.0)
        return self.share(self.seconds)

    def share(self, seconds: float) -> float:
        """Return the share of the run that some seconds are; 0 if steps are counted."""
        return 0.0 if self._steps else min(decided(seconds, self._shards, self._device) / self._budget, 1.0)

    def next_block(self, steps: int, block: int) -> tuple[int, tuple[float, float]]:
        """Return the number of the next steps, and the progress before and after them as predicted from the last ones.

        By the clock there are fewer than `block` where these would take long, so that the end is not overrun by much.
        """
        now = self.progress(steps)
        if self._steps:
            block = min(block, self._steps - steps)
            return block, (now, (steps + block) / self._steps)
        if self._took:
            self._slope = max(now - self._last, 0.0) / self._took
        longest = min(_LONGEST, max(1.0 - now, 0.0)) / self._slope if self._slope else block / _FIRST_BLOCK
        took = max(min(block, int(longest)), 1)
        self._last, self._took = now, took
        return took, (now, min(now + self._slope * took, 1.0))

    def stop_requested(self) -> bool:
        """Return whether to stop here, in all processes if in any."""
        return summed([float(self.stopped)], self._shards, self._device)[0] > 0

    def state_dict(self) -> dict[str, float]:
        """Return the state for a checkpoint."""
        return {"seconds": self.seconds, "slope": self._slope}

    def load_state_dict(self, state: dict[str, float]) -> None:
        """Restore the state after an interruption."""
        self.before = float(state["seconds"])
        self._begun = time.perf_counter()
        self._last, self._slope, self._took = 0.0, float(state["slope"]), 0

    @contextlib.contextmanager
    def interruptible(self) -> Iterator[None]:
        """Let the first SIGINT or SIGTERM ask for a stop in good order; a second one has its default effect."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        before: dict[int, Any] = {}

        def ask(number: int, frame: Any) -> None:
            self.stopped = True
            signal.signal(number, before[number])

        for number in (signal.SIGINT, signal.SIGTERM):
            before[number] = signal.signal(number, ask)
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)
