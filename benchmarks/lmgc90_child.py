"""Child process in which LMGC90 computes one state; it imports nothing from falsework, so it starts quickly.

`lmgc90.py` runs this file with the folder of `scene.npz`. The answer goes to `answer.json` in the same folder; there is
none if LMGC90 stops the process.
"""

from __future__ import annotations

import json
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np


def main(folder: Path) -> None:
    """Compute the scene of a folder and write the answer."""
    lmgc90: Any = import_module("compas_lmgc90.solver")
    with np.load(folder / "scene.npz") as scene:
        vertices, faces, fixed = scene["vertices"], scene["faces"], scene["fixed"]
        corner_start, face_start = scene["corner_start"], scene["face_start"]
        density, radius = scene["density"], scene["radius"]
        friction, alert, step = float(scene["friction"]), float(scene["alert"]), float(scene["step"])
        steps = int(scene["steps"])
    solver = lmgc90.Solver(dt=step, theta=0.5)
    blocks = [
        {
            "vertices": vertices[corner_start[k] : corner_start[k + 1]].tolist(),
            "faces": faces[face_start[k] : face_start[k + 1]].tolist(),
        }
        for k in range(len(fixed))
    ]
    solver.geometry_from_v_f(blocks, density=density.tolist())
    for body in np.flatnonzero(fixed):
        solver.v_drvdof[int(body)] = {freedom: np.zeros(6) for freedom in range(1, 7)}
    solver.contact_law("IQS_CLB_g0", friction, alert=alert)
    solver.preprocess()
    # The wrapper's own loop also moves display meshes at every step, which takes longer than the mechanics.
    result = first = solver.lmgc90.compute_one_step()
    pairs = sorted({tuple(sorted((int(a) - 1, int(b) - 1))) for a, b in first.interaction_bodies})
    for _ in range(steps - 1):
        result = solver.lmgc90.compute_one_step()
    moved = np.zeros(len(fixed))
    for body in range(len(fixed)):
        shift = np.linalg.norm(np.asarray(result.bodies[body]) - solver.init_coor[body])
        turn = np.asarray(result.body_frames[body]).reshape(3, 3).T @ solver.init_frame[body]
        # The norm of R - I is 2 sqrt(2) sin(angle / 2), free of the cancellation that the trace suffers from.
        half = np.clip(np.linalg.norm(turn - np.eye(3)) / np.sqrt(8.0), 0.0, 1.0)
        moved[body] = 0.0 if fixed[body] else shift + radius[body] * 2.0 * np.arcsin(half)
    (folder / "answer.json").write_text(json.dumps({"moved": moved.tolist(), "pairs": pairs}))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
