"""Bounds on what a file of meshes may grow to in memory, which follow from its own size."""

from __future__ import annotations

from pathlib import Path

from falsework.errors import MeshError

_FREE = 4_000_000
"""Corners and triangles that any file may have, such as a small one with many copies of its parts."""
LARGEST_POLYGON = 2000
"""Corners of a face; cutting one into triangles takes the square of their number."""


def check_growth(path: Path, count: int, *, beside: int = 0) -> None:
    """Refuse a file whose parts, with all copies, have more corners and triangles than a file of its size may have.

    Args:
        count: corners and triangles.
        beside: bytes of further files that it consists of.

    Raises:
        MeshError: there are too many; a file without copies stores at least a byte of each.
    """
    most = _FREE + path.stat().st_size + beside
    if count > most:
        raise MeshError(
            f"{path} grows to {count} corners and triangles, at most {most} are read from a file of its size; "
            "write simpler parts, or fewer copies of them"
        )
