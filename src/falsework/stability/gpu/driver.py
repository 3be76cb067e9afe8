"""CUDA driver: compilation for the present device, device arrays, and launches on torch's current stream."""

from __future__ import annotations

import ctypes
import hashlib
from collections.abc import Sequence
from functools import lru_cache
from importlib import import_module, resources
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from falsework.errors import InputError, SolverError
from falsework.utils.cache.folder import read_cache, write_cache
from falsework.utils.lazy import importing

SOURCES = [
    f"{name}.cuh"
    for name in (
        *("common", "cones", "state", "contacts", "matrix", "judge", "admm", "interior_point", "interior", "lu"),
        *("newton", "contact", "kernels"),
    )
]
KERNELS = [f"{method}_{memory}" for method in ("admm", "interior", "contact") for memory in ("shared", "scratch")]
"""Kernels of the source, in the order of its `PART`s: each is compiled when it is first needed."""


def kernel_source() -> str:
    """Return the whole source: C++17, for NVRTC or, with one thread a block, for any other compiler."""
    folder = resources.files("falsework.stability.gpu.kernels")
    return "".join(f'#line 1 "{name}"\n{folder.joinpath(name).read_text(encoding="utf-8")}' for name in SOURCES)


class CudaDriver:
    """CUDA device driver: torch for memory and streams, NVIDIA's `cuda-bindings` for compiling and launching.

    The tests run the same kernel on the CPU behind the same methods.
    """

    multiprocessors: int
    shared_limit: int
    """Largest shared memory of a block, bytes."""
    most_threads: int
    """Largest number of threads of a block."""

    def __init__(self, defines: dict[str, int], device: str) -> None:
        with importing("the GPU solver needs torch; pip install 'falsework[gpu]'"):
            import torch
        with importing("the GPU solver needs cuda-bindings; pip install 'falsework[gpu]'"):
            self._cuda = _bindings("driver")
        if not torch.cuda.is_available():
            raise InputError("no CUDA device was found; use solver='cpu'")
        self.device = torch.device(device)
        if self.device.type != "cuda" or (self.device.index or 0) >= torch.cuda.device_count():
            raise InputError(f"device is {device!r}; choose cuda or cuda:0 to cuda:{torch.cuda.device_count() - 1}")
        if self.device.index is None:
            self.device = torch.device("cuda", torch.cuda.current_device())
        self._torch = torch
        properties = torch.cuda.get_device_properties(self.device)
        self.multiprocessors = properties.multi_processor_count
        self.shared_limit = getattr(properties, "shared_memory_per_block_optin", 48 * 1024)
        self.most_threads = 256  # as compiled
        self._architecture = properties.major, properties.minor
        self._defines = defines
        self._functions: dict[str, Any] = {}
        self._shared: dict[str, int] = {}

    def put(self, array: NDArray) -> Any:
        """Return a copy of an array on the device."""
        return self._torch.from_numpy(np.require(array, requirements=["C", "W"])).to(self.device)

    def empty(self, shape: tuple[int, ...], dtype: DTypeLike) -> Any:
        """Return an uninitialised array on the device."""
        return self._torch.empty(shape, dtype=self._type(dtype), device=self.device)

    def zeros(self, shape: tuple[int, ...], dtype: DTypeLike) -> Any:
        """Return an array of zeros on the device."""
        return self._torch.zeros(shape, dtype=self._type(dtype), device=self.device)

    def get(self, array: Any) -> NDArray:
        """Return a copy of a device array on the host."""
        return array.cpu().numpy()

    def address(self, array: Any) -> int:
        """Return the address of a device array."""
        if array.device != self.device or not array.is_contiguous():
            raise InputError(f"an array on {array.device} cannot be used; give a contiguous one on {self.device}")
        return array.data_ptr()

    def blocks(self, kernel: str, threads: int, shared: int) -> int:
        """Return the number of blocks of a kernel that the device can hold at a time."""
        function = self._function(kernel, shared)
        each = _ask(self._cuda.cuOccupancyMaxActiveBlocksPerMultiprocessor(function, threads, shared))
        return self.multiprocessors * max(each, 1)

    def launch(
        self, kernel: str, blocks: int, threads: int, shared: int, arguments: Sequence[ctypes.Structure]
    ) -> None:
        """Queue a kernel on torch's current stream of the device."""
        function = self._function(kernel, shared)
        pointers = (ctypes.c_void_p * len(arguments))(*(ctypes.addressof(argument) for argument in arguments))
        stream = self._torch.cuda.current_stream(self.device).cuda_stream
        with self._torch.cuda.device(self.device):
            _ask(
                self._cuda.cuLaunchKernel(
                    function, blocks, 1, 1, threads, 1, 1, shared, stream, ctypes.addressof(pointers), 0
                )
            )

    def _type(self, dtype: DTypeLike) -> Any:
        return getattr(self._torch, np.dtype(dtype).name)

    def _function(self, kernel: str, shared: int) -> Any:
        """Return a kernel that may use this much shared memory, compiled and loaded at first use."""
        if kernel not in self._functions:
            defines = {**self._defines, "PART": KERNELS.index(kernel)}
            code = compile_kernel(*self._architecture, tuple(sorted(defines.items())))
            with self._torch.cuda.device(self.device):
                self._torch.cuda.current_stream().synchronize()  # makes torch's context current
                module = _ask(self._cuda.cuModuleLoadData(code))
            self._functions[kernel] = _ask(self._cuda.cuModuleGetFunction(module, kernel.encode()))
        function = self._functions[kernel]
        if shared > self._shared.get(kernel, 0):
            attribute = self._cuda.CUfunction_attribute.CU_FUNC_ATTRIBUTE_MAX_DYNAMIC_SHARED_SIZE_BYTES
            _ask(self._cuda.cuFuncSetAttribute(function, attribute, shared))
            self._shared[kernel] = shared
        return function


