"""Portable code of kernels (LLVM bitcode), compiled for this processor at first use and cached as machine code.

`kernels.zip` in the package holds a file of bitcode for each group of kernels, and `index.json`: for each group its
entries with the kinds of their arguments, and a digest of the sources that it was made of. Building a wheel makes it
(`kernels/`). Bitcode names no processor: LLVM chooses instructions and the width of vectors when it compiles it here.
"""

from __future__ import annotations

import ctypes
import hashlib
import json
import struct
import sys
import zipfile
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from threading import Lock
from typing import Any

from falsework.utils.cache.folder import read_cache, write_cache

PACKAGE = Path(__file__).parents[1]


@dataclass(frozen=True)
class Code:
    """Machine code of a kernel."""

    kinds: list[str]
    """Kinds of its arguments, as `kernels.flatten` names them."""
    run: Callable[[bytes], int]
    """Call with the words of all arguments, without the interpreter's lock."""
    library: Any
    """Engine that owns the code, which is freed with it."""


class Archive:
    """Archive of portable code; without its file, or on a machine that it does not fit, there is none in it."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._loading = Lock()
        self._libraries: dict[str, Any] = {}

    @cached_property
    def index(self) -> dict[str, Any]:
        """What `kernels/archive.py` says of each group."""
        if sys.byteorder != "little" or struct.calcsize("P") != 8 or not self.path.is_file():
            return {}
        with zipfile.ZipFile(self.path) as archive:
            return json.loads(archive.read("index.json"))

    def fits(self, group: str) -> bool:
        """Return whether a group is made of the present sources."""
        return digest(self.index[group]["sources"]) == self.index[group]["digest"]

    def bitcode(self, group: str) -> bytes:
        """Return the portable code of a group."""
        with zipfile.ZipFile(self.path) as archive:
            return archive.read(f"{group}.bc")

    def load(self, module: str, name: str) -> Code | None:
        """Return the machine code of a kernel, compiled if need be; None where there is no portable code that fits."""
        entry = f"{module}.{name}"
        group = next((group for group, content in self.index.items() if entry in content["entries"]), None)
        if group is None:
            return None
        with self._loading:
            if group not in self._libraries:
                self._libraries[group] = self._library(group) if self.fits(group) else None
        library = self._libraries[group]
        if library is None:
            return None
        address = library.get_function_address(entry)
        function = ctypes.CFUNCTYPE(ctypes.c_int32, ctypes.c_char_p, ctypes.POINTER(ctypes.c_int64))(address)

        def run(words: bytes) -> int:
            result = ctypes.c_int64(0)
            if function(words, result) not in (0, -2):  # -2: returns None
                raise RuntimeError(f"{entry} failed: its arguments do not fit together, or there is no memory left")
            return result.value

        return Code(self.index[group]["entries"][entry], run, library)

    def _library(self, group: str) -> Any:
        """Return a group as an engine of LLVM that knows its entries; None where LLVM cannot read it."""
        from llvmlite import binding as llvm

        llvm.initialize_native_target()
        llvm.initialize_native_asmprinter()
        add_symbols(llvm)
        content, machine = self.index[group], target_machine(llvm)
        identity = [content["digest"], content["made"], llvm.llvm_version_info, machine.triple]
        identity += [llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten()]
        name = f"{group}-{hashlib.sha256(repr(identity).encode()).hexdigest()[:24]}.code"
        code = read_cache(name)
        if code is None:
            try:
                code = compile_code(llvm, machine, self.bitcode(group))
            except RuntimeError:  # of a later LLVM than that of the installed llvmlite
                return None
            write_cache(name, code)
        engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), machine)
        engine.add_object_file(llvm.ObjectFileRef.from_data(code))
        engine.finalize_object()
        return engine


ARCHIVE = Archive(PACKAGE / "kernels.zip")
"""The archive that comes with the package."""


def digest(sources: Iterable[str]) -> str:
    """Return the digest of source files, given by their paths in the package; one that is gone counts as empty."""
    sha = hashlib.sha256()
    for source in sources:
        path = PACKAGE / source
        sha.update(path.read_text(encoding="utf-8").encode() if path.is_file() else b"")
    return sha.hexdigest()


def add_symbols(llvm: Any) -> None:
    """Tell LLVM where the functions are that portable code calls."""
    mathematics = ctypes.CDLL("ucrtbase" if sys.platform == "win32" else None)
    for symbol, function in (
        ("falsework_allocate", ctypes.pythonapi.PyMem_RawMalloc),
        ("falsework_free", ctypes.pythonapi.PyMem_RawFree),
        *((name, getattr(mathematics, name)) for name in ("atan2", "cos", "sin")),
    ):
        llvm.add_symbol(symbol, ctypes.cast(function, ctypes.c_void_p).value)


def target_machine(llvm: Any) -> Any:
    """Return the processor of this machine as LLVM's target."""
    triple = llvm.get_process_triple()
    return llvm.Target.from_triple(triple).create_target_machine(
        cpu=llvm.get_host_cpu_name(),
        features=llvm.get_host_cpu_features().flatten(),
        opt=3,
        reloc="static" if triple.startswith("x86") else "default",
        codemodel="jitdefault",
        jit=True,
    )


def compile_code(llvm: Any, machine: Any, bitcode: bytes) -> bytes:
    """Return the machine code of bitcode."""
    module = llvm.parse_bitcode(bitcode)
    module.triple, module.data_layout = machine.triple, str(machine.target_data)
    tuning = llvm.create_pipeline_tuning_options(speed_level=3)
    tuning.loop_vectorization = True
    builder = llvm.create_pass_builder(machine, tuning)
    builder.getModulePassManager().run(module, builder)
    return machine.emit_object(module)
