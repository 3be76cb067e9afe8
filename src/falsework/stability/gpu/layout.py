"""GPU layout of a structure: elimination by levels, contact points in groups, arrays by columns."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from falsework.errors import InputError
from falsework.stability.problem import Problem
from falsework.stability.settings import StabilitySettings

_GROUP_SIZES = (3, 4, 5, 6)
"""Largest numbers of contact points of a group, of which the one with the least cost is compiled."""
_GROUP_COST = 3
"""Fixed cost of a group of contact points, in contact points."""
_INT_FIELDS = ("parts", "positions", "groups", "blocks", "levels", "points", "products")
_DOUBLE_OPTIONS = ("rho", "relaxation", "tolerance", "resolution", "force_bound", "first_step")
_INT_OPTIONS = ("iterations", "check_every", "interior_steps", "contact_steps")
_SCALAR_FIELDS = ("weight", "friction", "length", "tangential", "unit", "limit")
_ARRAY_FIELDS = (
    *("position", "level_start", "column", "block_row", "block_column", "fill_start", "fill_left", "fill_right"),
    *("group_part", "group_first", "group_count", "incident_start", "incident", "block_start", "block_group"),
    *("point_single", "point", "arm_single", "arm", "local_single", "mass", "inertia", "flexibility", "gravity"),
    *("gyration", "reach", "stiffness", "own_friction"),
)
_BATCH_FIELDS = (
    *("states", "guess", "verdict", "residual", "iterations", "forces", "velocity", "displacement", "handoff"),
    *("list", "list_count", "ticket", "large", "large_count", "open", "open_count", "open_ticket", "rest"),
    *("rest_count", "scratch"),
)


class KernelStructure(ctypes.Structure):
    """Struct `Structure` of the kernel."""

    _fields_ = [
        *((name, ctypes.c_int) for name in _INT_FIELDS),
        *((name, ctypes.c_void_p) for name in _ARRAY_FIELDS),
        *((name, ctypes.c_double) for name in _SCALAR_FIELDS),
    ]


class KernelOptions(ctypes.Structure):
    """Struct `Options` of the kernel."""

    _fields_ = [
        *((name, ctypes.c_double) for name in _DOUBLE_OPTIONS),
        *((name, ctypes.c_int) for name in _INT_OPTIONS),
    ]


class KernelBatch(ctypes.Structure):
    """Struct `Batch` of the kernel."""

    _fields_ = [
        *((name, ctypes.c_void_p) for name in _BATCH_FIELDS),
        ("scratch_stride", ctypes.c_longlong),
        ("points_scratch", ctypes.c_void_p),
        ("points_stride", ctypes.c_longlong),
        ("pool_bytes", ctypes.c_longlong),
        ("near", ctypes.c_int),
        ("count", ctypes.c_int),
    ]


@dataclass(frozen=True)
class Layout:
    """Arrays of one structure as the kernel reads them; see `Structure` in `gpu/kernels/common.cuh`."""

    sizes: dict[str, int]
    arrays: dict[str, NDArray]
    weight: float
    friction: float
    length: float
    """Unit of length of the arrays, metres."""
    group_size: int
    """Most contact points per group."""
    ancestors: int
    """Number of pairs of a part and one of its ancestors in the elimination tree of the complete structure."""
    tangential: float = 0.0
    """Ratio of tangential to normal stiffness, under the criterion `contact`."""
    unit: float = 0.0
    """Displacement of a unit variable, m, under the criterion `contact`."""
    limit: float = 0.0
    """Movement of a part that counts as collapsing, m, under the criterion `contact`."""

    def kernel_structure(self, addresses: dict[str, int]) -> KernelStructure:
        """Return the argument of the kernel, given the address of each array."""
        scalars = {name: getattr(self, name) for name in _SCALAR_FIELDS}
        return KernelStructure(**self.sizes, **addresses, **scalars)

    @property
    def groups(self) -> int:
        """Number of groups of contact points of the whole structure."""
        return self.sizes["groups"]

    def admm_bytes(self, share: float = 1.0, *, on_chip: bool = True) -> int:
        """Return the memory for ADMM on a state with this share of the structure; iterates may stay in registers."""
        n, groups, blocks = self._counts(share)
        points = 0 if on_chip else groups * self.group_size
        return self._index_bytes(share) + 4 * (36 * (n + blocks) + 18 * n + 6 * points) + 96 * groups

    def interior_bytes(self) -> int:
        """Return the memory for the interior point method on the largest state."""
        n, blocks = self.sizes["positions"], self.sizes["blocks"]
        return self._stored_bytes() + 8 * (36 * (n + blocks) + 30 * n)

    def contact_bytes(self) -> int:
        """Return the memory for the Newton iterations under `contact` on the largest state."""
        n, blocks = self.sizes["positions"], self.sizes["blocks"]
        return self._stored_bytes() + 4 * (36 * (n + 2 * blocks) + 66 * n) + self._product_index_bytes()

    def contact_list_bytes(self) -> int:
        """Return the additional memory for products of the factor, and wrenches and stiffness of all groups."""
        return 240 * self.groups + 4 * self.sizes["products"] + 80

    def contact_near_bytes(self) -> int:
        """Return the memory for the same without the matrices, on the largest state."""
        return self._stored_bytes() + 4 * 66 * self.sizes["positions"]

    def group_bytes(self) -> int:
        """Return the memory for the group data of the later methods, and the products where these are stored there."""
        interior = self.groups * (self.group_size * 16 + 21 + 12) * 8
        contact = self.groups * (self.group_size * 48 + 240) + 4 * self.sizes["products"] + 16
        return max(interior, -(-contact // 16) * 16)

    def index_bytes(self) -> int:
        """Return the memory for the indices of the largest state, which every launch needs to reject a state."""
        return self._index_bytes(1.0)

    def _stored_bytes(self) -> int:
        """Return the memory for the indices of the largest state whose factor is stored without its zeros."""
        return self._index_bytes(1.0) + 2 * (self.ancestors + self.sizes["blocks"] + self.sizes["positions"]) + 64

    def _product_index_bytes(self) -> int:
        """Return the memory for row and column of each block of the factor, and where its products begin."""
        n, blocks = self.sizes["positions"], self.sizes["blocks"]
        return 8 * blocks + 4 * (n + 1) + 48

    def _counts(self, share: float) -> tuple[int, int, int]:
        """Return the numbers of nodes, groups and blocks of the inverse factor; smaller states have fewer ancestors."""
        n, groups = (-int(-share * self.sizes[name] // 1) for name in ("positions", "groups"))
        return n, groups, -int(-(share**1.5) * self.ancestors // 1)

    def _index_bytes(self, share: float) -> int:
        n, groups, blocks = self._counts(share)
        whole = self.sizes["positions"] * 4 + self.sizes["levels"] * 2 + self.groups * 8 + self.sizes["blocks"]
        most = max(self.sizes["positions"], self.groups)
        return whole + most // 8 + 4 * groups + 16 * n + 10 * blocks + 32 * 16  # arrays start at 16 bytes


def kernel_options(settings: StabilitySettings) -> KernelOptions:
    """Return the argument of the kernel from the settings."""
    numerics, contact = settings.numerics, settings.criterion == "contact"
    shared = {name: getattr(numerics, name) for name in ("rho", "relaxation", "first_step", *_INT_OPTIONS)}
    return KernelOptions(
        **(shared | ({} if contact else {"contact_steps": 0})),
        tolerance=settings.tolerance,
        resolution=settings.claim.well_below,
        force_bound=settings.force_bound,
    )


def build_layout(problem: Problem) -> Layout:
    """Lay out a problem for the kernel.

    Raises:
        InputError: the structure has more contacts or fill than the kernel can index.
    """
    pattern = _eliminate(problem)
    # Contact points of a pair per thread: the size with the least waste.
    group_size = min(_GROUP_SIZES, key=lambda size: (size + _GROUP_COST) * len(_groups(problem, size)[0]))
    first, count, pair = _groups(problem, group_size)
    groups, n = len(first), len(pattern["column"]) - 1
    if max(groups, len(pattern["block_row"]), n) >= np.iinfo(np.int16).max:
        raise InputError(
            f"{groups} groups of contact points and {len(pattern['row'])} blocks of fill are more than the GPU solver "
            f"can index ({np.iinfo(np.int16).max}); use solver='cpu'"
        )
    position = pattern["position"]
    part = problem.pair_parts[pair].T.copy() if groups else np.zeros((2, 0), np.int32)
    block = pattern.pop("pair_block")[pair]
    incident_start, incident = _lists(position[part].T.ravel(), np.arange(2 * groups), n)
    block_start, block_group = _lists(block, np.arange(groups), len(pattern["block_row"]))
    arrays: dict[str, NDArray] = {
        **pattern,
        "group_part": part,
        "group_first": first,
        "group_count": count,
        "incident_start": incident_start,
        "incident": incident,
        "block_start": block_start,
        "block_group": block_group,
    }
    arrays = {name: np.ascontiguousarray(array, dtype=np.int32) for name, array in arrays.items()}
    mechanics, length = _mechanics(problem, first, count, pair, position, group_size)
    arrays |= mechanics
    sizes = {
        "parts": problem.parts,
        "positions": n,
        "groups": groups,
        "blocks": len(pattern["block_row"]),
        "levels": len(pattern["level_start"]) - 1,
        "points": problem.points,
        "products": len(arrays["fill_left"]) + len(pattern["block_row"]),
    }
    return Layout(sizes, arrays, problem.weight, problem.friction, length, group_size, _ancestors(pattern))


def add_contact(
    layout: Layout,
    normal: NDArray[np.float64],
    scale: float,
    limit: float,
    *,
    reach: NDArray[np.float64],
    gravity: float,
    ratio: float,
) -> Layout:
    """Add stiffness and units of displacement to a layout.

    The kernel measures lengths in `layout.length`, masses in the mean mass and accelerations in gravity. With
    displacements in `scale * gravity` metres, `scale` as in `ContactArrays`, the stiffness of a point has the same
    value as on the CPU.

    Args:
        layout: layout of the structure.
        normal, scale, limit: its stiffness and units, see `contact_units`.
        reach: as `reach_of` returns it.
        gravity: m/s2.
        ratio: ratio of tangential to normal stiffness.
    """
    position = layout.arrays["position"]
    at = np.flatnonzero(position >= 0)
    corner = np.zeros(len(at))
    corner[position[at]] = reach[at] / layout.length
    first, count = layout.arrays["group_first"], layout.arrays["group_count"]
    stiffness = np.zeros((layout.group_size, layout.groups))
    for i in range(layout.group_size):
        rows = np.flatnonzero(count > i)
        stiffness[i, rows] = normal[first[rows] + i]
    arrays = {**layout.arrays, "reach": corner, "stiffness": stiffness}
    return replace(layout, arrays=arrays, tangential=ratio, unit=scale * gravity, limit=limit)


def _eliminate(problem: Problem) -> dict[str, NDArray]:
    """Return the symbolic elimination in an order whose tree is shallow, with positions numbered level by level.

    Minimum degree, ties broken by the fewest levels below: the fill of minimum degree with a fifth fewer levels
    (vault-62 17 instead of 21, dome-72 24 instead of 30); a solve is sequential in the levels.
    """
    removable = np.flatnonzero(~problem.boundary)
    neighbours: dict[int, set[int]] = {int(part): set() for part in removable}
    for a, b in problem.pair_parts.tolist():
        if a in neighbours and b in neighbours:
            neighbours[a].add(b)
            neighbours[b].add(a)
    level = dict.fromkeys(neighbours, 0)
    below: dict[int, set[int]] = {}
    while neighbours:
        part = min(neighbours, key=lambda candidate: (len(neighbours[candidate]), level[candidate], candidate))
        below[part] = clique = neighbours.pop(part)
        for other in clique:
            neighbours[other] |= clique
            neighbours[other] -= {other, part}
            level[other] = max(level[other], level[part] + 1)

    order = sorted(below, key=lambda part: level[part])  # stable sort: a part comes after all that it depends on
    n = len(order)
    position = np.full(problem.parts, -1)
    position[order] = np.arange(n)
    rows = [sorted(int(position[other]) for other in below[part]) for part in order]
    column = np.cumsum([0] + [len(entries) for entries in rows])
    row = np.array([i for entries in rows for i in entries], dtype=np.int64)
    block_column = np.repeat(np.arange(n), np.diff(column))
    block_of = {(int(i), int(j)): e for e, (i, j) in enumerate(zip(row, block_column, strict=True))}
    fill: list[list[tuple[int, int]]] = [[] for _ in row]
    for j in range(n):
        for right in range(column[j], column[j + 1]):
            for left in range(right + 1, column[j + 1]):
                fill[block_of[int(row[left]), int(row[right])]].append((left, right))
    pairs = np.array([pair for entries in fill for pair in entries], dtype=np.int64).reshape(-1, 2)
    pair_block = [
        block_of[max(i, j), min(i, j)] if i >= 0 and j >= 0 else -1 for i, j in position[problem.pair_parts].tolist()
    ]
    depth = max(level.values(), default=-1) + 1
    return {
        "position": position,
        "level_start": np.searchsorted([level[part] for part in order], np.arange(depth + 1)),
        "column": column,
        "block_row": row,
        "block_column": block_column,
        "fill_start": np.cumsum([0] + [len(entries) for entries in fill]),
        "fill_left": pairs[:, 0],
        "fill_right": pairs[:, 1],
        "pair_block": np.array(pair_block, dtype=np.int64),
    }


def _ancestors(pattern: dict[str, NDArray]) -> int:
    column, row = pattern["column"], pattern["block_row"]
    depth = np.zeros(len(column), dtype=np.int64)
    for j in range(len(column) - 2, -1, -1):
        if column[j + 1] > column[j]:
            depth[j] = depth[row[column[j]]] + 1
    return int(depth.sum())


def _groups(problem: Problem, size: int) -> tuple[NDArray, NDArray, NDArray]:
    """Cut pairs into even groups of at most `size` points; return first point, number of points and pair of each."""
    runs = []
    for q in range(problem.pairs):
        start, stop = int(problem.pair_start[q]), int(problem.pair_start[q + 1])
        for run in np.array_split(np.arange(start, stop), -(-(stop - start) // size)):
            runs.append((run[0], len(run), q))
    first, count, pair = np.array(runs, dtype=np.int64).reshape(-1, 3).T
    return first, count, pair


def _lists(keys: NDArray, values: NDArray, count: int) -> tuple[NDArray, NDArray]:
    """Return values by key in compressed rows; negative keys are left out."""
    keep = keys >= 0
    keys, values = keys[keep], values[keep]
    start = np.concatenate([[0], np.cumsum(np.bincount(keys, minlength=count))])
    return start, values[np.argsort(keys, kind="stable")]


def _mechanics(
    problem: Problem, first: NDArray, count: NDArray, pair: NDArray, position: NDArray, size: int
) -> tuple[dict[str, NDArray], float]:
    """Return masses, lever arms and contact points, in float64 and for ADMM in float32 too; and the unit of length.

    Lengths are in units of the mean radius of gyration, masses of the mean mass, accelerations of gravity, so
    that rounding in float32 is the same at any size of the structure.
    """
    groups = len(first)
    order = np.argsort(np.where(position < 0, len(position), position))[: int((position >= 0).sum())]
    factor = problem.momentum[order]
    gravity, gyration = 1 / problem.measure[0, 0], problem.measure[order, 1] / problem.measure[order, 0]
    mass = factor[:, 0, 0] ** 2
    length, heavy = (float(each.mean()) if len(order) else 1.0 for each in (gyration, mass))
    axes, moments = problem.basis[:, :3] / np.sqrt(heavy), problem.basis[:, 3:] / (np.sqrt(heavy) * length)
    basis = np.concatenate([axes, moments], axis=1)
    norm = (axes**2).sum(axis=(1, 2))  # three orthogonal axes of one length: sum of a x (r x a) is 2/3 norm r
    arms = 1.5 * np.cross(axes, moments, axis=1).sum(axis=2) / norm[:, None]
    point, own = np.zeros((size, 13, groups)), np.zeros((size, groups))
    point[:, 12] = 1.0
    for i in range(size):
        rows = np.flatnonzero(count > i)
        at = first[rows] + i
        own[i, rows] = problem.strength.friction[at]
        point[i, :9, rows] = axes[at].reshape(-1, 9)
        point[i, 9:12, rows] = arms[at]
        point[i, 12, rows] = problem.force_scale[at] * np.sqrt(heavy) * gravity
    stiffness = np.zeros((groups, 6, 6))
    np.add.at(stiffness, np.repeat(np.arange(groups), count), basis @ basis.transpose(0, 2, 1))

    arm = np.zeros((6, groups))
    for side, (transfer, sign) in enumerate(((problem.transfer_a, -1.0), (problem.transfer_b, 1.0))):
        # Undo the whitening, which leaves [1 0; arm x 1]. Boundary parts have zeros, which are never used.
        shift = sign * problem.momentum[problem.pair_parts[:, side]] @ transfer
        arm[side * 3 : side * 3 + 3] = np.stack([shift[:, 5, 1], shift[:, 3, 2], shift[:, 4, 0]])[:, pair] / length
    inertia = factor[:, 3:, 3:] @ factor[:, 3:, 3:].transpose(0, 2, 1) / (heavy * length**2)
    turn = problem.acceleration[order][:, 3:, 3:]
    flexibility = turn @ turn.transpose(0, 2, 1) * (heavy * length**2)
    single = point[:, :12].reshape(size, 3, 4, groups).transpose(0, 1, 3, 2)
    arrays = {
        "point_single": single.astype(np.float32),
        "point": point,
        "arm_single": arm.astype(np.float32),
        "arm": arm,
        "local_single": stiffness[:, *np.tril_indices(6)].T.astype(np.float32),
        "mass": mass / heavy,
        "inertia": inertia.reshape(-1, 9).T,
        "flexibility": flexibility.reshape(-1, 9).T,
        "gravity": (problem.gravity_wrench[order] / np.repeat([1.0, length], 3)).T / (heavy * gravity),
        "gyration": gyration / length,
        **({} if (problem.strength.friction == problem.friction).all() else {"own_friction": own}),
    }
    return {name: np.ascontiguousarray(array) for name, array in arrays.items()}, length
