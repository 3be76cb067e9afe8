"""Kernels: functions that run as machine code, without the interpreter's lock.

A kernel is written for numba. Those that plans need come with the package as portable code (`kernel_code.py`), which
takes LLVM a few seconds to compile; numba, which takes more than a minute from the source, is then not even imported.
It compiles all other kernels, and these too where no portable code fits: where it was not made, after a change of the
source, for arguments of other types, or on a machine without 64-bit little-endian words.
"""

from __future__ import annotations

from collections.abc import Callable
from ctypes import addressof, c_char
from functools import cache, cached_property
from pathlib import Path
from struct import Struct
from typing import Any

import numpy as np

from falsework.utils import kernel_code
from falsework.utils.cache.folder import warn_of_no_cache

Flat = tuple[str, bytes]
_ARRAYS = [Struct(f"={5 + 2 * dimensions}q") for dimensions in range(5)]
_INTEGER, _FLOAT = Struct("=q"), Struct("=d")
_first_byte: Callable[[Any], c_char] = c_char.from_buffer
_REMEMBERED = 128
"""Tuples of a kernel whose words are kept: those of the arms of a cell, say, which take turns."""


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
            flat = [
                self._flatten_tuple(argument) if isinstance(argument, tuple) else flatten(argument)
                for argument in arguments
            ]
            if [kind for kind, _ in flat] == self._portable.kinds:
                return self._portable.run(b"".join([words for _, words in flat]))
        return self.dispatcher(*arguments)

    @cached_property
    def dispatcher(self) -> Any:
        """The function as numba compiles it."""
        import numba

        from falsework.utils.cache.compilation import announce_compilation
        from falsework.utils.cache.kernel_sources import callees, sources
        from falsework.utils.cache.numba_files import SealedCacheFile

        announce_compilation()
        compiler: Any = numba.njit
        try:
            compiled = compiler(**self.options)(self.py_func)
            SealedCacheFile.replace_in(compiled, lambda: kernel_code.digest(sources(callees(self))))
            return compiled
        except RuntimeError:  # numba has found no folder that it can write
            warn_of_no_cache(str(Path(self.py_func.__code__.co_filename).parent))
            return compiler(**{**self.options, "cache": False})(self.py_func)

    @property
    def targetoptions(self) -> dict[str, Any]:
        """Options by which numba decides whether to inline the function."""
        return self.dispatcher.targetoptions

    @property
    def _numba_type_(self) -> Any:
        return self.dispatcher._numba_type_

    @cached_property
    def _portable(self) -> kernel_code.Code | None:
        """Machine code, where the portable code fits the source."""
        return kernel_code.ARCHIVE.load(self.__module__, self.__name__)

    def _flatten_tuple(self, argument: tuple[Any, ...]) -> Flat:
        """Return kinds and words of a tuple, which seldom changes, from an earlier call."""
        known = self._flat.get(id(argument))
        if known is None:
            if len(self._flat) >= _REMEMBERED:
                self._flat.clear()
            # The tuple is kept too: as long as it exists, no other one has its number.
            known = self._flat[id(argument)] = argument, flatten(argument)
        return known[1]


def flatten(argument: Any) -> Flat:
    """Return kinds of the leaves of an argument, each followed by a space, and their words as numba passes them.

    An array is its owner, its parent (none of both here), size, size of an item, address, shape and strides.
    """
    if isinstance(argument, np.ndarray):
        shape, size = argument.shape, argument.size
        if not size:
            address = 0  # never read
        else:
            try:
                address = addressof(_first_byte(argument))
            except (TypeError, ValueError):  # slower: what cannot be written or is not contiguous
                address = argument.__array_interface__["data"][0]
        words = _ARRAYS[len(shape)].pack(0, 0, size, argument.itemsize, address, *shape, *argument.strides)
        return _array_kind(argument.dtype, len(shape), argument.flags.c_contiguous), words
    if isinstance(argument, tuple):
        leaves = [flatten(leaf) for leaf in argument]
        return "".join([kind for kind, _ in leaves]), b"".join([words for _, words in leaves])
    return ("float ", _FLOAT.pack(argument)) if isinstance(argument, float) else ("int ", _INTEGER.pack(argument))


@cache
def _array_kind(dtype: np.dtype, dimensions: int, contiguous: bool) -> str:
    return f"{dtype.str}{'' if contiguous else '?'}[{dimensions}] "


def njit(**options: Any) -> Callable[[Callable[..., Any]], Kernel]:
    """Make a kernel of a function; options as those of `numba.njit`."""
    return lambda function: Kernel(function, options)
