"""Small scenes with known answers, random states, a formulation that shares nothing with the solvers, and the GPU's
kernel as plain C++."""

from __future__ import annotations

import ctypes
import dataclasses
import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Sequence
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.optimize
import scipy.sparse as sp
from numpy.typing import ArrayLike, NDArray

from falsework import Assembly, StabilitySettings
from falsework.geometry import TriangleMesh
from falsework.stability.gpu.driver import kernel_source
from falsework.stability.gpu.solver import GpuSolver
from falsework.stability.problem import build_problem
from falsework.stability.settings import EQUILIBRIUM
from falsework.stability.strength import strength_of
from falsework.utils.kernels import Kernel

linprog: Any = vars(scipy.optimize)["linprog"]  # without types, which take a type checker long to infer
COMPILER = shutil.which("g++") or shutil.which("clang++")

BOX_FACES = np.array(
    [(0, 2, 3), (0, 3, 1), (4, 5, 7), (4, 7, 6), (0, 1, 5), (0, 5, 4),
     (2, 6, 7), (2, 7, 3), (0, 4, 6), (0, 6, 2), (1, 3, 7), (1, 7, 5)]
)  # fmt: skip


class Scenes:
    """Makers of assemblies whose stability is known in closed form."""

    @staticmethod
    def box(low: ArrayLike, high: ArrayLike, name: str = "box", turn: NDArray | None = None) -> TriangleMesh:
        """Box between two corners, turned about the origin."""
        low, high = np.asarray(low, float), np.asarray(high, float)
        corners = low + np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)]) * (high - low)
        return TriangleMesh.from_arrays(name, corners if turn is None else corners @ turn.T, BOX_FACES)

    @staticmethod
    def about_y(angle: float) -> NDArray[np.float64]:
        c, s = np.cos(angle), np.sin(angle)
        return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])

    @staticmethod
    def about_z(angle: float) -> NDArray[np.float64]:
        c, s = np.cos(angle), np.sin(angle)
        return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])

    @staticmethod
    def make(boxes: Sequence[TriangleMesh], fixed: Sequence[int], **options: object) -> Assembly:
        return Assembly.from_meshes(boxes, boundary=list(fixed), **options)  # type: ignore[arg-type]

    @staticmethod
    def leaning(assembly: Assembly, seed: int = 0) -> Assembly:
        """The structure as if the faces at half of its contact points were inclined by up to 0.4 radians."""
        rng, count = np.random.default_rng(seed), len(assembly.contacts.points)
        lean = np.where(rng.random(count) < 0.5, 0.0, rng.uniform(0.0, 0.2, count))
        return dataclasses.replace(assembly, contacts=dataclasses.replace(assembly.contacts, lean=lean))

    @staticmethod
    def slope(angle: float, *, friction: float, azimuth: float = 0.0, scale: float = 1.0) -> Assembly:
        """Part 0 is a flat block on a fixed slab, both tilted: too flat to tip, so it can only slip."""
        turn = Scenes.about_z(azimuth) @ Scenes.about_y(angle)
        block = Scenes.box([-0.5 * scale, -0.5 * scale, 0], [0.5 * scale, 0.5 * scale, 0.05 * scale], "block", turn)
        slab = Scenes.box([-scale, -scale, -0.1 * scale], [scale, scale, 0], "slab", turn)
        return Scenes.make([block, slab], [1], friction=friction)

    @staticmethod
    def tower(blocks: int = 2, **options: object) -> Assembly:
        """Unit cubes on top of each other; the last part is the ground."""
        boxes = [Scenes.box([0, 0, k], [1, 1, k + 1], f"block-{k}") for k in range(blocks)]
        return Scenes.make([*boxes, Scenes.box([-1, -1, -1], [2, 2, 0], "ground")], [blocks], **options)

    @staticmethod
    def clamp(**options: object) -> Assembly:
        """Part 0 is a unit cube between two fixed walls, with nothing below it."""
        walls = [Scenes.box([-1, -1, -1], [0, 2, 2], "left"), Scenes.box([1, -1, -1], [2, 2, 2], "right")]
        return Scenes.make([Scenes.box([0, 0, 0], [1, 1, 1], "cube"), *walls], [1, 2], **options)

    @staticmethod
    def turn_tangents(assembly: Assembly, angle: float) -> Assembly:
        """The same assembly with the tangents of all contact frames turned about the normals."""
        contacts = assembly.contacts
        frames = contacts.frames.copy()
        c, s = np.cos(angle), np.sin(angle)
        frames[:, 1] = c * contacts.frames[:, 1] + s * contacts.frames[:, 2]
        frames[:, 2] = -s * contacts.frames[:, 1] + c * contacts.frames[:, 2]
        return dataclasses.replace(assembly, contacts=dataclasses.replace(contacts, frames=frames))

    @staticmethod
    def random_states(
        assembly: Assembly, count: int, seed: int, shares: tuple[float, float, float] = (0.2, 0.65, 0.15)
    ) -> NDArray[np.uint8]:
        """States whose parts are removed, installed and held with the given probabilities."""
        random = np.random.default_rng(seed)
        states = random.choice(3, (count, assembly.part_count), p=shares).astype(np.uint8)
        states[:, assembly.boundary] = 2
        return states

    @staticmethod
    def few_changes(assembly: Assembly, count: int, seed: int, most: int = 4) -> NDArray[np.uint8]:
        """Complete structures with up to `most` parts removed or held: where verdicts are not obvious."""
        random = np.random.default_rng(seed)
        states = np.ones((count, assembly.part_count), np.uint8)
        free = np.flatnonzero(~assembly.boundary)
        for state in states:
            chosen = random.choice(free, min(random.integers(0, most + 1), len(free)), replace=False)
            state[chosen] = random.choice([0, 2], len(chosen))
        states[:, assembly.boundary] = 2
        return states


