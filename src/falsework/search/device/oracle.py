"""Stability oracles on tensors: the GPU solver on the same device, or an oracle on the CPU."""

from __future__ import annotations

from copy import copy
from typing import TYPE_CHECKING, Protocol

from falsework.search.problem.oracle import Criterion, Oracle
from falsework.utils.tensors import put

if TYPE_CHECKING:
    import torch

    from falsework.stability.oracle import StabilityOracle


class TensorOracle(Criterion, Protocol):
    """Stability oracle for batches of states on a device; if `holds_keep_stable`, holds are not checked."""

    @property
    def holds_keep_stable(self) -> bool:
        """As of `Criterion`."""
        return False

    def __call__(self, states: torch.Tensor, parents: torch.Tensor) -> torch.Tensor:
        """Return verdicts, each with a proof found in float64.

        Args:
            states: `uint8`, contiguous, shape (batch, parts).
            parents: for each state a stable one that is one move away, shape (batch, parts).

        Returns:
            `Verdict` of each state, `int8`, on the same device, shape (batch,).
        """
        ...


class HostOracle:
    """Oracle on the CPU for states on any device."""

    def __init__(self, oracle: Oracle) -> None:
        self.holds_keep_stable = oracle.holds_keep_stable
        self._oracle = oracle

    def __call__(self, states: torch.Tensor, parents: torch.Tensor) -> torch.Tensor:
        """See `TensorOracle`."""
        verdicts = self._oracle.verdicts(states.cpu().numpy(), near=parents.cpu().numpy())
        return put(verdicts.verdict, states.device)


class DeviceOracle:
    """GPU solver; states that it leaves undecided go to the CPU solvers."""

    def __init__(self, oracle: StabilityOracle, device: torch.device) -> None:
        """Copy the problem to the device.

        Args:
            oracle: whose problem and settings are used, and whose solvers on the processor.
            device: a CUDA device.

        Raises:
            DependencyError: a package that the solver needs is not installed.
            InputError: no such device.
        """
        from falsework.stability.gpu.solver import GpuSolver

        self.holds_keep_stable = oracle.holds_keep_stable
        self.solver = GpuSolver(oracle.assembly, oracle.problem, oracle.settings, str(device))
        self.fallback: StabilityOracle | None = oracle

    def __call__(self, states: torch.Tensor, parents: torch.Tensor) -> torch.Tensor:
        """See `TensorOracle`."""
        verdict, _ = self.solver.check_tensor(states)
        if self.fallback is None:
            return verdict
        rest = (verdict == 0).nonzero()[:, 0]
        if len(rest):
            left, near = (given[rest].cpu().numpy() for given in (states, parents))
            verdict[rest] = put(self.fallback.verdicts(left, near=near).verdict, states.device)
        return verdict


def without_fallback(oracle: TensorOracle) -> TensorOracle:
    """Return an oracle for states that may stay undecided, such as those of training rollouts.

    On a GPU, marginally stable states stay undecided. They are a few in ten thousand of dome-72, and the exact solver
    needs a sixth of a second for each, while thousands of others wait.
    """
    if not isinstance(oracle, DeviceOracle):
        return oracle
    alone = copy(oracle)
    alone.fallback = None
    return alone


def tensor_oracle(oracle: StabilityOracle, device: torch.device) -> TensorOracle:
    """Return the oracle for states on a device: the GPU solver, or the CPU oracle behind copies."""
    return DeviceOracle(oracle, device) if device.type == "cuda" else HostOracle(oracle)
