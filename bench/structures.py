"""Structures of the benchmark: generated ones, and those of other people, which are found on this machine or skipped.

The manifest has names, sources, licences and content hashes of the latter, but no geometry. A structure is looked for
below one folder: under the names of `FALSEWORK_DATA` (`assemblies/dog-35`), or in clones of the repositories that
publish it (`LearningToAssemble/data/assembly/tetris-7`).
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import shutil
import tempfile
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from falsework.assembly.library import built_in, is_built_in
from falsework.assembly.load import load_structure
from falsework.assembly.model import Assembly
from falsework.assembly.store import FILE
from falsework.assembly.store import FORMAT as ASSEMBLY_FORMAT
from falsework.errors import InputError
from falsework.stability.verdict import Criterion
from falsework.utils.json_file import write_json

HERE = Path(__file__).resolve().parent
MANIFEST = HERE / "structures.json"
FORMAT = "falsework.bench.structures/1"
BRICKS = "stabletext2brick"
"""Folder of texts of bricks, one for each structure of the test split of StableText2Brick, and name of its split."""
MOST_BRICKS = 200
"""Structures of that split that are asked about, the first ones by name."""
_PLACES = ("assemblies", "structures", "structures/cad")
_NUMBERED = re.compile(r"(\d+)\.obj")


class NotHereError(InputError):
    """Structure that is not on this machine, or not as the manifest has it; questions about it are skipped."""


@dataclass(frozen=True)
class Structure:
    """A structure of the manifest."""

    name: str
    """Name in questions; of a generated structure what `load_structure` takes."""
    split: str
    parts: int = 0
    """Number of parts, boundary included; 0 if unknown before it is read."""
    robots: tuple[int, ...] = (2,)
    """Numbers of robots that are asked about."""
    criteria: tuple[Criterion, ...] = ("contact", "equilibrium")
    """Those under which the complete structure is stable, without which it has no plan."""
    identity: str = ""
    """`Assembly.identity`, the hash of geometry, boundary, density and friction; empty of a generated structure, whose
    coordinates may differ in the last digit from machine to machine."""
    repository: str = ""
    """Of the source, such as `github.com/KIKI007/LearningToAssemble`."""
    commit: str = ""
    path: str = ""
    """File or folder in the repository; empty if no reader takes the source as it is."""
    licence: str = ""
    holder: str = ""
    """Of the copyright."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """What the source leaves open, as entries of `assembly.json`, and `ground`."""
    note: str = ""

    @property
    def generated(self) -> bool:
        """Whether the package makes it."""
        return is_built_in(self.name)

    @property
    def digest(self) -> str:
        """Hash that submissions name; empty of a structure that the manifest does not pin."""
        return hashlib.sha256(self.name.encode()).hexdigest() if self.generated else self.identity

    def place(self, root: Path) -> Path | None:
        """Return the file or folder of the structure below a folder of data; None if there is none."""
        if self.split == BRICKS:
            return root / BRICKS / f"{self.name.partition('/')[2]}.txt"
        places = [root / folder / self.name for folder in _PLACES]
        if self.path:
            places.append(root / self.repository.rpartition("/")[2] / self.path)
        return next((place for place in places if place.exists()), None)

    def load(self, root: Path) -> Assembly:
        """Return the structure.

        Raises:
            NotHereError: it is not there, cannot be read, or differs from the manifest.
        """
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of what the manifest decides, such as a ground
            if self.generated:
                return load_structure(built_in(self.name))
            place = self.place(root)
            if place is None:
                where = f"{self.repository} at {self.commit[:7]}" if self.path else "no public file in a known format"
                raise NotHereError(f"{self.name} is not below {root}; its source is {where}")
            try:
                found = _read(place, self.options)
            except InputError as error:
                raise NotHereError(f"{self.name} cannot be read: {error}") from error
        if self.identity and found.identity != self.identity:
            raise NotHereError(
                f"{self.name}: {place} has other contents than the manifest says (hash {found.identity[:12]}, not "
                f"{self.identity[:12]}); take it from {self.repository} at {self.commit[:7]}"
            )
        return found


def data_root(given: Path | None = None) -> Path:
    """Return the folder of data: the given one, that of FALSEWORK_DATA, or `shared` beside the repository."""
    named = os.environ.get("FALSEWORK_DATA")
    return given or (Path(named) if named else HERE.parents[1] / "shared")


@cache
def manifest(path: Path = MANIFEST) -> Mapping[str, Structure]:
    """Return the structures of the manifest by name.

    Raises:
        InputError: it has a structure twice.
    """
    found: dict[str, Structure] = {}
    for entry in json.loads(path.read_text(encoding="utf-8"))["structures"]:
        lists: dict[str, Any] = {name: tuple(entry.pop(name)) for name in ("robots", "criteria") if name in entry}
        made = Structure(**entry, **lists)
        if made.name in found:
            raise InputError(f"{path} has {made.name} twice; remove one")
        found[made.name] = made
    return found


def pinned(path: Path, root: Path) -> int:
    """Write hash and number of parts of each structure that has none into a manifest; return how many there were."""
    data, count = json.loads(path.read_text(encoding="utf-8")), 0
    for entry in data["structures"]:
        structure = manifest(path)[entry["name"]]
        if structure.parts and structure.digest:
            continue
        with contextlib.suppress(NotHereError):
            found = structure.load(root)
            entry["parts"] = found.part_count
            if not structure.generated:
                entry["identity"] = found.identity
            count += 1
    write_json(path, data, ("structures",))
    return count


def structures(root: Path) -> dict[str, Structure]:
    """Return all structures by name: those of the manifest, and texts of bricks below a folder of data."""
    return {**manifest(), **{found.name: found for found in _bricks(root)}}


def _bricks(root: Path) -> Iterator[Structure]:
    files = sorted((root / BRICKS).glob("*.txt"))[:MOST_BRICKS]
    for file in files:
        yield Structure(f"{BRICKS}/{file.stem}", BRICKS, licence="MIT", holder="Ava Pun and others")


def _read(place: Path, options: Mapping[str, Any]) -> Assembly:
    """Read a file, or the numbered meshes of a folder, with nothing else than the options of the manifest."""
    contact = options.get("contact")
    if place.is_file() and contact is None:
        return load_structure(place, **options)
    if place.is_file():
        raise InputError(f"{place} is one file, which takes no tolerances of contacts; give a folder of meshes")
    numbers = sorted(int(found[1]) for file in place.iterdir() if (found := _NUMBERED.fullmatch(file.name)))
    if not numbers:
        raise InputError(f"{place} has no meshes 0.obj, 1.obj, ...")
    whole = numbers == list(range(len(numbers)))
    with tempfile.TemporaryDirectory() as folder:
        for number in numbers:
            name = f"{number}.obj" if whole else f"part-{number:04d}.obj"
            shutil.copyfile(place / f"{number}.obj", Path(folder, name))
        entries = {key: value for key, value in options.items() if key != "ground"}
        write_json(Path(folder, FILE), {"format": ASSEMBLY_FORMAT, **entries}, ())
        return load_structure(folder, ground=bool(options.get("ground")))
