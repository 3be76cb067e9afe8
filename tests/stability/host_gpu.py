"""The GPU's kernel as plain C++ on the processor: one thread a block, so that every phase runs in sequence."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import tempfile
from functools import lru_cache
from importlib import resources
from pathlib import Path

import numpy as np

from falsework.stability.gpu_driver import KERNEL_SOURCE

COMPILER = shutil.which("g++") or shutil.which("clang++")


@lru_cache
def _library(defines: tuple[tuple[str, int], ...]) -> ctypes.CDLL:
    assert COMPILER is not None
    source = resources.files("falsework.stability").joinpath(KERNEL_SOURCE)
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "kernel.so"
        command = [COMPILER, "-x", "c++", "-std=c++17", "-O2", "-shared", "-fPIC", "-o", str(out)]
        command += [f"-D{name}={value}" for name, value in defines] + [str(source)]
        subprocess.run(command, check=True, capture_output=True)
        return ctypes.CDLL(str(out))


class HostDriver:
    """`Driver` on the processor."""

    def __init__(self, shared_limit: int = 227 * 1024, memory: int | None = None, **defines: int) -> None:
        self.multiprocessors = 1
        self.shared_limit = shared_limit
        self.most_threads = 1
        self.memory = memory
        self.launched: list[str] = []
        self._library = _library(tuple(sorted(defines.items())))

    def put(self, array):
        return np.array(array, order="C")

    def empty(self, shape, dtype):
        size = int(np.prod(shape)) * np.dtype(dtype).itemsize
        if self.memory is not None and size > self.memory:
            raise RuntimeError("CUDA out of memory")
        return np.full(shape, 77, dtype=dtype)  # poison: what is not written must not be read

    def zeros(self, shape, dtype):
        return np.zeros(shape, dtype=dtype)

    def get(self, array):
        return array

    def address(self, array):
        return array.ctypes.data

    def blocks(self, kernel, threads, shared):
        return 1

    def launch(self, kernel, blocks, threads, shared, arguments):
        assert blocks == 1
        self.launched.append(kernel)
        function = getattr(self._library, kernel)
        function.argtypes = [type(argument) for argument in arguments]
        function.restype = None
        function(*arguments)
