"""Architecture of the package: dependencies point one way, and optional packages stay optional."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from graphlib import CycleError, TopologicalSorter
from importlib.metadata import requires
from itertools import pairwise
from pathlib import Path

SOURCE = Path(__file__).resolve().parents[1] / "src" / "falsework"

# From top to bottom: a room imports only from itself and from rooms before it.
ROOMS = (
    "errors",
    "utils",
    "geometry",
    "assembly",
    "stability",
    "search",
    "replanning",
    "learn",
    "robots",
    "files",
    "viewer",
    "service",
    "interop",
    "cli",
)
CORE = ("errors", "utils", "geometry", "assembly", "stability", "search", "replanning", "cli")

# Sub-packages of each room, likewise. Modules at the root of a room may use them, and be used by them.
SUBPACKAGES = {
    "utils": ("files", "cache", "display"),
    "geometry": ("gltf", "mesh", "contact", "settling", "clearance", "paths"),
    "assembly": ("library",),
    "stability": ("second_order", "cpu", "contact", "gpu", "reference", "margins", "judges"),
    "search": ("problem", "together", "beam", "margins", "plans", "regrasp", "device"),
    "learn": ("config", "env", "networks", "data", "algorithms", "training"),
    "robots": (
        "model",
        "kernels",
        "kinematics",
        "motion",
        "cells",
        "grasping",
        "plans",
        "exports",
        "checks",
        "schedule",
        "keyframes",
        "interleaving",
        "planning",
    ),
    "viewer": ("pictures", "web", "page", "cells"),
    "interop": ("compas",),
}
MOST_MODULES = 16
"""In one folder; `cli` has a module for each command."""
MOST_LINES = 400
"""In one module."""

MOST_NAMES = 150
"""Public names in the stubs of all packages together."""

# Distribution names whose import name differs.
IMPORT_NAMES = {"python-fcl": "fcl"}

MODULES = sorted(SOURCE.rglob("*.py"))
FOLDERS = sorted({path.parent for path in MODULES})


def dotted(path: Path) -> str:
    """Import name of a source file."""
    parts = path.relative_to(SOURCE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def room_of(module: str) -> str:
    """Room that a dotted module name belongs to; empty for the package itself."""
    return [*module.split("."), ""][1]


def imports(tree: ast.AST) -> Iterator[tuple[str, int]]:
    """Every module that the code imports anywhere, functions included, with its line."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield alias.name, node.lineno
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"line {node.lineno}: relative import; write the full name"
            assert node.module is not None
            yield node.module, node.lineno
            for alias in node.names:  # `from falsework import search` names a room too
                yield f"{node.module}.{alias.name}", node.lineno


@cache
def parsed(path: Path) -> ast.Module:
    """Syntax tree of a source file."""
    return ast.parse(path.read_text())


@cache
def files_by_name() -> dict[str, Path]:
    """Source files by their import names."""
    return {dotted(path): path for path in MODULES}


def defining_file(module: str, name: str) -> Path | None:
    """File that `from module import name` comes to in the end: re-exports by packages are followed."""
    files = files_by_name()
    if f"{module}.{name}" in files:
        return files[f"{module}.{name}"]
    path = files.get(module)
    if path is not None and path.name == "__init__.py":
        stub = path.with_suffix(".pyi")  # lists what a package exports lazily
        for node in ast.walk(parsed(stub if stub.exists() else path)):
            if isinstance(node, ast.ImportFrom) and name in [alias.asname or alias.name for alias in node.names]:
                return defining_file(node.module or "", name)
    return path


