"""What all tests of this room share."""

from __future__ import annotations

import pytest
import torch


@pytest.fixture(scope="session", autouse=True)
def one_thread() -> None:
    """Networks this small are slower on two threads, and far slower where other work keeps one of them waiting."""
    torch.set_num_threads(1)
