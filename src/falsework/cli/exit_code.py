"""Exit codes of the command line."""

from __future__ import annotations

from enum import IntEnum


class Exit(IntEnum):
    """Exit codes; scripts rely on them."""

    DONE = 0
    NO = 1
    """The input is valid and the answer is no."""
    WRONG_INPUT = 2
    CONDITIONAL = 3
    """The answer is yes on conditions that the input sets itself and that the command line does not repeat."""
    NO_MEMORY = 4
    """There is too little memory for an answer."""
    INTERRUPTED = 130
    """As shells report it: 128 plus the number of SIGINT."""