@cache
def imported_files(path: Path) -> set[Path]:
    """Files of the package that a file imports from, inside functions and for types too."""
    found = set()
    for node in ast.walk(parsed(path)):
        if isinstance(node, ast.Import):
            found |= {defining_file(alias.name, "") for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found |= {defining_file(node.module or "", alias.name) for alias in node.names}
    return {file for file in found if file is not None} - {path}


def is_type_checking(node: ast.AST) -> bool:
    """Whether a node is `if TYPE_CHECKING:`."""
    return isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING")


def imported_at_load(tree: ast.Module) -> Iterator[tuple[str, int]]:
    """Modules imported when the file is: not those inside functions or `if TYPE_CHECKING`."""
    pending: list[ast.AST] = list(tree.body)
    while pending:
        node = pending.pop()
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)):
            continue
        if is_type_checking(node):
            pending.extend(node.orelse)  # type: ignore[attr-defined]
            continue
        if isinstance(node, (ast.Import, ast.ImportFrom)):
            yield from imports(node)
        else:
            pending.extend(ast.iter_child_nodes(node))


def core_dependencies() -> set[str]:
    """Import names of the packages that a plain install brings."""
    names = set()
    for line in requires("falsework") or []:
        if "extra ==" not in line:
            name = "".join(letter if letter.isalnum() or letter in "-_." else " " for letter in line).split()[0]
            names.add(IMPORT_NAMES.get(name, name).replace("-", "_"))
    return names


def test_every_room_is_known() -> None:
    """A new folder in the package needs its place in the order."""
    found = {path.stem if path.is_file() else path.name for path in SOURCE.iterdir()}
    found -= {"__init__", "__main__", "_version", "__pycache__", "py"}
    found -= {path.stem for path in SOURCE.iterdir() if path.suffix not in ("", ".py")}
    assert found <= set(ROOMS), f"rooms without a place in the order: {sorted(found - set(ROOMS))}"


def test_imports_point_upwards() -> None:
    """No room imports from a room below it."""
    wrong = []
    for path in MODULES:
        here = room_of(dotted(path))
        if here in ("", "__main__", "_version"):
            continue  # the package itself may name any room
        below = ROOMS[ROOMS.index(here) + 1 :]
        for module, line in imports(parsed(path)):
            if module.split(".")[0] == "falsework" and room_of(module) in below:
                wrong.append(f"{path}:{line}: {here} imports {module}, which is below it")
    assert not wrong, "\n".join(wrong)


def subpackage_of(path: Path) -> str:
    """Folder of a room that a file is in; empty at the root of the room."""
    parts = path.relative_to(SOURCE).parts
    return parts[1] if len(parts) > 2 else ""


def test_imports_inside_a_room_point_upwards() -> None:
    """No sub-package imports from one that comes after it in its room."""
    wrong = []
    for path in MODULES:
        room, here = room_of(dotted(path)), subpackage_of(path)
        if not here:
            continue
        assert here in SUBPACKAGES.get(room, ()), f"{room}/{here} has no place in the order of its room"
        allowed = ("", *SUBPACKAGES[room][: SUBPACKAGES[room].index(here) + 1])
        for file in imported_files(path):
            if room_of(dotted(file)) == room and subpackage_of(file) not in allowed:
                wrong.append(f"{path}: {room}/{here} imports {dotted(file)}, which is below it")
    assert not wrong, "\n".join(wrong)


def circle_of(imported: dict[Path, set[Path]]) -> list[str]:
    """Names of files that import each other in a circle; empty if none do."""
    try:
        TopologicalSorter(imported).prepare()
    except CycleError as error:
        return [dotted(path) for path in error.args[1]]
    return []


def test_no_files_import_each_other_in_a_circle() -> None:
    """Neither inside a room nor between rooms; imports inside functions and for types alone count too."""
    assert circle_of({path: imported_files(path) for path in MODULES}) == []


def test_the_check_sees_a_circle() -> None:
    """Through a re-export by a package too."""
    one, other = SOURCE / "search" / "find.py", SOURCE / "search" / "exhaustive.py"
    assert (
        defining_file("falsework.search", "ExhaustiveSearch")
        == defining_file("falsework.search", "exhaustive")
        == other
    )
    assert SOURCE / "search" / "planner.py" in imported_files(one)
    assert len(circle_of({one: {other}, other: {one}})) == 3


