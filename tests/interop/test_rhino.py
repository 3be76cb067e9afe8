"""The script of the tutorial "From Rhino to a plan", run against stand-ins for the functions of Rhino that it calls."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from falsework import Assembly, load_structure

PAGE = Path(__file__).resolve().parents[2] / "docs" / "tutorials" / "from-rhino-to-a-plan.md"


class Rhino(ModuleType):
    """A document with the parts of a structure as meshes, in millimetres."""

    def __init__(self, assembly: Assembly, folder: Path) -> None:
        super().__init__("rhinoscriptsyntax")
        self.assembly, self.folder = assembly, folder

    def BrowseForFolder(self, message: str) -> str:
        return str(self.folder)

    def ObjectsByType(self, kind: int) -> range:
        assert kind == 32  # meshes
        return range(self.assembly.part_count)

    def ObjectName(self, part: int) -> str | None:
        return None if part == 0 else "springer" if self.assembly.boundary[part] else self.assembly.names[part]

    def ObjectLayer(self, part: int) -> str:
        return "model::Boundary" if self.assembly.boundary[part] else "model"

    def MeshVertices(self, part: int) -> list[tuple[float, ...]]:
        return [tuple(point) for point in (1000 * self.assembly.meshes[part].vertices).tolist()]

    def MeshFaceVertices(self, part: int) -> list[tuple[int, int, int, int]]:
        return [(a, b, c, c) for a, b, c in self.assembly.meshes[part].faces.tolist()]

    def UnitSystem(self) -> int:
        return 2  # millimetres


def test_the_script_writes_a_structure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = PAGE.read_text(encoding="utf-8")
    (script,) = re.findall(r"^```py\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    arch = load_structure("arch:blocks=5")
    monkeypatch.setitem(sys.modules, "rhinoscriptsyntax", Rhino(arch, tmp_path))
    exec(compile(script, PAGE.name, "exec"), {"__name__": "__main__"})
    found = load_structure(tmp_path)
    assert found.names == ("0", *arch.names[1:5], "springer", "springer-6")
    assert np.array_equal(found.boundary, arch.boundary)
    assert found.mass.mass == pytest.approx(arch.mass.mass, rel=1e-9)
    assert np.array_equal(found.contacts.parts, arch.contacts.parts)
    assert found.friction == 0.6
