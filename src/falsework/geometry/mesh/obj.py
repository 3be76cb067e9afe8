"""Reader and writer of Wavefront OBJ that keep every digit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from falsework.errors import MeshError
from falsework.geometry.mesh.mesh import TriangleMesh
from falsework.geometry.mesh.polygon import triangulate


def read_obj(file: Path) -> list[tuple[str, NDArray[np.float64], NDArray[np.int64]]]:
    """Read the objects of an OBJ file: name, vertices of the whole file, and faces of each.

    Objects begin at `o` lines, or at `g` lines in a file without `o`. Polygons are cut into triangles,
    concave ones too. Textures, normals, lines and materials are ignored.

    Raises:
        MeshError: a line that cannot be understood, or a face with a vertex that is not there.
    """
    try:
        text = file.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise MeshError(f"cannot read {file}: {error.strerror}") from error
    lines = text.replace("\\\n", " ").splitlines()
    keyword = "o" if any(line.startswith("o ") for line in lines) else "g"
    vertices: list[tuple[float, float, float]] = []
    objects: dict[str, list[list[int]]] = {}
    polygons = objects.setdefault(file.stem, [])
    for number, line in enumerate(lines, start=1):
        words = line.split("#", 1)[0].split()
        if not words:
            continue
        try:
            if words[0] == "v":
                x, y, z = words[1:4]
                vertices.append((float(x), float(y), float(z)))
            elif words[0] == "f":
                indices = [int(word.split("/", 1)[0]) for word in words[1:]]
                polygons.append([index - 1 if index > 0 else len(vertices) + index for index in indices])
                if len(indices) < 3 or 0 in indices:
                    raise ValueError
            elif words[0] == keyword:
                polygons = objects.setdefault(" ".join(words[1:]) or file.stem, [])
        except ValueError:
            raise MeshError(f"cannot read line {number} of {file}: {line.strip()[:60]!r}; export it again") from None
    points = np.array(vertices, dtype=np.float64).reshape(-1, 3)
    solids = []
    for name, polygons in objects.items():
        if polygons:
            solids.append((name, points, _triangles(file, points, polygons)))
    return solids


def _triangles(file: Path, points: NDArray[np.float64], polygons: list[list[int]]) -> NDArray[np.int64]:
    """Return triangles of polygons, in their order."""
    if max(map(max, polygons)) >= len(points) or min(map(min, polygons)) < 0:
        raise MeshError(f"a face in {file} uses a vertex that does not exist; there are {len(points)}; export it again")
    if all(len(polygon) == 3 for polygon in polygons):
        return np.array(polygons, dtype=np.int64)
    faces: list[list[int]] = []
    for polygon in polygons:
        faces.extend([polygon[corner] for corner in triangle] for triangle in triangulate(points[polygon]))
    return np.array(faces, dtype=np.int64)


def obj_text(mesh: TriangleMesh) -> str:
    """Return an OBJ file whose numbers read back as the same float64."""
    lines = [f"o {mesh.name}"]
    lines += [f"v {x!r} {y!r} {z!r}" for x, y, z in mesh.vertices.tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (mesh.faces + 1).tolist()]
    return "\n".join(lines) + "\n"
