"""Laws of single functions of the GPU's source, which a compiler for the processor makes into a library."""

from __future__ import annotations

import ctypes
import subprocess
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from falsework.stability.gpu.driver import kernel_source
from tests.stability.conftest import COMPILER

CALLS = """
extern "C" void projections(int count, double mu, double* forces) {
  auto cone = Cone<double>::make(mu);
  for (double* f = forces; f < forces + 3 * count; f += 3) project(cone, f[0], f[1], f[2]);
}
extern "C" double power(double mu, const double* f) { return support(mu, f[0], f[1], f[2]); }
extern "C" int inverse(float* block) { return eliminate_block(block); }
extern "C" int inverses(float* blocks, int count) { return invert_blocks(blocks, count); }
extern "C" void rays(double* out) { for (int k = 0; k < 8; k++) out[2 * k] = ray_x(k), out[2 * k + 1] = ray_y(k); }
"""
Array = NDArray[np.float64]


@pytest.fixture(scope="module", params=[0, 1], ids=["octagon", "quadratic"])
def library(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[bool, ctypes.CDLL]:
    """Whether the cone is round, and the functions; without the kernels themselves, which take long to compile."""
    if COMPILER is None:
        pytest.skip("no C++ compiler for the functions")
    folder: Path = tmp_path_factory.mktemp("device")
    (folder / "device.cpp").write_text(kernel_source() + CALLS, encoding="utf-8")
    options = ["-std=c++17", "-O0", "-w", "-shared", "-fPIC", f"-DQUADRATIC={request.param}", "-DPART=99"]
    done = subprocess.run(
        [COMPILER, *options, "-o", "device.so", "device.cpp"], cwd=folder, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    found = ctypes.CDLL(str(folder / "device.so"))
    found.power.restype = ctypes.c_double
    return bool(request.param), found


def pointer(array: NDArray) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)


def projected(library: ctypes.CDLL, forces: Array, mu: float) -> Array:
    """Return forces projected on the cone of friction `mu`."""
    out = forces.copy()
    library.projections(len(out), ctypes.c_double(mu), pointer(out))
    return out


def powers(library: ctypes.CDLL, forces: Array, mu: float) -> Array:
    """Return the largest power of a force of the cone with normal component 1, for each of these motions."""
    return np.array([library.power(ctypes.c_double(mu), pointer(force)) for force in forces])


@pytest.mark.parametrize("mu", [0.0, 0.2, 0.7, 1.5])
def test_a_projection_leaves_a_force_of_the_polar_cone_that_does_no_work(
    library: tuple[bool, ctypes.CDLL], mu: float
) -> None:
    """Moreau: `x = P x + (x - P x)`, both parts orthogonal, the second with no power on any force of the cone."""
    forces = np.random.default_rng(1).standard_normal((500, 3))
    nearest = projected(library[1], forces, mu)
    rest = forces - nearest
    assert (nearest * rest).sum(axis=1) == pytest.approx(0.0, abs=1e-12)
    assert powers(library[1], rest, mu).max() <= 1e-12
    assert projected(library[1], nearest, mu) == pytest.approx(nearest, abs=1e-12)
    assert 0 < np.isclose(rest, 0.0).all(axis=1).sum() < 500 or mu == 0.0


@pytest.mark.parametrize("mu", [0.2, 1.5])
def test_projected_forces_keep_the_law_of_friction(library: tuple[bool, ctypes.CDLL], mu: float) -> None:
    """In the octagon whose corners lie on the circle, or in the circle."""
    nearest = projected(library[1], np.random.default_rng(2).standard_normal((500, 3)), mu)
    angles = np.arange(8) * np.pi / 4
    if library[0]:
        slip, most = np.hypot(nearest[:, 1], nearest[:, 2]), 1.0
    else:
        middles = np.stack([np.cos(angles + np.pi / 8), np.sin(angles + np.pi / 8)])
        slip, most = (nearest[:, 1:] @ middles).max(axis=1), np.cos(np.pi / 8)
    assert (nearest[:, 0] >= 0.0).all()
    assert (slip <= mu * most * nearest[:, 0] + 1e-12).all()


def test_the_power_is_that_of_the_best_ray(library: tuple[bool, ctypes.CDLL]) -> None:
    corners = np.empty((8, 2))
    library[1].rays(pointer(corners))
    assert np.hypot(*corners.T) == pytest.approx(1.0)
    angles = np.linspace(0, 2 * np.pi, 3601)
    edge = np.stack([np.cos(angles), np.sin(angles)], axis=1) if library[0] else corners
    motions = np.random.default_rng(3).standard_normal((50, 3))
    best = (motions[:, :1] + 0.6 * motions[:, 1:] @ edge.T).max(axis=1)
    assert powers(library[1], motions, 0.6) == pytest.approx(best, abs=1e-5)


@pytest.mark.parametrize("kind", ["any", "rows in another order", "a zero for a pivot"])
def test_blocks_are_inverted(library: tuple[bool, ctypes.CDLL], kind: str) -> None:
    """Alone by row pivoting, in batches without where that is safe."""
    random = np.random.default_rng(4)
    blocks = random.standard_normal((20, 6, 6)) + 4 * np.eye(6)
    if kind == "rows in another order":
        blocks = np.stack([block[random.permutation(6)] for block in blocks])
    elif kind == "a zero for a pivot":
        blocks[:, 0, 0] = 0.0
    alone = blocks.astype(np.float32)
    together = alone.copy()
    assert all(library[1].inverse(pointer(block)) for block in alone)
    assert library[1].inverses(pointer(together), len(together))
    for found in (alone, together):
        assert np.abs(found @ blocks - np.eye(6)).max() < 1e-3


def test_a_singular_block_is_said_and_stays(library: tuple[bool, ctypes.CDLL]) -> None:
    block = np.zeros((6, 6), np.float32)
    block[0] = 1.0
    blocks = np.stack([np.eye(6, dtype=np.float32), block])
    alone = block.copy()
    assert not library[1].inverse(pointer(alone))
    assert not library[1].inverses(pointer(blocks), 2)
    assert np.array_equal(alone, block)
    assert np.array_equal(blocks[0], np.eye(6, dtype=np.float32))
