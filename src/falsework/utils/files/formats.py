"""Registry of file formats: packages declare the readers and exporters of their formats as entry points."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from falsework.errors import DependencyError, ExportWarning, InputError, ReadWarning
from falsework.utils.files.output_file import write_whole

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

READERS, EXPORTERS = "falsework.readers", "falsework.exporters"
"""Groups of entry points; each names an object of the class below."""
FOLDER = "/"
"""Ending of a folder, which no name has: of readers of folders with more in them than the meshes of parts, and of the
exporter of folders."""
_KINDS = {"Assembly": "a structure", "Plan": "a plan", "RobotPlan": "a robot plan"}


@dataclass(frozen=True)
class Reader:
    """Reader of structures in files of one format."""

    suffixes: tuple[str, ...]
    """Endings of the names of its files, in lower case, or `FOLDER`."""
    load: Callable[..., Any] | None = None
    """Takes the path and the options of `load_structure`, and returns an `Assembly`; None: that of the parts."""
    parts: Callable[..., Any] | None = None
    """Takes the path and `unit`, and returns a `Draft`, the parts as they are in the file; `falsework doctor` examines
    them one by one."""
    recognizes: Callable[[Path], bool] = Path.is_file
    """Whether a file with such an ending is of this format."""

    def read(self, path: Path | str, **options: Any) -> Any:
        """Return the `Assembly` in a file; options are those of `load_structure`."""
        if self.load is not None:
            return self.load(path, **options)
        assert self.parts is not None
        return self.parts(path, unit=options.pop("unit", None)).assemble(**options)


@dataclass(frozen=True)
class Exporter:
    """Writer of structures and plans in one format."""

    write: Callable[..., None]
    """Takes the assembly, the path, the plan or robot plan if it is to be shown, and the options that are given."""
    suffixes: tuple[str, ...] = ()
    """Endings of the names of its files, in lower case, or `FOLDER`; the first format with an ending is meant by it."""
    shows: tuple[str, ...] = ("Assembly",)
    """Classes of what it shows: `Assembly`, `Plan`, `RobotPlan`."""
    options: tuple[str, ...] = ()
    """Options that it takes for a plan: `step_seconds`, `azimuth`, `elevation`, `progress`."""
    complete: bool = False
    """Whether it keeps joints, loads and given contacts, or says itself that it cannot."""
    contacts: bool = False
    """Whether it keeps given contacts."""


def _left_out(assembly: Any, exporter: Exporter) -> str:
    """Return in words what files of a format lack of a structure; empty if nothing."""
    lacks = {
        "joints": assembly.joints is not None,
        "loads": assembly.loads is not None,
        # Those of fasteners are part of their joints.
        "given contacts": assembly.contacts_given and assembly.joints is None and not exporter.contacts,
    }
    return " and ".join(what for what, lacking in lacks.items() if lacking)


def writer_of(make: Callable[..., bytes | str]) -> Callable[..., None]:
    """Return what an exporter calls, whose files are whole or not there at all.

    Args:
        make: takes the assembly, the plan if there is one and the options, and returns the content of the file.
    """

    def write(assembly: Any, path: Path | str, plan: Any = None, **options: Any) -> None:
        made = make(assembly, *(() if plan is None else (plan,)), **options)
        content = made if isinstance(made, bytes) else made.encode("utf-8", "backslashreplace")
        write_whole(path, lambda file: file.write(content))

    return write


@cache
def _points(group: str) -> dict[str, EntryPoint]:
    from importlib.metadata import entry_points  # takes a tenth of a second

    found = {point.name: point for point in entry_points(group=group)}
    if not found:
        raise DependencyError("falsework runs from a folder in which it is not installed; pip install -e that folder")
    return found


def format_names(group: str) -> tuple[str, ...]:
    """Return the names of the formats in a group, without importing them."""
    return tuple(_points(group))


def formats(group: str) -> dict[str, Any]:
    """Return the readers or exporters by name; what cannot be imported is left out, with a `ReadWarning`."""
    found = {}
    for name, point in _points(group).items():
        try:
            found[name] = point.load()
        except (ImportError, AttributeError) as error:
            warnings.warn(f"the format {name} of {point.value} cannot be used: {error}", ReadWarning, stacklevel=2)
    return found


def reader_of(path: Path) -> Reader | None:
    """Return the reader that recognizes a file or folder, if one does."""
    suffix = FOLDER if path.is_dir() else path.suffix.lower()
    for reader in formats(READERS).values() if path.is_file() or _has_more(path) else ():
        if suffix in reader.suffixes and reader.recognizes(path):
            return reader
    return None


def _has_more(folder: Path) -> bool:
    """Return whether a folder has JSON files of other programs, without which no reader needs to be imported."""
    return folder.is_dir() and any(file.name != "assembly.json" for file in folder.glob("*.json"))


def exporter_by_suffix(path: Path | str) -> str | None:
    """Return the name of the format that the name of a file stands for, if it stands for one."""
    suffix = Path(path).suffix.lower()
    return next((name for name, exporter in formats(EXPORTERS).items() if suffix in exporter.suffixes), None)


def check_ending(path: Path | str, name: str, suffixes: tuple[str, ...] = (FOLDER,)) -> None:
    """Raise if the name of a file or folder stands for another format than the one that is written.

    Args:
        name: format that is written.
        suffixes: endings of its files; without any every name is its.
    """
    other, suffix = exporter_by_suffix(path), Path(path).suffix.lower()
    if other is None or suffix in suffixes or not suffixes:
        return
    ending = "a name without an ending" if FOLDER in suffixes else f"a name that ends in {' or '.join(suffixes)}"
    raise InputError(f"{path} has the ending of {other}, but {name} is written; give {ending}, or leave the format out")


def check_json_name(path: Path | str, what: str) -> None:
    """Raise if the name of a file that is written as JSON stands for another format."""
    suffix = Path(path).suffix.lower()
    if suffix not in ("", ".json") and (other := exporter_by_suffix(path)) is not None:
        raise InputError(
            f"{path} has the ending of {other}; {what} is a .json file, and falsework export writes {other}"
        )


def write_format(assembly: Any, path: Path | str, name: str, plan: Any = None, **options: Any) -> None:
    """Write a structure, or a plan of it, in a format.

    Args:
        assembly: the structure; None for a robot plan that needs none.
        path: file to write, or folder.
        plan: plan or robot plan to show; None for the structure at rest.
        options: of the format; None is equivalent to omission.
    """
    known = formats(EXPORTERS)
    if name not in known:
        raise InputError(f"no export format {name!r}; choose {', '.join(known)}")
    exporter, kind = known[name], type(assembly if plan is None else plan).__name__
    if kind not in exporter.shows:
        what = " or ".join(_KINDS.get(shown, shown) for shown in exporter.shows)
        others = ", ".join(other for other, one in known.items() if kind in one.shows)
        raise InputError(f"{name} cannot show {_KINDS.get(kind, kind)}; give {what}, or write {others}")
    check_ending(path, name, exporter.suffixes)
    given = {option: value for option, value in options.items() if value is not None}
    for option in given:
        if option != "progress" and (plan is None or option not in exporter.options):
            which = " of plans" if plan is None else ""
            raise InputError(f"--{option.replace('_', '-')} is no option of {name}{which}; leave it out")
    left_out = "" if plan is not None or exporter.complete else _left_out(assembly, exporter)
    if left_out:
        warnings.warn(
            f"{name} files have no {left_out}: those of {assembly.name} are left out, without which its stability "
            "differs",
            ExportWarning,
            stacklevel=3,
        )
    exporter.write(assembly, path, plan, **{key: value for key, value in given.items() if key in exporter.options})
