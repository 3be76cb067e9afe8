"""Portable code of kernels (LLVM bitcode), compiled for this processor at first use and cached as machine code.

`kernels.zip` in the package holds a file of bitcode for each group of kernels, and `index.json`: for each group its
entries with the kinds of their arguments, and a digest of the sources that it was made of. `tests/make_kernels.py`
writes it. Bitcode names no processor: LLVM chooses instructions and the width of vectors when it compiles it here.
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
from functools import cache
from pathlib import Path
from threading import Lock
from typing import Any

from falsework.utils.cache.folder import read_cache, write_cache

PACKAGE = Path(__file__).parents[1]
ARCHIVE = PACKAGE / "kernels.zip"
_LOADING = Lock()


@dataclass(frozen=True)
class Code:
    """Machine code of a kernel."""

    kinds: list[str]
    """Kinds of its arguments, as `kernels.flatten` names them."""
    run: Callable[[bytes], int]
    """Call with the words of all arguments, without the interpreter's lock."""
    library: Any
    """Engine that owns the code, which is freed with it."""


def load(module: str, name: str) -> Code | None:
    """Return the machine code of a kernel, compiled if need be; None where there is no portable code that fits."""
    entry = f"{module}.{name}"
    group = next((group for group, content in _index().items() if entry in content["entries"]), None)
    if group is None:
        return None
    with _LOADING:
        library = _library(group)
    if library is None:
        return None
    address = library.get_function_address(entry)
    function = ctypes.CFUNCTYPE(ctypes.c_int32, ctypes.c_char_p, ctypes.POINTER(ctypes.c_int64))(address)

    def run(words: bytes) -> int:
        result = ctypes.c_int64(0)
        if function(words, result) not in (0, -2):  # -2: returns None
            raise RuntimeError(f"{entry} failed: its arguments do not fit together, or there is no memory left")
        return result.value

    return Code(_index()[group]["entries"][entry], run, library)


def digest(sources: Iterable[str]) -> str:
    """Return the digest of source files, given by their paths in the package; one that is gone counts as empty."""
    sha = hashlib.sha256()
    for source in sources:
        path = PACKAGE / source
        sha.update(path.read_text(encoding="utf-8").encode() if path.is_file() else b"")
    return sha.hexdigest()


@cache
def _index() -> dict[str, Any]:
    if sys.byteorder != "little" or struct.calcsize("P") != 8 or not ARCHIVE.is_file():
        return {}
    with zipfile.ZipFile(ARCHIVE) as archive:
        return json.loads(archive.read("index.json"))


@cache
def _library(group: str) -> Any:
    """Return a group as an engine of LLVM that knows its entries; None where sources or LLVM do not fit."""
    content = _index()[group]
    if digest(content["sources"]) != content["digest"]:
        return None
    from llvmlite import binding as llvm

    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    mathematics = ctypes.CDLL("ucrtbase" if sys.platform == "win32" else None)
    for symbol, function in (
        ("falsework_allocate", ctypes.pythonapi.PyMem_RawMalloc),
        ("falsework_free", ctypes.pythonapi.PyMem_RawFree),
        *((name, getattr(mathematics, name)) for name in ("atan2", "cos", "sin")),
    ):
        llvm.add_symbol(symbol, ctypes.cast(function, ctypes.c_void_p).value)
    machine = target_machine(llvm)
    identity = [content["digest"], content["made"], llvm.llvm_version_info, machine.triple, llvm.get_host_cpu_name()]
    identity.append(llvm.get_host_cpu_features().flatten())
    name = f"{group}-{hashlib.sha256(repr(identity).encode()).hexdigest()[:24]}.code"
    code = read_cache(name)
    if code is None:
        with zipfile.ZipFile(ARCHIVE) as archive:
            bitcode = archive.read(f"{group}.bc")
        try:
            code = compile_code(llvm, machine, bitcode)
        except RuntimeError:  # of a later LLVM than that of the installed llvmlite
            return None
        write_cache(name, code)
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), machine)
    engine.add_object_file(llvm.ObjectFileRef.from_data(code))
    engine.finalize_object()
    return engine


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