def least_residual(
    assembly: Assembly,
    state: NDArray[np.uint8],
    *,
    directions: int = 8,
    widen: float = 1.0,
    force_bound: float = 1e3,
    gravity: float = 9.81,
) -> float:
    """Smallest residual that admissible forces reach, by the simplex method on rays of the cones.

    Everything is taken from the geometry: each contact point pushes along `directions` rays
    `n + widen * mu * (cos a t1 + sin a t2)`, one that bears tension pulls by it beforehand, one that sticks may take
    tangential forces of a bounded sum beside, and the parts' Newton and Euler equations are written out. The
    residual is the largest acceleration by gravity, angular ones times the largest radius of gyration of their part.
    """
    contacts, mass = assembly.contacts, assembly.mass
    free = [part for part in range(assembly.part_count) if state[part] == 1]
    if not free:
        return 0.0
    row_of = {part: 6 * k for k, part in enumerate(free)}
    gyration = {part: np.sqrt(np.linalg.norm(mass.inertia[part], 2) / mass.mass[part]) for part in free}
    inverse_inertia = {part: np.linalg.inv(mass.inertia[part]) for part in free}
    angles = 2 * np.pi * np.arange(directions) / directions
    strength = strength_of(assembly, gravity)
    columns: list[NDArray] = []
    discs: list[tuple[NDArray, float]] = []
    pulled, tension = np.zeros(6 * len(free)), 0.0

    def wrench(a: int, b: int, point: NDArray, force: NDArray) -> NDArray:
        column = np.zeros(6 * len(free))
        for part, sign in ((a, -1), (b, 1)):
            if part in row_of:
                (x, y, z), (u, v, w) = (point - mass.center[part]).tolist(), (sign * force).tolist()
                moment = np.array([y * w - z * v, z * u - x * w, x * v - y * u])
                column[row_of[part] : row_of[part] + 3] = sign * force / (mass.mass[part] * gravity)
                turn = inverse_inertia[part] @ moment
                column[row_of[part] + 3 : row_of[part] + 6] = turn * gyration[part] / gravity
        return column

    for contact in range(len(contacts)):
        a, b = (int(part) for part in contacts.parts[contact])
        if state[a] == 0 or state[b] == 0 or (a not in row_of and b not in row_of):
            continue
        normal, first, second = contacts.frames[contact]
        for number in range(contacts.start[contact], contacts.start[contact + 1]):
            point = contacts.points[number]
            pulled -= strength.pull[number] * wrench(a, b, point, normal)
            tension += strength.pull[number]
            for angle in angles:
                slip = widen * (np.cos(angle) * first + np.sin(angle) * second)
                columns.append(wrench(a, b, point, normal + strength.friction[number] * slip))
                if strength.stick[number] > 0:
                    discs.append((wrench(a, b, point, slip), strength.stick[number]))
    weight = gravity * mass.mass[~assembly.boundary].sum()
    fall = np.tile([0.0, 0.0, -1.0, 0.0, 0.0, 0.0], len(free)) + pulled
    if not columns:
        return 1.0
    rays, total = len(columns), len(columns) + len(discs)
    moved = sp.csc_matrix(np.array(columns + [column for column, _ in discs]).T * weight)
    one = np.ones((6 * len(free), 1))
    press = sp.csc_matrix(np.r_[np.ones(rays), np.zeros(total - rays + 1)][None])
    cells = np.arange(total - rays)
    shape = (len(cells) // directions, total + 1)
    stuck = sp.csc_matrix((np.ones(len(cells)), (cells // directions, rays + cells)), shape)
    answer = linprog(
        np.append(np.zeros(total), 1.0),
        A_ub=sp.vstack([sp.hstack([moved, -one]), sp.hstack([-moved, -one]), press, stuck]),
        b_ub=np.concatenate(
            [-fall, fall, [force_bound + tension / weight], [most / weight for _, most in discs[::directions]]]
        ),
        method="highs",
    )
    assert answer.status == 0, answer.message
    return float(answer.fun)


@lru_cache
def library_of(defines: tuple[tuple[str, int], ...], kept: Path) -> ctypes.CDLL:
    """The kernel as a shared library, which the first worker that needs it leaves in a folder for the others."""
    assert COMPILER is not None
    constants = [f"-D{name}={value}" for name, value in defines]
    library = kept / f"kernel{''.join(constants)}.so"
    if not library.exists():
        with tempfile.TemporaryDirectory(dir=kept) as folder:
            source, out = Path(folder) / "kernel.cpp", Path(folder) / "kernel.so"
            source.write_text(kernel_source(), encoding="utf-8")
            command = [COMPILER, "-std=c++17", "-Og", "-shared", "-fPIC", *constants, "-o", str(out), str(source)]
            subprocess.run(command, check=True, capture_output=True)
            out.replace(library)
    return ctypes.CDLL(str(library))


class HostDriver:
    """A device whose blocks have one thread: the processor."""

    multiprocessors = 1
    most_threads = 1
    libraries: Path
    """Folder that all workers of a test run share."""

    def __init__(self, defines: dict[str, int], shared_limit: int = 227 * 1024, memory: int | None = None) -> None:
        self.shared_limit = shared_limit
        self.memory = memory
        self.launched: list[str] = []
        self._library = library_of(tuple(sorted(defines.items())), self.libraries)

    def put(self, array: Any) -> Any:
        return np.array(array, order="C")

    def empty(self, shape: tuple[int, ...], dtype: Any) -> Any:
        if self.memory is not None and np.prod(shape) * np.dtype(dtype).itemsize > self.memory:
            raise RuntimeError("CUDA out of memory")
        return np.full(shape, 77, dtype=dtype)  # what is read before it is written will not look right

    def zeros(self, shape: tuple[int, ...], dtype: Any) -> Any:
        return np.zeros(shape, dtype=dtype)

    def get(self, array: Any) -> Any:
        return array

    def address(self, array: Any) -> int:
        return array.ctypes.data

    def blocks(self, kernel: str, threads: int, shared: int) -> int:
        return 1

    def launch(self, kernel: str, blocks: int, threads: int, shared: int, arguments: Any) -> None:
        assert blocks == threads == 1
        self.launched.append(kernel)
        function = getattr(self._library, kernel)
        function.argtypes = [type(argument) for argument in arguments]
        function.restype = None
        function(*arguments)


def solver_on_host(assembly: Assembly, settings: StabilitySettings = EQUILIBRIUM, **limits: Any) -> GpuSolver:
    """The solver for a GPU, on the processor."""
    problem = build_problem(assembly, cone=settings.friction_cone, gravity=settings.gravity)
    return GpuSolver(assembly, problem, settings, make_driver=lambda defines, _: HostDriver(defines, **limits))


@pytest.fixture
def interpreted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Run kernels as Python unless their dispatcher is called: with little data faster than to compile them alone."""
    monkeypatch.setattr(Kernel, "__call__", lambda kernel, *arguments: kernel.py_func(*arguments))


@pytest.fixture(scope="session")
def scenes() -> type[Scenes]:
    return Scenes


@pytest.fixture(scope="session")
def simplex() -> Callable[..., float]:
    return least_residual


@pytest.fixture(scope="session")
def host_driver(tmp_path_factory: pytest.TempPathFactory) -> type[HostDriver]:
    """A device for `GpuSolver` that is the processor."""
    if COMPILER is None:
        pytest.skip("no C++ compiler for the kernel")
    own = tmp_path_factory.getbasetemp()
    HostDriver.libraries = own.parent if "PYTEST_XDIST_WORKER" in os.environ else own
    return HostDriver


@pytest.fixture(scope="session")
def on_host(host_driver: type[HostDriver]) -> Callable[..., GpuSolver]:
    """Makes the solver for a GPU on the processor, given an assembly, settings and limits of the device."""
    return solver_on_host


def solver_on_device(
    assembly: Assembly, settings: StabilitySettings = EQUILIBRIUM, threads: int | None = None
) -> GpuSolver:
    """The solver on a GPU; with `threads`, blocks have that many at most."""
    problem = build_problem(assembly, cone=settings.friction_cone, gravity=settings.gravity)
    solver = GpuSolver(assembly, problem, settings)
    if threads is not None:
        solver.driver.most_threads = threads
    return solver


@pytest.fixture(scope="session")
def on_device() -> Callable[..., GpuSolver]:
    """Makes the solver on a GPU, given an assembly and settings; skips where there is none."""
    if find_spec("torch") is None or find_spec("cuda") is None or find_spec("cuda.bindings") is None:
        pytest.skip("no torch or no cuda-bindings; pip install 'falsework[gpu]'")
    import torch

    if not torch.cuda.is_available():
        pytest.skip("no GPU")
    return solver_on_device


@pytest.fixture(params=["host", "device"])
def make_solver(request: pytest.FixtureRequest) -> Callable[..., GpuSolver]:
    """Makes the solver with the GPU's kernels on the processor, and on a GPU where there is one."""
    return request.getfixturevalue(f"on_{request.param}")
