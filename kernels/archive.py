"""Archive of the kernels that plans need as portable code, `src/falsework/kernels.zip`, made from their source.

    python kernels/archive.py

Building a wheel makes it (`backend.py`), and so does `make kernels`; one that fits the sources stays, and groups that
were made of the same sources before come from the user's cache. Without it numba compiles the kernels where they are
called.

Numba translates each kernel with everything that it calls to LLVM's intermediate code, for the types that it is called
with here. What numba would have its own run time do, memory for arrays, `allocate` and `release` do. LLVM then inlines
and simplifies the code, without regard to a processor.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import re
import sys
import zipfile
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from itertools import repeat
from multiprocessing import get_context
from pathlib import Path
from typing import IO, Any

import numba
import numpy as np
from llvmlite import binding as llvm
from llvmlite import ir
from numba.core import codegen, cpu, types
from numba.extending import intrinsic

from falsework.assembly.load import load_structure
from falsework.assembly.state import complete_state
from falsework.geometry.clearance import table
from falsework.robots.cells.warm_up import compile_kernels
from falsework.robots.kernels import collision, coordination, numeric_ik, rrt_connect, speed_profile
from falsework.robots.kinematics import forward
from falsework.stability.contact.kernel import rest_range, rest_under
from falsework.stability.contact.press import PressPlanner
from falsework.stability.contact.press_kernel import press_responses
from falsework.stability.contact.replay import Replayer
from falsework.stability.contact.replay_kernel import replay_range
from falsework.stability.contact.solver import ContactSolver
from falsework.stability.cpu.kernel import solve_range
from falsework.stability.cpu.neighbourhood import local_instability_range
from falsework.stability.cpu.repair import repair_range
from falsework.stability.cpu.solver import CpuSolver
from falsework.stability.oracle import StabilityOracle
from falsework.stability.problem import build_problem
from falsework.stability.settings import StabilitySettings
from falsework.utils import bits
from falsework.utils.cache.folder import read_cache, write_cache
from falsework.utils.cache.kernel_sources import callees, sources
from falsework.utils.files.output_file import write_whole
from falsework.utils.kernel_code import ARCHIVE, Archive, add_symbols, digest
from falsework.utils.kernels import Kernel, flatten
from falsework.viewer.pictures import raster
from falsework.viewer.pictures.render import Camera, ColoredSolid, render

GROUPS = {
    "contact": (rest_range, replay_range, press_responses),
    "equilibrium": (local_instability_range, repair_range, solve_range),
    "margins": (rest_under,),
    "motion": (
        collision._distance,
        collision.check_many,
        coordination._conflicts,
        coordination._place,
        forward.place_many,
        numeric_ik.reach_poses,
        rrt_connect.edges_free,
        rrt_connect.grow,
        rrt_connect.shorten,
        speed_profile.evaluate,
        speed_profile.fastest,
        speed_profile.thin,
    ),
    "pictures": (raster.average, raster.depth_buffer, raster.lay_over, raster.shade),
    "sets": (bits.intersect_into, table._first_exits),
}
STABILITY = {"contact", "equilibrium", "margins"}
"""Groups that call mostly the same kernels."""
MATHEMATICS = {"atan2"}
"""Functions of the C library that kernels call by name; of sine and cosine LLVM knows itself."""

_HEAD = 48
"""Bytes before the data of an array: the first word counts references, the fourth is the address of the data."""
_BLOCK = types.CPointer(types.int64)


_intrinsic: Any = intrinsic


@_intrinsic
def _address(_, block):
    """Return a pointer as a number."""
    return types.int64(block), lambda _, builder, signature, given: builder.ptrtoint(given[0], ir.IntType(64))


@_intrinsic
def _set_data(_, block, offset):
    """Make the fourth word of a block the address of one of its bytes: as a pointer, which LLVM knows to be in it."""

    def write(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        byte = ir.IntType(8).as_pointer()
        data = builder.gep(builder.bitcast(given[0], byte), [given[1]])
        builder.store(data, builder.bitcast(builder.gep(given[0], [ir.IntType(64)(3)]), byte.as_pointer()))
        return context.get_dummy_value()

    return types.void(block, types.int64), write


_reserve = types.ExternalFunction("falsework_allocate", _BLOCK(types.int64))
_free = types.ExternalFunction("falsework_free", types.void(_BLOCK))


def allocate(size, align):
    """Return a block for an array with one reference, its data aligned to a power of two; a null pointer if none."""
    block = _reserve(_HEAD + align + size)
    if _address(block) != 0:
        block[0] = 1
        _set_data(block, _HEAD + (-(_address(block) + _HEAD) & (align - 1)))
    return block


def release(block):
    """Free the block of an array without references."""
    _free(block)


RUN_TIME = {
    "NRT_MemInfo_alloc_aligned": (allocate, _BLOCK(types.int64, types.int32)),
    "NRT_MemInfo_call_dtor": (release, types.void(_BLOCK)),
}
"""What stands in for functions of numba's run time."""


