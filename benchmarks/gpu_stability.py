"""Time the stability solver on one GPU, on the states that a beam search checks: one JSON object per line.

    python benchmarks/gpu_stability.py
    python benchmarks/gpu_stability.py --structures vault:parts=100 --batches 1024 --baseline 0

Without names: vault-62, dome-72 and bottle-12 where they are found (FALSEWORK_DATA, else the folder `shared`
beside the repository), else built-in ones, each under both criteria on the same states. Times are medians of
events on the device, states and verdicts already there; `check_ms` is a whole call with states and certificates
crossing to the host. Verdicts are compared with the CPU solver, certificates with the checker.
`graph` is the same ADMM as batched dense algebra in a captured graph, without proofs, as the alternative to the
kernel; `shared_inverse` is the paper's method; both only under `equilibrium`. `--states` names a folder in which
the states of searches are kept.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from baselines.shared_inverse import SharedInverse, SharedInverseSettings
from record import report, write_to
from states import asked_states, find, real_structures

from falsework import Assembly, StabilitySettings, Verdict, load_structure, verify_certificates
from falsework.stability.contact.solver import ContactSolver
from falsework.stability.cpu.solver import CpuSolver
from falsework.stability.gpu.solver import GpuSolver
from falsework.stability.problem import Problem, build_problem
from falsework.stability.verdict import Criterion

_MOST = 1 << 16
"""Largest number of states of one structure."""
REAL = ("vault-62", "dome-72", "bottle-12")
BUILT_IN = ("vault", "dome", "bottle")


@dataclass(frozen=True)
class Options:
    """Structures, criteria and batch sizes to time."""

    structures: tuple[str, ...] = ()
    """Built-in names or paths; empty for a choice of real or built-in ones."""
    criteria: tuple[Criterion, ...] = ("equilibrium", "contact")
    """Stability criteria."""
    batches: tuple[int, ...] = (1024, 4096, 16384)
    """States per call."""
    repeats: int = 5
    """Medians of nine calls for each size of batch."""
    width: int = 64
    """Width of the search that the states come from."""
    robots: int = 2
    """Robots of the search."""
    states: Path | None = None
    """Folder that keeps the states of searches from one run to the next."""
    baseline: int = 256
    """States for the shared inverse; 0 leaves it out."""
    graph: int = 1024
    """States for the captured graph; 0 leaves it out."""
    out: Path | None = None
    """File to which the records are appended."""


def states_of_search(assembly: Assembly, options: Options) -> np.ndarray:
    """Return distinct states that a beam search checks, in random order."""
    kept = None if options.states is None else options.states / f"{assembly.name}.npz"
    if kept is not None and kept.is_file():
        return np.load(kept)["states"]
    states, _ = asked_states(assembly, _MOST, width=options.width, robots=options.robots)
    if kept is not None:
        kept.parent.mkdir(parents=True, exist_ok=True)
        np.savez_compressed(kept, states=states)
    return states


def median_ms(call: Callable[[], object], repeats: int = 9) -> float:
    """Return the median time on the device."""
    call()
    times = []
    for _ in range(repeats):
        begin, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
        begin.record()
        call()
        end.record()
        torch.cuda.synchronize()
        times.append(begin.elapsed_time(end))
    return float(np.median(times))


def ceilings() -> dict[str, Any]:
    """Measure the limits of the chip: copies, and products of random matrices."""
    rates = {}
    source = torch.rand(1 << 30, dtype=torch.float32, device="cuda")
    target = torch.empty_like(source)
    rates["copy_tb_per_s"] = 2 * 4 * source.numel() / median_ms(lambda: target.copy_(source)) / 1e9
    torch.backends.cuda.matmul.allow_tf32 = False
    for name, dtype in (("float32", torch.float32), ("float64", torch.float64), ("bfloat16", torch.bfloat16)):
        left, right = (torch.randn(8192, 8192, device="cuda").to(dtype) for _ in range(2))
        rates[f"{name}_tflop_per_s"] = 2 * 8192**3 / median_ms(lambda a=left, b=right: a @ b, 3) / 1e9
    return {name: round(rate, 2) for name, rate in rates.items()}


class CapturedGraph:
    """ADMM as batched dense algebra at full size, float32, all iterations in one captured graph."""

    def __init__(self, problem: Problem, batch: int, iterations: int, rho: float = 1e-3, alpha: float = 1.3) -> None:
        self.problem, self.batch, self.iterations, self.rho, self.alpha = problem, batch, iterations, rho, alpha
        rows, columns = 6 * problem.parts, 3 * problem.points
        matrix = np.zeros((problem.parts, 6, problem.points, 3))
        pair = np.repeat(np.arange(problem.pairs), np.diff(problem.pair_start))
        points = np.arange(problem.points)
        for part, transfer in (
            (problem.geometry.part_a, problem.transfer_a),
            (problem.geometry.part_b, problem.transfer_b),
        ):
            matrix[part, :, points] += transfer[pair] @ problem.basis
        self.map = torch.tensor(matrix.reshape(rows, columns), dtype=torch.float32, device="cuda")
        self.gravity = torch.tensor(problem.scaled_gravity.reshape(rows, 1), dtype=torch.float32, device="cuda")
        self.free = torch.zeros((rows, batch), device="cuda")
        self.acts = torch.zeros((columns, batch), device="cuda")
        self.inverse = torch.zeros((batch, rows, rows), device="cuda")
        self.u = torch.zeros((columns, batch), device="cuda")
        self.iterate()
        torch.cuda.synchronize()
        self.graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(self.graph):
            self.iterate()

    def iterate(self) -> None:
        """Run all iterations from zero, without termination tests."""
        self.u.zero_()
        z = self.u
        for _ in range(self.iterations):
            right = self.free * (self.map @ (2 * z - self.u) + self.gravity)
            w = torch.bmm(self.inverse, right.T[:, :, None])[:, :, 0].T
            self.u += self.alpha * (z - self.u - self.acts * (self.map.T @ w))
            z = self.project(self.u)

    def project(self, u: torch.Tensor) -> torch.Tensor:
        """Return the nearest points of the octagonal cone."""
        mu, c, s = self.problem.friction, np.cos(np.pi / 8), np.sin(np.pi / 8)
        n, x, y = u.view(-1, 3, self.batch).unbind(1)
        high, low = torch.maximum(x.abs(), y.abs()), torch.minimum(x.abs(), y.abs())
        p, q, k = high * c + low * s, low * c - high * s, mu * c
        t = (n + k * p) / (1 + k * k)
        edge = (n + k * p + mu * s * q.abs()).clamp(min=0) / (1 + mu * mu)
        facet = (t > 0) & (q.abs() <= mu * s * t)
        height = torch.where(facet, t, edge)
        q = torch.where(facet, q, torch.copysign(mu * s * edge, q))
        along, across = k * height * c - q * s, k * height * s + q * c
        swap, inside = y.abs() > x.abs(), p <= k * n
        out = torch.stack(
            [
                torch.where(inside, n, height),
                torch.where(inside, x, torch.copysign(torch.where(swap, across, along), x)),
                torch.where(inside, y, torch.copysign(torch.where(swap, along, across), y)),
            ],
            dim=1,
        )
        return out.view_as(u)

    def load(self, free: torch.Tensor, acts: torch.Tensor) -> None:
        """Factor and invert `S` of every state at full size."""
        self.free.copy_(free)
        self.acts.copy_(acts)
        rows = len(self.map)
        part = free.T[:, :, None] * (self.map * acts.T[:, None, :])
        s = part @ part.transpose(1, 2) + self.rho * torch.eye(rows, device="cuda")
        self.inverse.copy_(torch.cholesky_inverse(torch.linalg.cholesky(s)))


def time_graph(problem: Problem, states: np.ndarray, iterations: int) -> dict[str, float]:
    """Return milliseconds per state for inverses and iterations."""
    graph = CapturedGraph(problem, len(states), iterations)
    free = torch.tensor(np.repeat(states == 1, 6, axis=1).T, dtype=torch.float32, device="cuda")
    acts = torch.tensor(np.repeat(problem.active(states), 3, axis=1).T, dtype=torch.float32, device="cuda")
    inverse = median_ms(lambda: graph.load(free, acts), 3) / len(states)
    iterate = median_ms(graph.graph.replay, 5) / len(states)
    return {"inverse_ms": round(inverse, 5), "iterations_ms": round(iterate, 5), "iterations": iterations}


def time_structure(assembly: Assembly, states: np.ndarray, criterion: Criterion, options: Options) -> dict[str, Any]:
    """Return all figures of one structure under one criterion."""
    settings = StabilitySettings(criterion=criterion)
    problem = build_problem(assembly, cone=settings.friction_cone)
    begin = time.perf_counter()
    solver = GpuSolver(assembly, problem, settings)
    verdicts = solver.check(states, certificates=False)
    first = time.perf_counter() - begin
    contact = criterion == "contact"
    processor = ContactSolver(assembly, problem, settings) if contact else CpuSolver(problem, settings)
    expected = processor.check(states, certificates=False)
    sample = states[:2048]
    proven = solver.check(sample)
    result: dict[str, Any] = {
        "structure": assembly.name,
        "criterion": criterion,
        "cone": settings.friction_cone,
        "parts": problem.parts,
        "points": problem.points,
        "states": len(states),
        "first_call_s": round(first, 2),
        "same_as_cpu": int((verdicts.verdict == expected.verdict).sum()),
        "verdicts": {kind.name.lower(): int((verdicts.verdict == kind).sum()) for kind in Verdict},
        "iterations": np.percentile(verdicts.iterations[verdicts.stable], [50, 95, 100]).tolist(),
        "certificates": len(sample),
        "accepted": int(verify_certificates(assembly, sample, proven, settings.claim).sum()),
        "ms_a_state": {},
        "check_ms": {},
    }
    for batch in options.batches:
        chosen = np.resize(states, (batch, states.shape[1]))
        tensor = torch.from_numpy(chosen).cuda()
        medians = [median_ms(lambda tensor=tensor: solver.check_tensor(tensor)) for _ in range(options.repeats)]
        result["ms_a_state"][batch] = [round(median / batch, 6) for median in medians]
        begin = time.perf_counter()
        solver.check(chosen)
        result["check_ms"][batch] = round((time.perf_counter() - begin) / batch * 1e3, 5)
    singles = [torch.from_numpy(states[i : i + 1].copy()).cuda() for i in range(min(50, len(states)))]
    alone = [median_ms(lambda state=state: solver.check_tensor(state), 3) for state in singles]
    result["batch_of_one_ms"] = {"median": round(float(np.median(alone)), 3), "most": round(max(alone), 3)}
    if options.graph and not contact:
        chosen = np.resize(states, (options.graph, states.shape[1]))
        result["graph"] = time_graph(problem, chosen, solver.settings.numerics.iterations)
    if options.baseline and not contact:
        result["shared_inverse"] = time_baseline(assembly, problem, solver, states[: options.baseline])
    return result


def time_baseline(assembly: Assembly, problem: Problem, solver: GpuSolver, states: np.ndarray) -> dict[str, Any]:
    """Time the paper's method in float64 on the same states."""
    method = SharedInverseSettings(device="cuda", batch=len(states), inverse="dense")
    baseline = SharedInverse(assembly, method=method, problem=problem)
    baseline.check(states[:8])
    begin = time.perf_counter()
    answers = baseline.check(states)
    each = (time.perf_counter() - begin) / len(states) * 1e3
    right = solver.check(states, certificates=False)
    return {"ms_a_state": round(each, 4), "states": len(states), "wrong": int((answers.verdict != right.verdict).sum())}


def main(options: Options) -> None:
    """Run the benchmark."""
    write_to(options.out)
    report("gpu_stability ceilings", **ceilings(), device="cuda")
    for name in options.structures or real_structures(REAL) or BUILT_IN:
        assembly = load_structure(find(name))
        states = states_of_search(assembly, options)
        for criterion in options.criteria:
            figures = time_structure(assembly, states, criterion, options)
            report("gpu_stability", **figures, device="cuda", seeds=(0,))


if __name__ == "__main__":
    main(tyro.cli(Options))
