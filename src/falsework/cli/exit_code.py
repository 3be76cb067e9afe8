"""Exit codes of the command line."""

from __future__ import annotations

from enum import IntEnum


class Exit(IntEnum):
    """Exit codes; scripts rely on them."""

    DONE = 0
    NO = 1
    """The input is valid and the answer is no."""
    WRONG_INPUT = 2
    NO_MEMORY = 4
    """There is too little memory for an answer."""
    INTERRUPTED = 130
    """As shells report it: 128 plus the number of SIGINT."""
