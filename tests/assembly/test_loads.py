"""Loads of a structure: how they are read, kept and refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from falsework import load_structure
from falsework.assembly import Loads
from falsework.assembly.store import load_assembly, save_assembly
from falsework.errors import AssemblyError


def test_a_force_beside_the_centre_turns_its_part() -> None:
    arch = load_structure("arch:blocks=5")
    at = arch.mass.center[1] + [0.0, 0.0, 0.5]
    loaded = load_structure("arch:blocks=5", loads=[{"part": arch.names[1], "force": [10, 0, 0], "at": at.tolist()}])
    expected = np.zeros((arch.part_count, 6))
    expected[1] = [10, 0, 0, 0, 5, 0]
    np.testing.assert_allclose(loaded.applied_wrench() - arch.applied_wrench(), expected, atol=1e-9)


def test_an_earthquake_is_a_share_of_the_weight() -> None:
    arch = load_structure("arch:blocks=5")
    shaken = load_structure("arch:blocks=5", earthquake=[0.1, -0.2])
    sideways = shaken.applied_wrench(4.0)[:, :3] / (4.0 * arch.mass.mass[:, None])
    np.testing.assert_allclose(sideways, np.tile([0.1, -0.2, -1.0], (arch.part_count, 1)))


def test_loads_are_part_of_the_identity_and_of_the_folder(tmp_path: Path) -> None:
    plain = load_structure("stack")
    loaded = load_structure("stack", loads=[{"part": 0, "force": [0, 0, -100]}], earthquake=[0.05])
    assert plain.identity != loaded.identity
    folder = save_assembly(loaded, tmp_path / "stack")
    assert load_assembly(folder).identity == loaded.identity
    assert load_structure(folder, earthquake=[0.06]).identity != loaded.identity


def test_a_ground_keeps_the_loads() -> None:
    loaded = load_structure("stack", loads=[{"part": 2, "force": [1, 2, 3]}]).with_ground()
    assert loaded.loads is not None
    np.testing.assert_array_equal(loaded.loads.wrench[2, :3], [1, 2, 3])
    assert loaded.loads.wrench.shape == (loaded.part_count, 6)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"loads": [{"part": 99, "force": [0, 0, -1]}]}, "part 99, which does not exist"),
        ({"loads": [{"part": "keystone", "force": [0, 0, -1]}]}, "'keystone', which does not exist"),
        (
            {"loads": [{"part": 0, "force": [0, -1]}]},
            r"loads\[0\].force is \[0, -1\]; give a list of length >= 3 \(N\)",
        ),
        ({"loads": [{"part": 0, "force": ["a", 0, 0]}]}, r"loads\[0\].force\[0\] is 'a'; give a number"),
        ({"loads": [{"part": 0, "weight": 3}]}, r"loads\[0\].weight is not known; known are at, force, moment, part"),
        ({"loads": {"part": 0}}, r"loads is {'part': 0}; give a list"),
        ({"loads": [{"part": 0}]}, "has neither a force nor a moment"),
        ({"earthquake": [0.1, 0.2, 0.3]}, r"earthquake is \[0.1, 0.2, 0.3\]; give a list of length <= 2"),
        ({"earthquake": "strong"}, r"earthquake\[0\] is 'strong'; give a number"),
    ],
)
def test_wrong_loads(given: dict[str, Any], words: str) -> None:
    with pytest.raises(AssemblyError, match=words):
        load_structure("stack", **given)


def test_wrong_loads_in_a_folder(tmp_path: Path) -> None:
    folder = save_assembly(load_structure("stack"), tmp_path / "stack")
    description = json.loads((folder / "assembly.json").read_text())
    (folder / "assembly.json").write_text(json.dumps(description | {"loads": "heavy"}))
    with pytest.raises(AssemblyError, match=r"loads is 'heavy'; give a list"):
        load_assembly(folder)


def test_arrays_of_the_wrong_shape() -> None:
    with pytest.raises(AssemblyError, match=r"shape \(2, 6\)"):
        Loads.from_arrays(2, wrench=np.zeros((3, 6)))
