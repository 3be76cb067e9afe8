"""Portable code of the kernels that plans need, `src/falsework/kernels.zip`, built from their source.

Run it after a change of a kernel; a test fails until then, and numba compiles what the archive no longer fits.

    python tests/make_kernels.py

Numba translates each kernel with everything that it calls to LLVM's intermediate code, for the types that it is called
with here. What numba would have its own run time do, memory for arrays, is written out below. LLVM then inlines and
simplifies the code, without regard to a processor.
"""

from __future__ import annotations

import argparse
import ast
import json
import re
import sys
import zipfile
from pathlib import Path
from typing import Any

import numba
import numpy as np
from llvmlite import binding as llvm
from numba.core import codegen

from falsework.assembly import load_structure
from falsework.assembly.state import complete_state
from falsework.geometry.clearance import table
from falsework.robots.cells.warm_up import compile_kernels
from falsework.robots.kernels import collision, coordination, numeric_ik, rrt_connect, speed_profile
from falsework.robots.kinematics import forward
from falsework.stability import StabilityOracle, StabilitySettings
from falsework.stability.contact.kernel import rest_range
from falsework.stability.contact.press import PressPlanner
from falsework.stability.contact.press_kernel import press_responses
from falsework.stability.contact.replay import Replayer
from falsework.stability.contact.replay_kernel import replay_range
from falsework.stability.contact.solver import ContactSolver
from falsework.stability.cpu.kernel import solve_range
from falsework.stability.cpu.neighbourhood import local_instability_range
from falsework.stability.cpu.repair import repair_range
from falsework.stability.cpu.solver import CpuSolver
from falsework.stability.margins.kernel import rest_under
from falsework.stability.problem import build_problem
from falsework.utils import bits
from falsework.utils.kernel_code import ARCHIVE, PACKAGE, digest
from falsework.utils.kernels import Kernel, flatten
from falsework.viewer.pictures import raster
from falsework.viewer.pictures.render import Camera, ColoredSolid, render

GROUPS = {
    "contact": (rest_range, replay_range, press_responses),
    "equilibrium": (local_instability_range, repair_range, solve_range),
    "margins": (rest_under,),
    "motion": (
        collision._distance,
        coordination._conflicts,
        coordination._place,
        forward.place_many,
        numeric_ik.reach_poses,
        rrt_connect._run,
        speed_profile.evaluate,
        speed_profile.fastest,
        speed_profile.thin,
    ),
    "pictures": (raster.average, raster.depth_buffer, raster.lay_over, raster.shade),
    "sets": (bits._intersect, table._first_exits),
}
MATHEMATICS = {"atan2"}
"""Functions of the C library that kernels call by name; of sine and cosine LLVM knows itself."""

# An array owns a block: references, three words that numba's code does not touch here, and at the fourth its data.
MEMORY = """
declare noalias ptr @falsework_allocate(i64)
declare void @falsework_free(ptr)

define internal noalias ptr @NRT_MemInfo_alloc_aligned(i64 %size, i32 %align) {
  %wide = zext i32 %align to i64
  %head = add i64 %wide, 48
  %room = add i64 %head, %size
  %block = call ptr @falsework_allocate(i64 %room)
  %none = icmp eq ptr %block, null
  br i1 %none, label %done, label %fill
fill:
  %after = getelementptr i8, ptr %block, i64 %head
  %number = ptrtoint ptr %after to i64
  %over = urem i64 %number, %wide
  %back = sub i64 0, %over
  %data = getelementptr i8, ptr %after, i64 %back
  store i64 1, ptr %block
  %field = getelementptr i8, ptr %block, i64 24
  store ptr %data, ptr %field
  br label %done
done:
  ret ptr %block
}

define internal void @NRT_MemInfo_call_dtor(ptr %block) {
  call void @falsework_free(ptr %block)
  ret void
}
"""


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
        solver.check(states, certificates=False, parents=states)  # looks for parts that fall nearby first
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