def record() -> dict[str, tuple[Any, ...]]:
    """Return the arguments of each kernel, as a small structure has them."""
    recorded: dict[str, tuple[Any, ...]] = {}

    def note(self: Kernel, *arguments: Any) -> int:
        recorded.setdefault(f"{self.__module__}.{self.__name__}", arguments)
        if self.__module__.startswith("falsework.robots"):
            return self.py_func(*arguments)  # motions are planned from what the kernels before have found
        return 1  # states are left for the next kernel

    real, Kernel.__call__ = Kernel.__call__, note
    try:
        assembly = load_structure("arch:blocks=5")
        states = np.stack([complete_state(assembly.boundary)] * 2)
        settings = StabilitySettings()
        problem = build_problem(assembly, cone=settings.friction_cone, gravity=settings.gravity)
        solver = ContactSolver(assembly, problem, settings)
        solver.check(states)
        solver.falls(states, states)
        CpuSolver(problem).check(states, parents=states, guess=np.ones((2, problem.points, 3)))  # repairs forces
        Replayer(assembly).replay(states)
        held = np.where(np.arange(states.shape[1]) < 2, 2, states[0]).astype(np.uint8)
        released = np.where(np.arange(states.shape[1]) < 1, 1, held).astype(np.uint8)
        history = np.zeros((problem.points, 3)), np.zeros(problem.points, bool), np.zeros(0)
        next(PressPlanner(solver).proposals(held, released, *history), None)
        prober = StabilityOracle(assembly).prober
        prober.ask(states[0], prober.own())
        words = bits.pack(states > 0)
        bits.intersect(words, words)
        compile_kernels()
        mesh, bounds = assembly.meshes[0], np.array([[-2.0, -2.0, -2.0], [2.0, 2.0, 2.0]])
        solids = [ColoredSolid(mesh.vertices, mesh.faces, (1.0, 0.0, 0.0), opacity) for opacity in (1.0, 0.5)]
        render(solids, Camera(width=64, height=48), bounds)
        ways = np.arange(states.shape[1] + 1, dtype=np.int32)
        table._first_exits(words, np.zeros((states.shape[1], 1), np.uint64), ways, np.zeros(states.shape, np.int32))
    finally:
        Kernel.__call__ = real
    return recorded


def translate(kernel: Kernel, entry: str, given: tuple[Any, ...]) -> list[str]:
    """Return the intermediate code of a kernel with all that it calls, and of its entry."""
    dispatcher = kernel.dispatcher
    signature = tuple(map(numba.typeof, given))
    dispatcher.compile(signature)
    compiled = dispatcher.overloads[signature]
    convention = dispatcher.targetctx.call_conv
    kind = convention.get_function_type(compiled.fndesc.restype, compiled.fndesc.argtypes)
    return [text_of(compiled.library), str(write_entry(entry, compiled.fndesc.llvm_func_name, kind))]


def write_entry(name: str, inner: str, kind: ir.FunctionType) -> ir.Module:
    """Return a function of the words of all arguments, and of the address of the result, that calls a kernel."""
    module, word, status = ir.Module(), ir.IntType(64), ir.IntType(32)
    result, failure, *formals = kind.args
    outer = ir.Function(module, ir.FunctionType(status, [word.as_pointer(), result]), name)
    builder = ir.IRBuilder(outer.append_basic_block())
    places = [builder.gep(outer.args[0], [word(number)]) for number in range(len(formals))]
    words = [
        builder.load(builder.bitcast(place, formal.as_pointer()), align=1)  # the low bytes of a word come first
        for place, formal in zip(places, formals, strict=True)
    ]
    called = ir.Function(module, kind, inner)
    builder.ret(builder.call(called, [outer.args[1], builder.alloca(failure.pointee), *words]))
    return module


def run_time() -> list[str]:
    """Return the intermediate code of what stands in for numba's run time."""
    add_symbols(llvm)
    compiler: Any = numba.cfunc
    texts = []
    for name, (function, signature) in RUN_TIME.items():
        compiled = compiler(signature, nopython=True)(function)
        text = text_of(compiled._library).replace(compiled.native_name, name).replace("noinline", "alwaysinline")
        # No other address leads to a new block; numba has no way to say so.
        texts.append(text.replace("declare ptr @falsework_allocate", "declare noalias ptr @falsework_allocate"))
    return texts


def text_of(library: Any) -> str:
    """Return the intermediate code of a compiled function, with square roots that LLVM knows."""
    text = str(library._final_module).replace("@sqrt(", "@llvm.sqrt.f64(")
    text = re.sub(r"^declare double @llvm\.sqrt\.f64.*$", "", text, flags=re.MULTILINE)
    return text + "\ndeclare double @llvm.sqrt.f64(double)\n"


