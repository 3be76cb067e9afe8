"""Kernels: functions that run as machine code, without the interpreter's lock.

A kernel is written for numba. Those that every plan needs come with the package as portable code (`kernel_code.py`),
which takes LLVM a few seconds to compile; numba, which takes two minutes from the source, is then not even imported.
It compiles all other kernels, and these too where their portable code does not fit: after a change of the source, for
arguments of other types, or on a machine without 64-bit little-endian words.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from struct import Struct
from typing import Any

import numpy as np

from falsework.utils import kernel_code
from falsework.utils.cache_folder import warn_of_no_cache

Flat = tuple[str, list[Any]]


class Kernel:
    """A function for numba. Attributes that numba asks of a compiled function are those of the dispatcher."""

    def __init__(self, function: Callable[..., Any], options: dict[str, Any]) -> None:
        self.py_func = function
        self.options = options
        self.__doc__ = function.__doc__
        self.__name__ = function.__name__
        self.__module__ = function.__module__
        self._flat: dict[int, tuple[tuple[Any, ...], Flat]] = {}

    def __call__(self, *arguments: Any) -> Any:
        """Run the kernel; what portable code returns is an integer, 0 for nothing."""
        if self._portable is not None:
            kinds, run, layout = self._portable
            flat = [self._flatten(place, argument) for place, argument in enumerate(arguments)]
            if [kind for kind, _ in flat] == kinds:
                return run(layout.pack(*(value for _, values in flat for value in values)))
        return self.dispatcher(*arguments)

    @cached_property
    def dispatcher(self) -> Any:
        """The function as numba compiles it."""
        from numba import njit

        try:
            return njit(**self.options)(self.py_func)
        except RuntimeError:  # numba has found no folder that it can write
            warn_of_no_cache(str(Path(self.py_func.__code__.co_filename).parent))
            return njit(**{**self.options, "cache": False})(self.py_func)

    @property
    def targetoptions(self) -> dict[str, Any]:
        """Options by which numba decides whether to inline the function."""
        return self.dispatcher.targetoptions

    @property
    def _numba_type_(self) -> Any:
        return self.dispatcher._numba_type_

    @cached_property
    def _portable(self) -> tuple[list[str], Callable[[bytes], int], Struct] | None:
        """Kinds of arguments, machine code and layout of arguments, where the portable code fits the source."""
        found = kernel_code.load(self.__module__, self.__name__)
        return found and (found.kinds, found.run, Struct("=" + "".join(map(letters, "".join(found.kinds).split()))))

    def _flatten(self, place: int, argument: Any) -> Flat:
        """Return kinds and words of an argument; those of a tuple, which seldom changes, from the last call."""
        if not isinstance(argument, tuple):
            return flatten(argument)
        known = self._flat.get(place)
        if known is None or known[0] is not argument:
            known = self._flat[place] = argument, flatten(argument)
        return known[1]


def flatten(argument: Any) -> Flat:
    """Return kinds of the leaves of an argument, each followed by a space, and their words as numba passes them.

    An array is its owner, its parent (none of both here), size, size of an item, address, shape and strides.
    """
    if isinstance(argument, np.ndarray):
        flags = argument.flags
        layout = "" if flags.c_contiguous else "?"
        address = argument.__array_interface__["data"][0]
        words = [0, 0, argument.size, argument.itemsize, address, *argument.shape, *argument.strides]
        return f"{argument.dtype.str}{layout}[{argument.ndim}] ", words
    if isinstance(argument, tuple):
        leaves = [flatten(leaf) for leaf in argument]
        return "".join(kind for kind, _ in leaves), [word for _, words in leaves for word in words]
    return ("float " if isinstance(argument, float) else "int "), [argument]


def letters(kind: str) -> str:
    """Return the words of a kind as `struct` has them."""
    return "d" if kind == "float" else "q" if kind == "int" else "q" * (5 + 2 * int(kind[-2]))


def njit(**options: Any) -> Callable[[Callable[..., Any]], Kernel]:
    """Make a kernel of a function; options as those of `numba.njit`."""
    return lambda function: Kernel(function, options)
