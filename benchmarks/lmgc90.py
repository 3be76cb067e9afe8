"""LMGC90 as an independent stability check: non-smooth contact dynamics of rigid polyhedra (Dubois et al. 2018).

It takes meshes, densities and the coefficient of friction, and detects the contacts itself; the assembly's contacts
only serve to test whether it found them all. Every state is computed in a process of its own, since the Fortran
core ends the process on an error.

LMGC90 comes with the Python package `compas_lmgc90`, whose wheel holds the compiled core. Its metadata requires a
viewer and other packages, of which only `compas` is used here:

    pip install compas
    pip install --no-deps compas_lmgc90

Gravity acts for 0.3 s on the parts at rest, contact law `IQS_CLB_g0` (inelastic shocks, Coulomb friction, initial gaps
count as closed); held and boundary parts have a prescribed velocity of zero. In that time a free part
falls 440 mm. Of parts one metre in size, stable ones moved by at most 0.03 mm and collapsing ones by 7 mm or more; the
limit lies between, at a thousandth of the size of a typical part.

Its contact detection is made for polyhedra that are convex or nearly so. Notched plates and blocks of several voxels
stop it; on thin vaults it sometimes runs out of space for contacts, or misses one. Such states are `not judged`.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from importlib.util import find_spec
from json import loads
from pathlib import Path
from typing import Literal

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

from falsework.assembly.model import Assembly
from falsework.assembly.state import HELD, INSTALLED, REMOVED, States, as_states
from falsework.errors import DependencyError, InputError
from falsework.geometry.mesh.mesh import TriangleMesh

Array = NDArray[np.float64]

_CHILD = Path(__file__).with_name("lmgc90_child.py")
_SECONDS = 0.3
"""Simulated time under gravity, s."""
_STEP = 2e-3
"""Time step, s."""
_SMALL = 1e-3
"""Smallest distance at which contacts are detected, and displacement from which a part counts as collapsing, in sizes
of a typical part: stable ones moved by at most 3e-5, collapsing ones by 7e-3 or more."""
_PATIENCE = 600.0
"""Time limit of a child process, s."""


@dataclass(frozen=True)
class Lmgc90Answer:
    """Result of LMGC90 for one state."""

    answer: Literal["stands", "falls", "not judged"]
    moved: float
    """Largest displacement of a part, metres: of its centre, plus rotation times half the diagonal of its bounding box;
    NaN where LMGC90 did not finish."""
    part: int
    """Part that moved most; -1 if none is free to move or LMGC90 did not finish."""
    reason: str
    """Why the state is not judged; otherwise empty."""


def judge_by_lmgc90(assembly: Assembly, states: ArrayLike) -> list[Lmgc90Answer]:
    """Check states one by one by dynamics, which takes a second to a minute each.

    A state is not judged where a part is not a closed polyhedron, where LMGC90 stops with an error, or where parts move
    although its detection had missed a contact, since that alone may be why they move.

    Args:
        assembly: the structure.
        states: one state (parts,) or a batch (batch, parts).

    Returns:
        An answer for each state.

    Raises:
        DependencyError: LMGC90 is not installed.
        InputError: a structure with loads or joints, which the LMGC90 model does not support.
        StateError: states of the wrong shape or with wrong values.
    """
    batch = as_states(states, assembly.boundary)
    if assembly.loads is not None:
        raise InputError("the LMGC90 model takes weight alone; leave out the loads, or replay by the contact law")
    if assembly.joints is not None:
        raise InputError("the LMGC90 model does not support joints; replay by the contact law instead")
    if find_spec("compas_lmgc90") is None or find_spec("compas") is None:
        raise DependencyError("LMGC90 is not installed; run: pip install compas && pip install --no-deps compas_lmgc90")
    solids = [_solid(mesh) for mesh in assembly.meshes]
    return [_judge(assembly, state, solids) for state in batch]


def _solid(mesh: TriangleMesh) -> trimesh.Trimesh | None:
    """Return the mesh with coinciding vertices merged; None if it is not closed then."""
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=True)
    return solid if solid.is_volume else None


def _judge(assembly: Assembly, state: States, solids: list[trimesh.Trimesh | None]) -> Lmgc90Answer:
    present = np.flatnonzero(state != REMOVED)
    if not (state == INSTALLED).any():
        return Lmgc90Answer("stands", 0.0, -1, "")
    parts = []
    for part in present:
        solid = solids[part]
        if solid is None:
            return _unjudged(f"part {assembly.names[part]} is not a closed polyhedron; repair its mesh")
        parts.append(solid)
    size = float(np.median([np.ptp(mesh.bounds, axis=0).max() for mesh in assembly.meshes]))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        np.savez(
            folder / "scene.npz",
            vertices=np.concatenate([solid.vertices for solid in parts]),
            faces=np.concatenate([solid.faces for solid in parts]),
            corner_start=np.cumsum([0, *(len(solid.vertices) for solid in parts)]),
            face_start=np.cumsum([0, *(len(solid.faces) for solid in parts)]),
            fixed=state[present] == HELD,
            density=assembly.density[present],
            radius=np.array([np.linalg.norm(solid.extents) / 2 for solid in parts]),
            friction=assembly.friction,
            alert=max(_SMALL * size, *assembly.contact_settings.lengths(assembly.meshes)),
            step=_STEP,
            steps=round(_SECONDS / _STEP),
        )
        said = _run(folder)
        answer = folder / "answer.json"
        if not answer.exists():
            body = re.search(r"polyr *: *(\d+)", said, re.IGNORECASE)
            where = f" at part {assembly.names[present[int(body[1]) - 1]]}" if body else ""
            return _unjudged(f"LMGC90 stopped{where}: {_error(said)}")
        result = loads(answer.read_text())
    moved = np.asarray(result["moved"], float)
    if not np.isfinite(moved).all():
        return _unjudged("LMGC90 returned positions that are not finite")
    most = int(np.argmax(moved))
    if moved[most] <= _SMALL * size:
        return Lmgc90Answer("stands", float(moved[most]), int(present[most]), "")
    lost = _lost(assembly, state, {(int(present[a]), int(present[b])) for a, b in result["pairs"]})
    if lost is not None:
        first, second = (assembly.names[part] for part in lost)
        reason = f"parts move, but LMGC90 missed the contact of parts {first} and {second}"
        return Lmgc90Answer("not judged", float(moved[most]), int(present[most]), reason)
    return Lmgc90Answer("falls", float(moved[most]), int(present[most]), "")


def _unjudged(reason: str) -> Lmgc90Answer:
    return Lmgc90Answer("not judged", float("nan"), -1, reason)


def _lost(assembly: Assembly, state: States, found: set[tuple[int, int]]) -> tuple[int, int] | None:
    """Return the first pair of parts in contact, one of them free, that is not among those found."""
    for a, b in np.unique(assembly.contacts.parts, axis=0):
        acts = REMOVED not in (state[a], state[b]) and INSTALLED in (state[a], state[b])
        if acts and (int(a), int(b)) not in found:
            return int(a), int(b)
    return None


def _run(folder: Path) -> str:
    """Run the child; return its output and its exit code."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path)), "OMP_NUM_THREADS": "1"}
    try:
        # -P keeps the script's folder off the import path, since its modules are named after what they wrap.
        done = subprocess.run(
            [sys.executable, "-P", str(_CHILD), str(folder)],
            cwd=folder,
            env=environment,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=_PATIENCE,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return f"no answer within {_PATIENCE:.0f} s"
    return f"{done.stdout}\n{done.stderr}\nexit code {done.returncode}"


def _error(said: str) -> str:
    """Return the first error in the output with the line after it, or else the last line."""
    lines = [" ".join(line.split()) for line in said.splitlines() if line.strip()]
    first = next((k for k, line in enumerate(lines) if "error" in line.lower()), len(lines) - 1)
    return " ".join(lines[first : first + 2])