def simplify(texts: list[str], entries: list[str]) -> bytes:
    """Return kernels as one module of bitcode that keeps only its entries visible."""
    module = llvm.parse_assembly(texts[0])
    for text in texts[1:]:
        module.link_in(llvm.parse_assembly(text))
    for function in module.functions:
        if not function.is_declaration:
            function.linkage = "external" if function.name in entries else "internal"
    plain = llvm.Target.from_triple(module.triple).create_target_machine(cpu="generic")
    for level in (0, 2):
        tuning = llvm.create_pipeline_tuning_options(speed_level=level)
        tuning.loop_vectorization = tuning.slp_vectorization = tuning.loop_unrolling = False
        builder = llvm.create_pass_builder(plain, tuning)
        passes = builder.getModulePassManager()
        if level == 0:  # as numba does it: inline, then remove pairs of references taken and given back
            passes.add_loop_rotate_pass()
            passes.add_instruction_combine_pass()
            passes.add_jump_threading_pass()
        passes.add_refprune_pass()
        passes.run(module, builder)
    outside = {function.name for function in module.functions if function.is_declaration}
    unknown = {name for name in outside if not name.startswith("llvm.")} - MATHEMATICS
    unknown -= {"falsework_allocate", "falsework_free"}
    if unknown:
        sys.exit(f"portable code would need {', '.join(sorted(unknown))}; write the kernel without it")
    return module.as_bitcode()


def build(groups: Iterable[str], given: dict[str, tuple[Any, ...]]) -> dict[str, tuple[dict[str, Any], bytes]]:
    """Return what the index says of each group, and its bitcode; `given` has the arguments of each kernel.

    What several of the groups call is translated once.
    """
    # Optimised once, in `simplify`, with everything in one module, not by numba at every level of calls; nor is there
    # machine code of any level, since nothing runs here: a builtin method stands for it.
    codegen.CPUCodeLibrary._optimize_final_module = lambda self: None
    codegen.JITCodeLibrary._finalize_specific = lambda self: None
    context: Any = cpu.CPUContext
    context.get_executable = lambda _, library, *__: [library.get_pointer_to_function("")].pop
    return {group: build_group(group, given) for group in groups}


def build_group(group: str, given: dict[str, tuple[Any, ...]]) -> tuple[dict[str, Any], bytes]:
    """Return what the index says of a group, and its bitcode."""
    kernels = {f"{kernel.__module__}.{kernel.__name__}": kernel for kernel in GROUPS[group]}
    called = called_in(group)
    for kernel in called:
        kernel.options |= {"cache": False, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    texts = [text for name, kernel in kernels.items() for text in translate(kernel, name, given[name])]
    code = simplify([*texts, *run_time()], list(kernels))
    kinds = {name: [flatten(argument)[0] for argument in given[name]] for name in kernels}
    files = sources(called)
    return {"entries": kinds, "sources": files, "digest": digest(files), "made": made()}, code


def called_in(group: str) -> set[Kernel]:
    """Return the kernels of a group and all that they call."""
    return set().union(*map(callees, GROUPS[group]))


def cached_as(group: str) -> str:
    """Return the name under which the user's cache has a group of the present sources, for other clones."""
    return f"{group}-{hashlib.sha256(repr((digest(sources(called_in(group))), made())).encode()).hexdigest()[:24]}.bc"


def pack(content: dict[str, Any], code: bytes) -> bytes:
    """Return a group as the user's cache has it: what the index says of it in a line, and its bitcode."""
    return json.dumps(content).encode() + b"\n" + code


def unpack(packed: bytes) -> tuple[dict[str, Any], bytes]:
    """Return a group from the user's cache."""
    head, _, code = packed.partition(b"\n")
    return json.loads(head), code


def made() -> str:
    """Return what the archive depends on besides its sources."""
    return f"numba {numba.__version__}, {hashlib.sha256(Path(__file__).read_bytes()).hexdigest()[:12]}"


def make(path: Path, groups: Iterable[str]) -> None:
    """Write an archive of groups, in two processes, unless there is one that is made of the present sources.

    Groups that were made of the same sources before, in another clone perhaps, come from the user's cache.
    """
    present = Archive(path)
    if list(present.index) == list(groups) and all(
        content["made"] == made() and present.fits(group) for group, content in present.index.items()
    ):
        return
    names = {group: cached_as(group) for group in groups}
    done = {group: unpack(content) for group in groups if (content := read_cache(names[group])) is not None}
    missing = [group for group in groups if group not in done]
    if missing:
        given = record()
        halves = [[group for group in missing if (group in STABILITY) is chosen] for chosen in (True, False)]
        with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
            for half in pool.map(build, filter(None, halves), repeat(given)):
                done |= half
                for group in half:
                    write_cache(names[group], pack(*half[group]))
    built = {group: done[group] for group in groups}

    def write(file: IO[bytes]) -> None:
        with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
            archive.writestr("index.json", json.dumps({group: built[group][0] for group in built}, indent=1))
            for group, (_, code) in built.items():
                archive.writestr(f"{group}.bc", code)

    write_whole(path, write)
    sys.stdout.write(f"{path}: {path.stat().st_size:,} bytes\n")


if __name__ == "__main__":
    about = (
        "Make src/falsework/kernels.zip from the source of the kernels: about a minute and a half of processor time."
    )
    argparse.ArgumentParser(description=about).parse_args()
    make(ARCHIVE.path, GROUPS)
