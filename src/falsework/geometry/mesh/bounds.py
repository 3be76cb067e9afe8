"""Bounds on what a file of meshes may grow to in memory, which follow from its own size."""

from __future__ import annotations

import json
import struct
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from falsework.errors import MeshError

_FREE = 4_000_000
"""Corners and triangles that any file may have, such as a small one with many copies of its parts."""
LARGEST_POLYGON = 2000
"""Corners of a face; cutting one into triangles takes the square of their number."""
_HEADER = struct.Struct("<4sII I4s")
"""Of GLB: mark, version, length of the file, length and kind of the first chunk."""


def check_growth(path: Path, count: int) -> None:
    """Refuse a file whose parts, with all copies, have more corners and triangles than a file of its size may have.

    Args:
        path: the file.
        count: corners and triangles.

    Raises:
        MeshError: there are too many; a file without copies stores at least a byte of each.
    """
    most = _FREE + path.stat().st_size
    if count > most:
        raise MeshError(
            f"{path} grows to {count} corners and triangles, at most {most} are read from a file of its size; "
            "write simpler parts, or fewer copies of them"
        )


def check_glb(path: Path) -> None:
    """Check what a GLB file claims before it is read; what is no GLB is left to its reader.

    Raises:
        MeshError: its arrays or copies take more than its size allows.
    """
    try:
        with path.open("rb") as file:
            mark, _, _, length, kind = _HEADER.unpack(file.read(_HEADER.size))
            if mark != b"glTF" or kind != b"JSON":
                return
            content = json.loads(file.read(length))
        claimed = sum(int(entry["count"]) for entry in content.get("accessors", ()))
        shown = _shown(content)
    except (OSError, struct.error, ValueError, TypeError, KeyError, IndexError, AttributeError, RecursionError):
        return
    check_growth(path, max(claimed, shown))


def _shown(content: Mapping[str, Any]) -> int:
    """Count the corners and indices of all primitives of all nodes."""
    accessors = content.get("accessors", [])
    sizes = [
        sum(
            int(accessors[index]["count"])
            for primitive in mesh["primitives"]
            for index in (primitive["attributes"].get("POSITION"), primitive.get("indices"))
            if index is not None
        )
        for mesh in content.get("meshes", [])
    ]
    uses = Counter(node["mesh"] for node in content.get("nodes", []) if "mesh" in node)
    return sum(size * max(uses[mesh], 1) for mesh, size in enumerate(sizes))
