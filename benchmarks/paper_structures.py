"""Make the nine structures of the paper from a clone of its repository, where Python and falsework find them.

    git clone https://github.com/KIKI007/LearningToAssemble
    python benchmarks/paper_structures.py LearningToAssemble --out shared/assemblies

The meshes are copied as they are (MIT licence, copyright 2025 Ziqi Wang). Unit, density, friction and the fixed parts,
which meshes do not hold, are written into an `assembly.json` each. The folder `shared` beside the repository,
or the one that FALSEWORK_DATA names, is where benchmarks and tests look. Prints one JSON object per structure.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path

from falsework.errors import InputError

SOURCE = "github.com/KIKI007/LearningToAssemble"


@dataclass(frozen=True)
class Published:
    """Folder of a structure in the published repository, and what its meshes do not hold."""

    folder: str
    parts: int
    density: float
    boundary: tuple[int, ...]


STRUCTURES = {
    "bottle-12": Published("tetris-1", 12, 100.0, (0,)),
    "tetris-13": Published("tetris-4", 13, 100.0, (0,)),
    "tetris-14": Published("tetris-3", 14, 100.0, (0,)),
    "tetris-17": Published("tetris-2", 17, 100.0, (0,)),
    "cube-17": Published("tetris-6", 17, 100.0, (0,)),
    "dog-35": Published("tetris-7", 35, 100.0, (0,)),
    "dome-37": Published("rulin", 38, 10000.0, (0,)),
    "vault-62": Published("mario", 62, 10000.0, (0, 1, 2, 5, 6, 7, 9, 10, 12, 13, 14, 15, 17, 38, 41, 58, 59)),
    "dome-72": Published("dome", 73, 1000.0, (72,)),
}
FRICTION = 0.55


def copy_structure(name: str, clone: Path, out: Path) -> Path:
    """Copy one structure.

    Args:
        name: a key of `STRUCTURES`.
        clone: the published repository.
        out: folder that gets a folder for the structure.

    Raises:
        InputError: the clone does not hold it as published, or the folder exists.
    """
    about = STRUCTURES[name]
    source, folder = clone / "data" / "assembly" / about.folder, out / name
    meshes = [source / f"{part}.obj" for part in range(about.parts)]
    absent = [mesh.name for mesh in meshes if not mesh.is_file()]
    if absent:
        raise InputError(f"{source} has no {absent[0]}; give a clone of {SOURCE}")
    if folder.exists():
        raise InputError(f"{folder} exists; remove it, or choose another --out")
    folder.mkdir(parents=True)
    for mesh in meshes:
        shutil.copyfile(mesh, folder / mesh.name)
    description = {
        "name": name,
        "unit": "m",
        "density": about.density,
        "friction": FRICTION,
        "boundary": list(about.boundary),
        "source": f"{SOURCE}, data/assembly/{about.folder}",
        "licence": "MIT, Copyright (c) 2025 Ziqi Wang",
    }
    (folder / "assembly.json").write_text(json.dumps(description, indent=1) + "\n", encoding="utf-8")
    return folder


def main() -> None:
    """Copy all structures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clone", type=Path)
    parser.add_argument("--out", type=Path, default=Path("shared") / "assemblies")
    options = parser.parse_args()
    try:
        for name in STRUCTURES:
            print(json.dumps({"structure": name, "folder": str(copy_structure(name, options.clone, options.out))}))
    except InputError as error:
        sys.exit(f"paper_structures.py: {error}")


if __name__ == "__main__":
    main()