@lru_cache(maxsize=32)
def compile_kernel(major: int, minor: int, defines: tuple[tuple[str, int], ...]) -> bytes:
    """Return the machine code of a kernel for one architecture and one set of compile-time constants, cached on disk.

    Raises:
        SolverError: the compiler rejected the source.
    """
    nvrtc = _bindings("nvrtc")
    options = [f"--gpu-architecture=sm_{major}{minor}", "--std=c++17", "--fmad=true"]
    options += [f"-D{name}={value}" for name, value in defines]
    encoded = [option.encode() for option in options]
    name = f"{_identity(options, nvrtc)}.cubin"
    kept = read_cache(name)
    if kept is not None:
        return kept
    program = _ask(nvrtc.nvrtcCreateProgram(kernel_source().encode(), b"falsework", 0, [], []))
    (status,) = nvrtc.nvrtcCompileProgram(program, len(encoded), encoded)
    if status != nvrtc.nvrtcResult.NVRTC_SUCCESS:
        log = b" " * _ask(nvrtc.nvrtcGetProgramLogSize(program))
        _ask(nvrtc.nvrtcGetProgramLog(program, log))
        raise SolverError(f"the GPU kernel does not compile for sm_{major}{minor}: {log.decode(errors='replace')}")
    code = b" " * _ask(nvrtc.nvrtcGetCUBINSize(program))
    _ask(nvrtc.nvrtcGetCUBIN(program, code))
    _ask(nvrtc.nvrtcDestroyProgram(program))
    write_cache(name, code)
    return code


def _identity(options: list[str], nvrtc: Any) -> str:
    """Return the digest of everything that the machine code depends on."""
    text = "\n".join([kernel_source(), *options, str(nvrtc.nvrtcVersion()[1:])])
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def _bindings(name: str) -> Any:
    """Return a module of NVIDIA's bindings, which have no type information."""
    return import_module(f"cuda.bindings.{name}")


def _ask(answer: tuple) -> Any:
    """Return the result of a driver call; raise an error with its name if it failed."""
    status, *result = answer
    if int(status) != 0:
        raise SolverError(f"CUDA returned {status.name}; update the driver, or use solver='cpu'")
    return result[0] if result else None
