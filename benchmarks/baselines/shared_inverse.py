"""Baseline after the paper: ADMM on its quadratic program with one constant inverse, in torch.

Eight tangential variables and one normal variable a contact point, and a slack wrench a part that takes up
everything on parts that are removed or held, make the matrix of the program the same for every state (paper,
equations 2 to 6 and 13). Only bounds and the linear term differ, so one inverse serves whole batches:

    min 1/2 |W (J x + g - s)|^2    with  0 <= x <= U c,  |s| <= U (1 - p),  0 <= mu x_n - sum x_t

where `c` says which contact points act, `p` which parts can move, `W^T W = M^-1`, and `U` bounds forces. The state
counts as stable once the residual that its clipped forces leave is within the tolerance, and as
unstable if that has not happened by the last iteration. Neither is a proof.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import Any, Literal, get_args

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike, NDArray

from falsework import Assembly, StabilitySettings, Verdict
from falsework.assembly import States
from falsework.assembly.state import as_states
from falsework.errors import DependencyError, InputError
from falsework.stability import Verdicts
from falsework.stability.exact_solver import block_diagonal, wrench_matrix
from falsework.stability.problem import Problem, build_problem
from falsework.stability.settings import EQUILIBRIUM
from falsework.stability.verdict import Solver

Array = NDArray[np.float64]
Inverse = Literal["dense", "reduced"]
Unsolved = Literal["unstable", "undecided"]
Precision = Literal["float64", "float32"]

TANGENTS = 8
VARIABLES = 1 + TANGENTS
"""Variables of a contact point: one normal, eight tangential."""


@dataclass(frozen=True)
class SharedInverseSettings:
    """Parameters of the paper, and settings of the computation."""

    iterations: int = 3000
    """Iterations after which a state counts as unsolved."""
    check_every: int = 200
    """Iterations between two looks at the residual."""
    penalty: float = 0.1
    """Penalty of ADMM in SI units. Scaling all densities by a factor and scaling penalty and force bound
    by it are the same thing, so this number is what decides how fast a structure converges."""
    regularisation: float = 1e-6
    """Proximal weight on the variables."""
    relaxation: float = 1.6
    """Over-relaxation."""
    force_bound: float = 1e5
    """Bound on every single variable, N."""
    unsolved: Unsolved = "unstable"
    """What a state is called that is not solved by the last iteration; the paper says unstable."""
    inverse: Inverse = "reduced"
    """`dense` multiplies by the inverse of the whole matrix, as the paper does; `reduced` applies the same
    inverse by the identity of Woodbury, through a matrix of six rows a part. The iterates are the same."""
    precision: Precision = "float64"
    device: str = "cpu"
    """Where torch computes, such as `cpu` or `cuda`."""
    batch: int = 64
    """States solved together; on a GPU use several hundred."""

    def __post_init__(self) -> None:
        for name in ("iterations", "check_every", "penalty", "regularisation", "force_bound", "batch"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise InputError(f"{name} is {value}; give a positive number")
        if not 0 < self.relaxation < 2:
            raise InputError(f"relaxation is {self.relaxation}; give a number between 0 and 2")
        for name, choices in (("unsolved", Unsolved), ("inverse", Inverse), ("precision", Precision)):
            if getattr(self, name) not in get_args(choices):
                raise InputError(f"unknown {name} {getattr(self, name)!r}; choose {' or '.join(get_args(choices))}")


class SharedInverse:
    """Solver of batches of states of one structure by the paper's method."""

    def __init__(
        self,
        assembly: Assembly,
        settings: StabilitySettings = EQUILIBRIUM,
        method: SharedInverseSettings = SharedInverseSettings(),
        problem: Problem | None = None,
    ) -> None:
        """Factor the matrix that all states share.

        Raises:
            DependencyError: torch is not installed.
            InputError: the quadratic cone, for which the paper has no variables, or no such device.
        """
        if settings.friction_cone != "octagon":
            raise InputError("the shared inverse knows only the octagon cone; choose cone octagon or another solver")
        try:
            self._torch: Any = import_module("torch")
        except ImportError:
            raise DependencyError("the shared inverse needs torch; run: pip install falsework[gpu]") from None
        self.assembly = assembly
        self.settings = settings
        self.method = method
        self.problem = problem or build_problem(assembly, gravity=settings.gravity)
        try:
            self._prepare()
        except RuntimeError as error:
            raise InputError(f"torch cannot compute on {method.device}: {str(error).splitlines()[0]}") from None

    def _prepare(self) -> None:
        problem, method = self.problem, self.method
        angle = np.arange(TANGENTS) * 2 * np.pi / TANGENTS
        spread = np.zeros((3, VARIABLES))  # nine variables to a force
        spread[0, 0], spread[1, 1:], spread[2, 1:] = 1.0, np.cos(angle), np.sin(angle)
        wrenches = wrench_matrix(problem, np.ones(problem.parts, bool), np.ones(problem.points, bool))
        # Boundary parts never move; the paper's code gives them unit mass, and so their rows unit weight.
        unit = np.where(problem.boundary[:, None, None], np.eye(6), problem.whitening)
        whiten = block_diagonal(unit)
        program = sp.csc_matrix(whiten @ sp.hstack([wrenches, -sp.eye(6 * problem.parts)]))
        row = np.array([problem.friction, *[-1.0] * TANGENTS])
        first, second = method.regularisation + method.penalty, method.penalty
        # Inverse of `first I + second row row^T`, the part of the matrix that belongs to one contact point.
        block = (np.eye(len(row)) - second * np.outer(row, row) / (first + second * row @ row)) / first
        across = spread @ block
        middle = self._on_all(across @ spread.T)
        inverse = np.linalg.inv(np.eye(6 * problem.parts) + sp.csc_matrix(program @ middle @ program.T).toarray())
        if method.inverse == "dense":
            half = sp.csc_matrix(program @ self._on_all(across)).toarray()
            inverse = self._on_all(block).toarray() - half.T @ inverse @ half
        self._inverse, self._block, self._across = self._tensor(inverse), self._tensor(block), self._tensor(across)
        self._first, self._spread = first, self._tensor(spread)
        self._program, self._program_back = self._sparse(program), self._sparse(program.T)
        measure = sp.diags(np.repeat(problem.measure, 3))
        self._wrenches, self._measured = self._sparse(wrenches), self._sparse(measure @ whiten.T @ whiten)
        self._whitened_gravity = self._tensor(whiten @ problem.gravity_wrench.ravel())
        self._gravity = self._tensor(problem.gravity_wrench.ravel())

    def _on_all(self, block: Array) -> sp.csc_matrix:
        """A matrix for one contact point on all of them, and the inverse weight of the slack wrenches on those."""
        slack = sp.eye(6 * self.problem.parts) / (self.method.regularisation + self.method.penalty)
        return sp.csc_matrix(sp.block_diag([sp.kron(sp.eye(self.problem.points), block), slack]))

    def check(self, states: ArrayLike) -> Verdicts:
        """Judge states; the forces are those that the method ends with, without proof.

        Args:
            states: one state `(parts,)` or a batch `(batch, parts)`.

        Returns:
            Verdicts with `Proof.NONE`; the residual is what the forces leave.

        Raises:
            StateError: states of the wrong length or with other values.
        """
        batch = as_states(states, self.assembly.boundary)
        verdicts = Verdicts.all_undecided(len(batch), points=self.problem.points, parts=self.problem.parts)
        torch = self._torch
        before = torch.get_float32_matmul_precision()
        torch.set_float32_matmul_precision("highest")  # shortened mantissas stop the iterations from converging
        try:
            with torch.no_grad():
                for begin in range(0, len(batch), self.method.batch):
                    rows = np.arange(begin, min(begin + self.method.batch, len(batch)))
                    verdicts.put(rows, self._check_batch(batch[rows]))
        finally:
            torch.set_float32_matmul_precision(before)
        return verdicts

    def _check_batch(self, states: States) -> Verdicts:
        torch, method, problem, bound = self._torch, self.method, self.problem, self.method.force_bound
        verdicts = Verdicts.all_undecided(len(states), points=problem.points, parts=problem.parts)
        free = self._tensor(np.repeat(states == 1, 6, axis=1).T)
        active = self._tensor(np.repeat(problem.active(states), VARIABLES, axis=1).T)
        pull = torch.sparse.mm(self._program_back, free * self._whitened_gravity[:, None])
        cost = self._join(self._spread.T, pull, 1.0)
        high = bound * torch.cat([active, 1 - free])
        low = torch.cat([torch.zeros_like(active), -bound * (1 - free)])
        x = torch.zeros_like(cost)
        z, y = torch.zeros_like(cost), torch.zeros_like(cost)
        z_row = torch.zeros((problem.points, len(states)), dtype=x.dtype, device=x.device)
        y_row = torch.zeros_like(z_row)
        rows = np.arange(len(states))
        for done in range(method.check_every, method.iterations + method.check_every, method.check_every):
            steps = min(method.check_every, method.iterations + method.check_every - done)
            x, z, y, z_row, y_row = self._iterate(steps, cost, low, high, x, z, y, z_row, y_row)
            forces = torch.clamp(x, low, high)[: len(active)]
            local = torch.matmul(self._spread, forces.view(problem.points, VARIABLES, -1))
            wrenches = torch.sparse.mm(self._wrenches, local.view(3 * problem.points, -1)) + self._gravity[:, None]
            residual = (torch.sparse.mm(self._measured, wrenches) * free).abs().amax(dim=0)
            solved = residual <= self.settings.tolerance
            last = done >= method.iterations
            out = solved | last
            if bool(out.any()):
                found, here = out.cpu().numpy(), rows[out.cpu().numpy()]
                verdicts.verdict[here] = np.where(solved.cpu().numpy()[found], Verdict.STABLE, self._unsolved)
                verdicts.residual[here] = residual[out].double().cpu().numpy()
                verdicts.iterations[here] = min(done, method.iterations)
                assert verdicts.forces is not None
                verdicts.forces[here] = local[:, :, out].permute(2, 0, 1).double().cpu().numpy()
                rows, keep = rows[~found], ~out
                free, active = free[:, keep], active[:, keep]
                cost, low, high = cost[:, keep], low[:, keep], high[:, keep]
                x, z, y, z_row, y_row = (part[:, keep] for part in (x, z, y, z_row, y_row))
            if not len(rows):
                break
        verdicts.decided_by[:] = np.where(verdicts.undecided, Solver.NONE, Solver.SHARED_INVERSE)
        return verdicts

    def _iterate(
        self, steps: int, cost: Any, low: Any, high: Any, x: Any, z: Any, y: Any, z_row: Any, y_row: Any
    ) -> tuple[Any, ...]:
        """ADMM in the form of OSQP (Stellato and others, 2020), on the variables and on one row a contact point."""
        torch, mu = self._torch, self.problem.friction
        r, sigma, alpha = self.method.penalty, self.method.regularisation, self.method.relaxation
        limit = mu * self.method.force_bound
        points = self.problem.points
        for _ in range(steps):
            right = sigma * x - cost + r * z - y
            row = r * z_row - y_row
            on_points = right[: VARIABLES * points].view(points, VARIABLES, -1)
            on_points[:, 0] += mu * row
            on_points[:, 1:] -= row[:, None]
            ahead = self._solve(right)
            ahead_points = ahead[: VARIABLES * points].view(points, VARIABLES, -1)
            ahead_row = mu * ahead_points[:, 0] - ahead_points[:, 1:].sum(dim=1)
            x = alpha * ahead + (1 - alpha) * x
            mixed, mixed_row = alpha * ahead + (1 - alpha) * z, alpha * ahead_row + (1 - alpha) * z_row
            z, z_row = torch.clamp(mixed + y / r, low, high), torch.clamp(mixed_row + y_row / r, 0.0, limit)
            y, y_row = y + r * (mixed - z), y_row + r * (mixed_row - z_row)
        return x, z, y, z_row, y_row

    def _solve(self, right: Any) -> Any:
        """Return the constant inverse times a batch of right-hand sides, shape (variables, batch)."""
        torch = self._torch
        if self.method.inverse == "dense":
            return self._inverse @ right
        points = self.problem.points
        on_points = right[: VARIABLES * points].view(points, VARIABLES, -1)
        near = torch.cat(
            [torch.matmul(self._across, on_points).view(3 * points, -1), right[VARIABLES * points :] / self._first]
        )
        back = torch.sparse.mm(self._program_back, self._inverse @ torch.sparse.mm(self._program, near))
        ahead = self._join(-self._across.T, back, -1 / self._first)
        ahead[: VARIABLES * points].view(points, VARIABLES, -1).add_(torch.matmul(self._block, on_points))
        ahead[VARIABLES * points :].add_(right[VARIABLES * points :], alpha=1 / self._first)
        return ahead

    def _join(self, turn: Any, local: Any, factor: float) -> Any:
        """Variables out of three numbers a contact point, times `turn`, and the slack wrenches, times `factor`."""
        points = self.problem.points
        on_points = self._torch.matmul(turn, local[: 3 * points].view(points, 3, -1))
        return self._torch.cat([on_points.view(VARIABLES * points, -1), factor * local[3 * points :]])

    @property
    def _unsolved(self) -> Verdict:
        return Verdict.UNSTABLE if self.method.unsolved == "unstable" else Verdict.UNDECIDED

    def _tensor(self, array: NDArray) -> Any:
        dtype = getattr(self._torch, self.method.precision)
        return self._torch.tensor(array, dtype=dtype, device=self.method.device)

    def _sparse(self, matrix: Any) -> Any:
        entries = sp.coo_matrix(matrix)
        index = np.vstack([entries.row, entries.col])
        with self._torch.sparse.check_sparse_tensor_invariants(True):
            return self._torch.sparse_coo_tensor(index, self._tensor(entries.data), entries.shape).coalesce()
