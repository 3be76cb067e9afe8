"""Reader of folders of part meshes whose poses are in a file of their own: ASAP, Fabrica and Assemble-Them-All.

`config.json` of ASAP and Fabrica has an entry for each part, by the name of its mesh, with `final_state`: a
translation, or a translation and angles about the fixed axes x, y and z, in radians. `translation.json` of
Assemble-Them-All has a translation for each part. Poses before assembly (`initial_state`) are for robots that pick
parts up, and are not used.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.draft import Draft
from falsework.errors import InputError
from falsework.geometry.mesh.surface import warn_of
from falsework.utils.files.formats import FOLDER, Reader
from falsework.utils.files.input_file import read_text
from falsework.utils.json_text import parse_json
from falsework.utils.quantity import is_number, listed

UNIT = "cm"
"""Unit of these folders, which none of their files names."""
_CONFIG, _TRANSLATION = "config.json", "translation.json"
_STATE = "final_state"
_STEPS = "pose"
"""Folder of the orientation of the whole assembly in each step, in results of ASAP."""
_SETTINGS = ("contact_eps",)
"""Entries of `config.json` that are of no part."""


def read_posed(path: Path | str, *, unit: str | None = None) -> Draft:
    """Read the parts of a folder of meshes with a file of poses, unchecked, in their final poses.

    Parts without a pose stay where their meshes are, with a warning if others have one.

    Args:
        unit: of the meshes and translations; centimetres if not given.
    """
    path = Path(path)
    draft = Draft.from_meshes(path, unit or UNIT)
    file, states = _states(path)
    poses = {name: _pose(file, name, state) for name, state in states.items()}
    gone = [name for name in poses if name not in draft.names]
    if gone:
        warn_of(file, f"poses of parts without a mesh have no effect: {listed(gone)}")
    left = [name for name in draft.names if name not in poses]
    if left and len(left) < len(draft.names):
        warn_of(file, f"parts without a pose stay where their meshes are: {listed(left)}")
    if (path / _STEPS).is_dir():
        warn_of(path / _STEPS, "orientations of the whole for each step were left out; the ground is one for all steps")
    blocks = []
    for block in draft.blocks:
        turn, shift = poses.get(block.name, (np.eye(3), np.zeros(3)))
        posed = block.name in poses and not block.error
        blocks.append(replace(block, vertices=block.vertices @ turn.T + shift) if posed else block)
    return replace(draft, blocks=tuple(blocks), fits=True)


def _states(folder: Path) -> tuple[Path, dict[str, Any]]:
    """Return the file of poses of a folder, and its entries of parts as they are."""
    file = folder / _CONFIG
    entries = _object(file)
    if any(_is_part(entry) for entry in entries.values()):
        return file, {name: entry.get(_STATE) for name, entry in entries.items() if _is_part(entry)}
    if (folder / _TRANSLATION).is_file():
        return folder / _TRANSLATION, _object(folder / _TRANSLATION)
    return file, {}


def _is_part(entry: Any) -> bool:
    return isinstance(entry, Mapping) and any(key.endswith("_state") for key in entry)


def _pose(file: Path, name: str, state: Any) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the rotation and the translation of a state."""
    numbers = isinstance(state, list) and all(map(is_number, state))
    values = np.array(state if numbers else [], dtype=float)
    if len(values) not in (3, 6) or not np.isfinite(values).all():
        raise InputError(
            f"{file}: the pose of part {name} is {state!r}; give a translation, or a translation and three angles in "
            "radians"
        )
    if len(values) == 3:
        return np.eye(3), values
    from scipy.spatial.transform import Rotation

    return Rotation.from_euler("xyz", values[3:]).as_matrix(), values[:3]


def _object(file: Path) -> dict[str, Any]:
    """Return the entries of a JSON object; none if the file has another content, or is not there."""
    try:
        content = parse_json(read_text(file))
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}


def _is_posed(folder: Path) -> bool:
    """Return whether a folder has a file of these projects."""
    config = _object(folder / _CONFIG)
    named = any(_is_part(entry) for entry in config.values()) or any(key in config for key in _SETTINGS)
    return named or bool(_object(folder / _TRANSLATION))


READER = Reader((FOLDER,), parts=read_posed, recognizes=_is_posed)
