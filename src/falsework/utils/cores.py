"""Processor cores that this process may use."""

from __future__ import annotations

import os


def core_count() -> int:
    """Return how many cores this process may use: fewer than the machine has where it is confined to some of them."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