def test_folders_are_small() -> None:
    """A folder is looked through in a moment."""
    count = {folder: len([*folder.glob("*.py")]) - 1 for folder in FOLDERS if folder.name != "cli"}  # without __init__
    assert [
        f"{path} has {modules} modules; split it" for path, modules in count.items() if modules > MOST_MODULES
    ] == []


def test_modules_are_short() -> None:
    """A module is read in one go."""
    lines = {path: len(path.read_text().splitlines()) for path in MODULES}
    assert [f"{path} has {count} lines; split it" for path, count in lines.items() if count > MOST_LINES] == []


def documented_arguments(function: ast.FunctionDef) -> set[str]:
    """Names of the arguments that a docstring explains."""
    text = ast.get_docstring(function) or ""
    section = re.search(r"^Args:\n((?: {4}.*\n?|\n)+)", text, re.MULTILINE)
    entries = re.findall(r"^ {4}(\S.*?):(?: |$)", section[1], re.MULTILINE) if section else []
    return {name.strip().lstrip("*") for entry in entries for name in entry.split(",")}


def test_docstrings_explain_arguments_that_exist() -> None:
    """An argument that is renamed is renamed in its docstring too."""
    wrong = []
    for path in MODULES:
        for function in ast.walk(parsed(path)):
            if isinstance(function, ast.FunctionDef):
                given = function.args
                known = {arg.arg for arg in (*given.posonlyargs, *given.args, *given.kwonlyargs)}
                known |= {arg.arg for arg in (given.vararg, given.kwarg) if arg is not None}
                gone = documented_arguments(function) - known
                wrong += [f"{path}:{function.lineno}: {function.name} has no {name}" for name in sorted(gone)]
    assert not wrong, "\n".join(wrong)


def constants(tree: ast.Module) -> Iterator[tuple[str, str]]:
    """Yield name and docstring of the module constants that have one."""
    for node, after in pairwise(tree.body):
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        names = [name.id for target in targets if target for name in ast.walk(target) if isinstance(name, ast.Name)]
        said = after.value.value if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant) else None
        if names and names[0].lstrip("_").isupper() and isinstance(said, str):
            yield names[0], said


MEASURED = re.compile(
    r"\b(decision|commit|by hand|(vault|dome|dog|bottle|tetris|armadillo|pavilion)s?\b)", re.IGNORECASE
)


def test_docstrings_of_constants_say_what_they_do() -> None:
    """What was measured when a value was chosen, and on which structure, is in the records and pages on decisions."""
    found = [
        f"{dotted(path)}.{name}" for path in MODULES for name, said in constants(parsed(path)) if MEASURED.search(said)
    ]
    assert found == []


def test_the_check_sees_a_constant() -> None:
    tree = ast.parse('_STEPS: int = 60\n"""Steps; 64 on vaults of 510 parts."""\n')
    assert [MEASURED.search(said) is not None for _, said in constants(tree)] == [True]


def test_core_needs_only_core_packages() -> None:
    """Optional packages are imported inside the function that needs them, never at import time."""
    allowed = {"falsework"} | set(sys.stdlib_module_names) | core_dependencies()
    wrong = [
        f"{path}:{line}: imports {module}, which a plain install does not bring"
        for path in MODULES
        if room_of(dotted(path)) in (*CORE, "", "__main__")
        for module, line in imported_at_load(parsed(path))
        if module.split(".")[0] not in allowed
    ]
    assert not wrong, "\n".join(wrong)


def test_core_imports_without_optional_packages() -> None:
    """Every core module imports in a process where the optional packages do not exist."""
    core = [dotted(path) for path in MODULES if room_of(dotted(path)) in CORE]
    program = (
        "import importlib, sys\n"
        "for name in ('torch', 'matplotlib', 'gymnasium', 'viser'):\n"
        "    sys.modules[name] = None\n"
        f"for name in {core!r}:\n"
        "    importlib.import_module(name)\n"
    )
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1"}  # what is compiled does not matter here
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 0, done.stderr


