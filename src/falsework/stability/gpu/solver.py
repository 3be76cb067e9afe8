"""GPU solver: batches of states, one state per thread block, on chip until proven."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import States
from falsework.errors import InputError
from falsework.stability.contact.layout import contact_units
from falsework.stability.cpu.cones import CONES, NEGLIGIBLE
from falsework.stability.gpu.driver import CudaDriver
from falsework.stability.gpu.layout import KernelBatch, add_contact, build_layout, kernel_options
from falsework.stability.problem import Problem
from falsework.stability.settings import StabilitySettings
from falsework.stability.stiffness import reach_of
from falsework.stability.verdict import Solver, Verdicts, proof_of

if TYPE_CHECKING:
    import torch

    from falsework.assembly.model import Assembly

_ADMM_SHARES = (0.5, 1.0)
"""Sizes of states, as shares of the structure, that ADMM has a launch for: small states leave room on a
multiprocessor for more of them."""
_STATIC_SHARED = 4 * 1024
"""Largest static shared memory of the kernels, bytes."""


class MemoryWarning(UserWarning):
    """Warning that a batch did not fit into the memory of the GPU and was halved."""


@dataclass(frozen=True)
class _Stage:
    """Launch of a chain: states that do not fit on chip go on to the next."""

    kernel: str
    threads: int
    shared: int
    blocks: int
    scratch: Any
    """Device memory instead of shared memory, or in addition to it, where the largest state does not fit on chip."""
    pool: int
    """Memory per state, bytes."""
    takes: int = 0
    """List of the states to process."""
    large: int = 0
    """List for states that need more memory than this launch has."""
    rest: int = 0
    """List for states that are not proven unstable, or that need more memory for Newton iterations."""


@dataclass(frozen=True)
class _Chain:
    """Launches for a batch."""

    stages: tuple[_Stage, ...]
    open: int
    """List of the states that ADMM leaves undecided."""
    by_group: Any
    """Device memory for the group data of the later methods."""

    @property
    def lists(self) -> int:
        """Lists of states that go from one launch to another."""
        return 1 + max(max(self.open, stage.takes, stage.large, stage.rest) for stage in self.stages)


class GpuSolver:
    """Solver of batches of states of one structure on a GPU.

    The same methods as on the CPU, with the same certificates. For the equilibrium problem (`CpuSolver`), ADMM
    iterates in float32, both proofs are found in float64, and an interior point method in float64 processes the states
    that ADMM leaves undecided. Under `contact` (`ContactSolver`), Newton iterations decide which of the states that are
    not proven unstable come to rest, steps in float32 and proofs in float64. Lists on the device pass states from one
    kernel to the next (`docs/decisions/gpu-solver.md`).

    Args:
        assembly, problem: the structure, and its scaled equilibrium problem.
        settings: stability criterion and numerical settings.
        device: a CUDA device, such as `cuda` or `cuda:1`.
        make_driver: creates another device driver, given the compile-time constants of the kernel and
            the device.

    Raises:
        DependencyError: torch or cuda-bindings is missing.
        InputError: no such device, or a structure too large to index.
    """

    def __init__(
        self,
        assembly: Assembly,
        problem: Problem,
        settings: StabilitySettings = StabilitySettings(),
        device: str = "cuda",
        *,
        make_driver: Callable[[dict[str, int], str], Any] = CudaDriver,
    ) -> None:
        if assembly.joints is not None:
            raise InputError("joints are not checked on a GPU; use the solver cpu (--solver cpu) or auto")
        smooth = problem.strength.friction <= NEGLIGIBLE
        if problem.strength.idle.any() or (smooth.any() and not smooth.all()):
            raise InputError(
                "faces that are inclined to each other by more than friction holds are not checked on a GPU; use the "
                "solver cpu (--solver cpu) or auto"
            )
        self.problem = problem
        self.settings = settings
        self.layout = build_layout(problem)
        self._contact = settings.criterion == "contact"
        self.starts_from_guesses = not self._contact  # under which all states are loaded from rest
        if self._contact:
            gravity, ratio = settings.gravity, settings.stiffness_ratio
            units = contact_units(assembly, problem, gravity)
            self.layout = add_contact(self.layout, *units, reach=reach_of(assembly), gravity=gravity, ratio=ratio)
        # Without friction both cones are the same ray, and only the octagon's multipliers stay positive.
        quadratic = 0 if smooth.any() else CONES[settings.friction_cone]
        own = int("own_friction" in self.layout.arrays)
        constants = {"QUADRATIC": quadratic, "GROUP": self.layout.group_size, "OWN_FRICTION": own}
        self.driver: CudaDriver = make_driver(constants, device)
        self._arrays = {name: self.driver.put(array) for name, array in self.layout.arrays.items()}
        addresses = {name: self.driver.address(array) for name, array in self._arrays.items()}
        self._structure = self.layout.kernel_structure(addresses)
        self._options = kernel_options(settings)
        self._chains: dict[bool, _Chain] = {}
        self._chunk = 1 << 20

    def check(
        self,
        states: States,
        *,
        certificates: bool = True,
        parents: States | None = None,
        guess: NDArray[np.float64] | None = None,
    ) -> Verdicts:
        """Check a batch of states.

        Args:
            states: checked states, shape (batch, parts).
            certificates: return forces, velocity and, under `contact`, displacement too.
            parents, guess: as for `CpuSolver.check`; parents are not used, guesses only under `equilibrium`.

        Returns:
            Verdicts; `UNDECIDED` where no proof was found within the limits of the settings.
        """
        batch = len(states)
        verdicts = self.problem.undecided(batch, certificates=certificates, displaced=self._contact)
        self._in_chunks(
            batch,
            certificates or guess is not None,
            lambda rows: self._check_rows(states, rows, certificates, guess, verdicts),
        )
        verdicts.proof[:] = proof_of(verdicts.verdict, self.settings.criterion)
        verdicts.decided_by[:] = np.where(verdicts.verdict != 0, Solver.GPU, Solver.NONE)
        return verdicts

    def check_tensor(self, states: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Check states that are already on the device, without synchronising or copying to the host.

        Args:
            states: checked states, `uint8` on the solver's device, contiguous, shape (batch, parts).

        Returns:
            Verdict, `int8`, and residual, `float64`, each of shape (batch,) on the device.
        """
        batch = len(states)
        verdict = self.driver.zeros((batch,), np.int8)
        residual = self.driver.empty((batch,), np.float64)
        iterations = self.driver.zeros((batch,), np.int32)
        self._in_chunks(
            batch, False, lambda rows: self._run(states[rows], None, verdict[rows], residual[rows], iterations[rows])
        )
        return verdict, residual

    def _in_chunks(self, batch: int, certificates: bool, work: Callable[[slice], None]) -> None:
        """Run `work` on ranges of rows that fit into device memory, halving them where they do not."""
        first = 0
        while first < batch:
            rows = slice(first, first + self._chunk_size(batch - first, certificates))
            try:
                work(rows)
            except RuntimeError as error:
                count = rows.stop - rows.start
                if "out of memory" not in str(error).lower() or count < 2:
                    raise
                self._chunk = count // 2
                warnings.warn(
                    f"the GPU ran out of memory on {count} states; continuing with {self._chunk} at a time",
                    MemoryWarning,
                    stacklevel=3,
                )
            else:
                first = rows.stop

    def _check_rows(
        self, states: States, rows: slice, certificates: bool, guess: NDArray | None, verdicts: Verdicts
    ) -> None:
        """Check some rows of a batch in host memory."""
        part, problem, driver = states[rows], self.problem, self.driver
        count, wanted, motion = len(part), certificates or guess is not None, (len(part), problem.parts, 6)
        found: dict[str, Any] = {
            "verdict": driver.zeros((count,), np.int8),
            "residual": driver.empty((count,), np.float64),
            "iterations": driver.zeros((count,), np.int32),
            "forces": driver.empty((count, problem.points, 3), np.float64) if wanted else None,
            "velocity": driver.empty(motion, np.float64) if certificates else None,
            "displacement": None if verdicts.displacement is None else driver.zeros(motion, np.float64),
        }
        self._run(driver.put(part), None if guess is None else driver.put(guess[rows]), **found)
        for name, array in found.items():
            kept = getattr(verdicts, name)
            if kept is not None and array is not None:
                kept[rows] = driver.get(array)
        if guess is not None:
            guess[rows] = driver.get(found["forces"])
        if verdicts.displacement is not None:
            verdicts.displacement[rows][~(verdicts.stable[rows] | verdicts.slides[rows])] = np.nan

    def _chunk_size(self, left: int, certificates: bool) -> int:
        parts = self.problem.parts * 48 * (1 + self._contact)
        each = self.problem.points * (12 + 24 * certificates) + parts * certificates
        return max(1, min(left, self._chunk, self.settings.numerics.gpu_bytes // max(each, 1)))

    def _run(
        self,
        states: Any,
        guess: Any,
        verdict: Any,
        residual: Any,
        iterations: Any,
        forces: Any = None,
        velocity: Any = None,
        displacement: Any = None,
    ) -> None:
        """Queue the launches that check a batch; all arguments are device arrays."""
        driver, count = self.driver, len(states)
        if count == 0:
            return
        chain = self._chain(count)
        address = driver.address
        lists = driver.empty((chain.lists, count), np.int32)
        counters = driver.zeros((2 * (chain.lists + 1),), np.int32)
        handoff = driver.empty((count, self.problem.points, 3), np.float32)

        def row(i: int) -> int:
            return address(lists) + i * count * 4

        def counter(i: int) -> int:
            return address(counters) + i * 4

        for stage in chain.stages:
            given: dict[str, Any] = {
                "states": states, "guess": guess, "verdict": verdict, "residual": residual, "iterations": iterations,
                "forces": forces, "velocity": velocity, "displacement": displacement, "handoff": handoff,
                "scratch": stage.scratch, "points_scratch": chain.by_group,
            }  # fmt: skip
            batch = KernelBatch(
                **{name: None if array is None else address(array) for name, array in given.items()},
                list=row(stage.takes) if stage.takes else None,
                list_count=counter(2 * stage.takes) if stage.takes else None,
                ticket=counter(2 * stage.takes + 1),
                large=row(stage.large),
                large_count=counter(2 * stage.large),
                open=row(chain.open),
                open_count=counter(2 * chain.open),
                open_ticket=counter(2 * chain.open + 1),
                rest=row(stage.rest),
                rest_count=counter(2 * stage.rest),
                scratch_stride=stage.pool,
                points_stride=self.layout.group_bytes(),
                pool_bytes=stage.pool,
                near=int(stage.scratch is not None and stage.shared > 0),
                count=count,
            )
            blocks = min(stage.blocks, count)
            driver.launch(stage.kernel, blocks, stage.threads, stage.shared, (self._structure, self._options, batch))

    def _chain(self, count: int) -> _Chain:
        """Return the launches for a batch of this size, and the lists by which states pass from one to the next.

        ADMM passes the states that it leaves undecided to the interior point method, by one list, and under `contact`
        those that are not unstable to the Newton iterations, by another. Both run in one launch where states fit on
        chip, so that the few states with very many iterations run beside the others.
        """
        few = count <= 2 * self.driver.multiprocessors
        if few not in self._chains:
            admm = self._admm_stages(few)
            left, rest, large, far = range(len(admm), len(admm) + 4)
            stages = [replace(stage, takes=i, large=i + 1, rest=rest) for i, stage in enumerate(admm)]
            if self._contact:
                stages += self._contact_stages(left, rest, large, far)
            else:
                first, *others = self._interior_stages()
                stages.append(replace(first, takes=left, large=large))
                stages += [replace(stage, takes=large) for stage in others]
            rows = max(stage.blocks for stage in stages if "admm" not in stage.kernel)
            by_group = self.driver.empty((rows * self.layout.group_bytes() // 8,), np.float64)
            self._chains[few] = _Chain(tuple(stages), left, by_group)
        return self._chains[few]

    def _contact_stages(self, left: int, rest: int, large: int, far: int) -> list[_Stage]:
        """Return the stages of interior point method and Newton iterations: on chip, and for states too large for that.

        Registers leave room for one block on a multiprocessor, so a launch for small states gains nothing.

        Args:
            left: list of the states that ADMM leaves undecided.
            rest: list of those that it does not prove unstable.
            large: list for states for which the interior point method needs more memory.
            far: list for states for which the Newton iterations need more memory.
        """
        layout, threads = self.layout, self.driver.most_threads
        largest, bytes_of_list = _aligned(layout.contact_bytes()), layout.contact_list_bytes()
        stages = self._on_chip("contact_shared", threads, max(layout.interior_bytes(), largest + bytes_of_list))
        if stages:
            stages = [replace(stages[0], takes=rest, large=large, rest=far)]
            left, rest = large, far
        shared = stages[0].shared if stages else 0
        if shared < layout.interior_bytes():
            stage = self._scratch_stage("interior_scratch", threads, layout.interior_bytes())
            stages.append(replace(stage, takes=left, rest=rest))
        if shared < largest:
            near = _aligned(layout.contact_near_bytes())
            near = near if near <= self._shared_limit else 0
            stages.append(replace(self._scratch_stage("contact_scratch", threads, largest, near), takes=rest))
        return stages

    def _admm_stages(self, few: bool) -> list[_Stage]:
        """Return the ADMM stages with one thread per group of contact points, from typical states to the largest."""
        layout, most = self.layout, self.driver.most_threads
        needed = -(-max(layout.groups, 1) // 32) * 32
        stages: list[_Stage] = []
        for share in (1.0,) if few else _ADMM_SHARES:
            threads = min(most, -(-int(share * needed) // 32) * 32)
            found = self._on_chip("admm_shared", threads, layout.admm_bytes(share))
            stages = [stage for stage in stages if stage.threads < threads or not found] + found
        if not stages or layout.groups > stages[-1].threads or layout.admm_bytes() > stages[-1].shared:
            stages.append(self._scratch_stage("admm_scratch", most, layout.admm_bytes(on_chip=False)))
        return stages

    def _interior_stages(self) -> list[_Stage]:
        """Return the single stage of the interior point method, on chip as far as it fits; few states need it."""
        largest, threads = self.layout.interior_bytes(), self.driver.most_threads
        stages = self._on_chip("interior_shared", threads, largest)
        if not stages or stages[0].shared < largest:
            stages.append(self._scratch_stage("interior_scratch", threads, largest))
        return stages

    def _on_chip(self, kernel: str, threads: int, largest: int) -> list[_Stage]:
        """Return the launch that processes on chip what fits there; none where not even all indices do."""
        shared = min(_aligned(largest), self._shared_limit)
        if shared < self.layout.index_bytes():
            return []
        return [_Stage(kernel, threads, shared, self.driver.blocks(kernel, threads, shared), None, shared)]

    def _scratch_stage(self, kernel: str, threads: int, largest: int, shared: int = 0) -> _Stage:
        largest = _aligned(largest)
        blocks = self.driver.blocks(kernel, threads, shared)
        scratch = self.driver.empty((blocks * largest // 8,), np.float64)
        return _Stage(kernel, threads, shared, blocks, scratch, largest)

    @property
    def _shared_limit(self) -> int:
        return (self.driver.shared_limit - _STATIC_SHARED) // 16 * 16


def _aligned(size: int) -> int:
    return -(-size // 16) * 16


def gpu_solver(assembly: Assembly, settings: StabilitySettings, problem: Problem) -> GpuSolver | None:
    """Return the GPU solver if the settings ask for it; with `auto`, only where there is a GPU."""
    if settings.solver not in ("auto", "gpu"):
        return None
    try:
        return GpuSolver(assembly, problem, settings)
    except InputError:  # no torch, no bindings or no device
        if settings.solver == "gpu":
            raise
        return None
