"""Make an assembly from meshes of your own, save it as a folder, and read it back.

Run: python examples/03_your_own_meshes.py
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from falsework import Assembly, StabilityOracle, load_structure, save
from falsework.geometry import TriangleMesh


def box(name: str, low: tuple[float, float, float], high: tuple[float, float, float]) -> TriangleMesh:
    """Axis-aligned box, corners in metres."""
    corners = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [triangle for a, b, c, d in quads for triangle in ((a, b, c), (a, c, d))]
    return TriangleMesh.from_arrays(name, corners, faces)


def main() -> None:
    """A table of three legs and a top, on the ground."""
    legs = [
        box(f"leg-{number}", (x, y, 0.0), (x + 0.1, y + 0.1, 0.7))
        for number, (x, y) in enumerate([(0.0, 0.0), (0.9, 0.0), (0.45, 0.5)])
    ]
    top = box("top", (-0.1, -0.1, 0.7), (1.1, 0.7, 0.75))

    # Nothing here is fixed, so a ground is put under the lowest point; it becomes the last part.
    table = Assembly.from_meshes([*legs, top], boundary=[], ground=True, density=700.0, friction=0.5, name="table")
    print(table.names, "boundary:", [name for name, fixed in zip(table.names, table.boundary, strict=True) if fixed])

    oracle = StabilityOracle(table)
    states = np.array(
        [
            [1, 1, 1, 1, 2],  # complete
            [1, 1, 0, 1, 2],  # without one leg
            [1, 1, 0, 2, 2],  # without one leg, but a robot holds the top
        ]
    )
    print("stable:", oracle.verdicts(states).stable.tolist())

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "table"
        save(table, path)
        print(sorted(file.name for file in path.iterdir()))
        assert load_structure(path).identity == table.identity


if __name__ == "__main__":
    main()