def test_the_check_sees_a_violation() -> None:
    """The scanner finds imports wherever they hide, and tells load time from call time."""
    tree = ast.parse(
        "from typing import TYPE_CHECKING\n"
        "if TYPE_CHECKING:\n    import torch\n"
        "def late():\n    from falsework.search.plans import plan\n"
        "try:\n    import gymnasium\nexcept ImportError:\n    pass\n"
        "class Box:\n    import matplotlib\n"
    )
    at_load = {name.split(".")[0] for name, _ in imported_at_load(tree)}
    assert at_load == {"typing", "gymnasium", "matplotlib"}
    assert "falsework.search.plans.plan" in {name for name, _ in imports(tree)}


@cache
def public_names() -> dict[str, frozenset[str]]:
    """Public names of the package and its sub-packages, as their stubs list them."""
    found = {}
    for stub in sorted(SOURCE.rglob("__init__.pyi")):
        imported = [node for node in parsed(stub).body if isinstance(node, ast.ImportFrom)]
        found[dotted(stub.with_suffix(".py"))] = frozenset(alias.name for node in imported for alias in node.names)
    return found


def private_uses(code: str) -> list[str]:
    """Names of the package that some code uses although no stub lists them; its errors and built-ins are public."""
    tree, known, wrong = ast.parse(code), {}, []
    open_modules = ("falsework.errors", "falsework.assembly.library")
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                if alias.name.split(".")[0] == "falsework":
                    known[alias.asname or "falsework"] = alias.name if alias.asname else "falsework"
                    wrong += [alias.name] * (alias.name not in {*public_names(), *open_modules})
        elif isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "falsework":
            for alias in node.names:
                path = f"{node.module}.{alias.name}"
                known[alias.asname or alias.name] = path
                public = alias.name in public_names().get(str(node.module), ())
                wrong += [path] * (not public and node.module not in open_modules)
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and re.fullmatch(r"[\w.]+", chain := ast.unparse(node)):
            first, *rest = chain.split(".")
            module = known.get(first, "")
            for name in rest:
                if module not in public_names():
                    break
                module = f"{module}.{name}"
                if name not in public_names()[module.rpartition(".")[0]] and not name.startswith("__"):
                    wrong.append(module)
    return sorted(set(wrong))


def test_public_names_are_few() -> None:
    count = {package: len(names) for package, names in public_names().items()}
    assert sum(count.values()) <= MOST_NAMES, f"{count}; leave out what few users need: it stays in its module"


def test_public_names_exist() -> None:
    for package, names in public_names().items():
        for name in names:
            assert defining_file(package, name) is not None or name in {"__version__"}, f"{package}.{name}"


def test_examples_and_pages_use_public_names() -> None:
    repository = SOURCE.parents[1]
    wrong = [
        (path.name, name) for path in (repository / "examples").glob("*.py") for name in private_uses(path.read_text())
    ]
    for page in [repository / "README.md", *sorted((repository / "docs").rglob("*.md"))]:
        for block in re.findall(r"^```python\n(.*?)^```", page.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE):
            wrong += [(page.name, name) for name in private_uses(block)]
    assert not wrong, wrong


def test_the_check_sees_private_names() -> None:
    assert private_uses("import falsework as fw\nfw.load('x')\nfw.search.BeamSearch") == []
    assert private_uses("from falsework.errors import InputError\nfrom falsework.assembly import library") == []
    assert private_uses("import falsework as fw\nfw.search.Planner") == ["falsework.search.Planner"]
    assert private_uses("from falsework.search.find import find_plans") == ["falsework.search.find.find_plans"]
    assert private_uses("import falsework.cli.main") == ["falsework.cli.main"]