def translate(kernel: Kernel, entry: str, given: tuple[Any, ...]) -> str:
    """Return the intermediate code of a kernel and of all that it calls."""
    types = tuple(map(numba.typeof, given))
    dispatcher = kernel.dispatcher
    dispatcher.compile(types)
    compiled = dispatcher.overloads[types]
    inner = compiled.fndesc.llvm_func_name
    module = compiled.library._final_module
    formals = [str(formal.type) for formal in module.get_function(inner).arguments][2:]
    lines = [f'define i32 @"{entry}"(ptr %words, ptr %result) {{', "  %failure = alloca ptr"]
    for place, kind in enumerate(formals):
        narrow = kind.startswith("i") and kind != "i64"
        lines.append(f"  %p{place} = getelementptr i64, ptr %words, i64 {place}")
        lines.append(f"  %{'w' if narrow else 'a'}{place} = load {'i64' if narrow else kind}, ptr %p{place}, align 1")
        if narrow:
            lines.append(f"  %a{place} = trunc i64 %w{place} to {kind}")
    passed = "".join(f", {kind} %a{place}" for place, kind in enumerate(formals))
    lines += [f'  %status = call i32 @"{inner}"(ptr %result, ptr %failure{passed})', "  ret i32 %status", "}"]
    declared = re.compile(r"^declare .*@NRT_MemInfo_(alloc_aligned|call_dtor)\(.*$", re.MULTILINE)
    text = declared.sub("", str(module)).replace("@sqrt(", "@llvm.sqrt.f64(")
    text = re.sub(r"^declare double @llvm\.sqrt\.f64.*$", "", text, flags=re.MULTILINE)
    return "\n".join([text, "declare double @llvm.sqrt.f64(double)", MEMORY, *lines])


def callees(kernel: Kernel) -> set[Kernel]:
    """Return a kernel and all that it calls, directly or not."""
    found, ahead = set(), [kernel]
    while ahead:
        function = ahead.pop()
        if function not in found:
            found.add(function)
            values = (function.py_func.__globals__.get(name) for name in function.py_func.__code__.co_names)
            ahead += [value for value in values if isinstance(value, Kernel)]
    return found


def sources(kernels: set[Kernel]) -> list[str]:
    """Return the files, by their paths in the package, that kernels and the constants in them come from."""
    files = {Path(kernel.py_func.__code__.co_filename) for kernel in kernels}
    names = {name for kernel in kernels for name in kernel.py_func.__code__.co_names}
    for file in list(files):
        for line in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(line, ast.ImportFrom) and names & {alias.name for alias in line.names}:
                origin = PACKAGE.parent / (str(line.module).replace(".", "/") + ".py")
                files |= {origin} if origin.is_file() else set()
    return sorted(file.relative_to(PACKAGE).as_posix() for file in files)


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


def main() -> None:
    """Write the archive, unless the command line asks for help or is wrong."""
    about = "Build src/falsework/kernels.zip anew from the source of the kernels: about two minutes of processor time."
    argparse.ArgumentParser(description=about).parse_args()
    arguments = record()
    # Optimised once, below, with everything in one module; not by numba at every level of calls.
    codegen.CPUCodeLibrary._optimize_final_module = lambda self: None
    for function in {callee for kernels in GROUPS.values() for kernel in kernels for callee in callees(kernel)}:
        function.options |= {"cache": False, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    index: dict[str, Any] = {}
    codes: dict[str, bytes] = {}
    for group, kernels in GROUPS.items():
        names = [f"{kernel.__module__}.{kernel.__name__}" for kernel in kernels]
        translated = [translate(kernel, name, arguments[name]) for kernel, name in zip(kernels, names, strict=True)]
        codes[group] = simplify(translated, names)
        files = sources({callee for kernel in kernels for callee in callees(kernel)})
        kinds = {name: [flatten(argument)[0] for argument in arguments[name]] for name in names}
        index[group] = {"entries": kinds, "sources": files, "digest": digest(files), "made": numba.__version__}
    with zipfile.ZipFile(ARCHIVE, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        archive.writestr("index.json", json.dumps(index, indent=1))
        for group, code in codes.items():
            archive.writestr(f"{group}.bc", code)
    sys.stdout.write(f"{ARCHIVE}: {ARCHIVE.stat().st_size:,} bytes\n")


if __name__ == "__main__":
    main()
