"""The Python API as users meet it: `import falsework as fw`, and the public names of the packages below."""

from __future__ import annotations

import ast
import importlib
import inspect
import pkgutil
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

import falsework as fw
from falsework import Assembly, Outcome, make_task
from falsework.assembly import complete_state
from falsework.errors import DependencyError, InputError, NotFoundError, PlanError, ReadWarning
from falsework.search.plans.plan_file import plan_to_dict
from falsework.search.plans.plan_source import structure_of_plan
from falsework.utils.files import formats as registry

REPOSITORY = Path(__file__).resolve().parents[1]
ROOMS = ("assembly", "geometry", "interop", "learn", "replanning", "robots", "search", "service", "stability", "viewer")
FUNCTIONS = ("animate", "export", "open_file", "picture", "replan", "train", "view")
UNTYPED: Any = fw
"""The package as those see it who check no types."""
OPTIONAL = ("torch", "viser", "fastapi", "uvicorn", "gymnasium", "matplotlib", "PIL", "safetensors")


@pytest.fixture(scope="module")
def arch() -> Assembly:
    return fw.load_structure("arch:blocks=5")


@pytest.fixture(scope="module")
def plan(arch: Assembly) -> fw.Plan:
    return fw.find_plans(arch, robots=2).plans[0]


def in_a_fresh_process(program: str) -> str:
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_import_is_quick_and_light() -> None:
    """At most 60 ms of processor time, the best of five processes, since other work may share the cores."""
    program = (
        "import sys, time; begun = time.process_time(); import falsework; spent = time.process_time() - begun; "
        "heavy = {'numpy', 'numba', 'scipy', 'torch', 'trimesh'} & set(sys.modules); print(spent, *sorted(heavy))"
    )
    runs = [in_a_fresh_process(program).split() for _ in range(5)]
    assert all(not {"numba", "torch"} & set(run) for run in runs)
    assert min(float(run[0]) for run in runs) < 0.06


def package(name: str) -> ModuleType:
    return importlib.import_module(f"falsework.{name}" if name else "falsework")


@pytest.mark.parametrize("name", ["", *ROOMS])
def test_public_names_are_there(name: str) -> None:
    """Every name in `__all__` resolves to the object of its own module, is listed by `dir`, and has a docstring."""
    room = package(name)
    assert len(set(room.__all__)) == len(room.__all__) > 0
    assert set(room.__all__) <= set(dir(room))
    for public in room.__all__:
        value = getattr(room, public)
        if inspect.isclass(value) or inspect.isfunction(value):
            assert value.__module__.startswith(f"falsework.{name}." if name else "falsework.")
            assert value.__doc__, public
    with pytest.raises(AttributeError, match="has no attribute 'no_such_name'"):
        _ = room.no_such_name


def test_no_class_name_means_two_things() -> None:
    """In the whole package, exported or not; a class that only its own module uses begins with an underscore."""
    found: dict[str, Path] = {}
    source = REPOSITORY / "src" / "falsework"
    for path in sorted(source.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                assert found.setdefault(node.name, path) == path, node.name
    assert len(found) > 100


@pytest.mark.parametrize("name", ["", *ROOMS])
def test_no_module_shadows_an_exported_function(name: str) -> None:
    """A submodule of the same name would replace the function as soon as something imports it."""
    room = package(name)
    modules = {entry.name for entry in pkgutil.iter_modules(room.__path__)}
    for public in modules & set(room.__all__):
        assert isinstance(getattr(room, public), ModuleType), f"falsework.{name}: {public} is a module and a name"


def test_functions_stay_functions_after_all_imports() -> None:
    pytest.importorskip("torch", reason="fw.train needs torch; pip install 'falsework[learn]'")
    in_a_fresh_process(
        "import importlib, pkgutil, falsework as fw\n"
        f"for name in {ROOMS!r}:\n"
        "    room = importlib.import_module('falsework.' + name)\n"
        "    for entry in pkgutil.iter_modules(room.__path__, room.__name__ + '.'):\n"
        "        try:\n"
        "            importlib.import_module(entry.name)\n"
        "        except ModuleNotFoundError:\n"
        "            pass\n"
        f"for name in {FUNCTIONS!r}:\n"
        "    assert type(getattr(fw, name)).__name__ == 'function', name\n"
    )


def test_rooms_import_without_optional_packages() -> None:
    """A name that needs a package which is not there says which extra brings it; the others work."""
    in_a_fresh_process(
        f"import importlib, sys\nfor name in {OPTIONAL!r}:\n    sys.modules[name] = None\n"
        "import falsework as fw\n"
        f"for name in {ROOMS!r}:\n    importlib.import_module('falsework.' + name)\n"
        "assert fw.learn.TrainSettings and fw.service.ServiceSettings and fw.viewer.Timeline and fw.robots.Cell\n"
        "for read in (lambda: fw.train, lambda: fw.learn.Environment, lambda: fw.service.run_service):\n"
        "    try:\n"
        "        read()\n"
        "    except fw.errors.DependencyError as error:\n"
        "        assert 'pip install' in str(error), error\n"
        "    else:\n"
        "        raise AssertionError('no error')\n"
    )


def test_commands_that_need_torch_say_what_to_install(tmp_path: Path) -> None:
    lines = "train arch:blocks=3", "replan .", "evaluate .", "robots plan stack:blocks=2 --cell bottle-12 --policy ."
    (tmp_path / "run.json").write_text('{"format": "falsework.run/2"}')
    said = in_a_fresh_process(
        "import contextlib, importlib.machinery as machinery, io, os\n"
        f"os.chdir({str(tmp_path)!r})\n"
        "find = machinery.PathFinder.find_spec\n"
        "def without(name, path=None, target=None):\n"
        "    return None if name.split('.')[0] == 'torch' else find(name, path, target)\n"
        "machinery.PathFinder.find_spec = without\n"
        "from falsework.cli.main import main\n"
        f"for line in {lines!r}:\n"
        "    with contextlib.redirect_stderr(io.StringIO()) as error:\n"
        "        code = main(line.split())\n"
        "    print(code, error.getvalue(), end='')\n"
    ).splitlines()
    assert len(said) == len(lines)
    for line in said:
        assert line.startswith("2 falsework: ")
        assert "needs torch; pip install 'falsework[learn]'" in line


def imported_modules(text: str) -> list[str]:
    modules = []
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.ImportFrom):
            modules.append(node.module or "")
        elif isinstance(node, ast.Import):
            modules += [alias.name for alias in node.names]
    return [module for module in modules if module.split(".")[0] == "falsework"]


def test_examples_and_pages_import_nothing_deeper_than_a_room() -> None:
    sources = {path: path.read_text(encoding="utf-8") for path in (REPOSITORY / "examples").glob("[0-9]*.py")}
    docs = REPOSITORY / "docs"
    for path in [REPOSITORY / "README.md", *docs.glob("tutorials/*.md"), *docs.glob("api/*.md")]:
        blocks = re.findall(r"^```python\n(.*?)^```", path.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
        sources[path] = "\n".join(blocks)
    assert sum(bool(imported_modules(text)) for text in sources.values()) >= 12
    for path, text in sources.items():
        for module in imported_modules(text):
            assert module.count(".") <= 1, f"{path.name} imports {module}"


def test_every_room_has_a_page() -> None:
    for name in ROOMS:
        page = (REPOSITORY / "docs" / "api" / f"{name}.md").read_text(encoding="utf-8")
        assert f".. automodule:: falsework.{name}\n" in page
        assert set(re.findall(r"automodule:: falsework\.(\S+)", page)) <= {
            name,
            "assembly.library",
            "stability.judges",
        }


def test_plans_are_found_without_making_a_task(arch: Assembly) -> None:
    by_name = fw.find_plans(arch, robots=3, missing=[2])
    by_task = fw.find_plans(arch, fw.Task.from_rules(arch.boundary, 3, missing=[2], identity=arch.identity))
    np.testing.assert_array_equal(by_name.plans[0].actions, by_task.plans[0].actions)
    assert by_name.plans[0].robots == 3
    assert by_name.plans[0].missing == (2,)
    assert fw.find_plans(arch, robots=1).result.outcome is not Outcome.FOUND
    assert make_task(arch, removable_only_if_clear=True).clearance is arch.straight_ways
    with pytest.raises(InputError, match="robots"):
        fw.find_plans(arch, make_task(arch), robots=2)


def test_every_function_takes_a_structure_by_name_or_path(arch: Assembly, plan: fw.Plan, tmp_path: Path) -> None:
    """What works with an `Assembly` works with what `load_structure` reads, and says so of anything else."""
    fw.save(arch, tmp_path / "mine")
    start = plan.states[4]
    calls: list[Callable[[Any], Any]] = [
        lambda given: fw.find_plans(given, robots=2).plans[0].actions.tolist(),
        lambda given: fw.min_robots(given).value,
        lambda given: make_task(given, 2).identity,
        lambda given: fw.replan(given, start).plans[0].actions.tolist(),
        lambda given: fw.Replanner(given).replan(start).plans[0].actions.tolist(),
        lambda given: fw.check(given, plan).good,
        lambda given: fw.StabilityOracle(given).verdicts(start[None]).stable.tolist(),
        lambda given: fw.export(given, tmp_path / "copy.glb"),
        lambda given: fw.open_file(tmp_path / "plan.json", given).kind,
    ]
    fw.save(plan, tmp_path / "plan.json")
    for call in calls:
        wanted = call(arch)
        for given in ("arch:blocks=5", tmp_path / "mine", str(tmp_path / "mine")):
            found = call(given)
            assert found == wanted
        with pytest.raises(InputError, match="no folder, file or built-in structure 'nowhere'"):
            call("nowhere")
        with pytest.raises(InputError, match="a structure is an Assembly, a name or a path, not list"):
            call([arch])
    with pytest.raises(InputError, match="str has no file; save an assembly, a plan, a robot plan or a state graph"):
        fw.save("arch:blocks=5", tmp_path / "copy")  # type: ignore[arg-type]


def test_robots_take_structure_and_cell_by_name() -> None:
    cell = fw.load_cell("bottle-12", check=False)
    stack = "stack:blocks=2"
    for given in (cell, "bottle-12"):
        with pytest.raises(InputError, match="configuration of front has shape"):
            fw.plan_robots(stack, given, configurations=[[0.0]] * 2)
    with pytest.raises(InputError, match="a cell is a Cell, a name or a file, not int"):
        fw.plan_robots(stack, 3)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="unknown cell nowhere"):
        fw.plan_robots(stack, "nowhere")


def test_replan_takes_the_fields_of_a_request(arch: Assembly, plan: fw.Plan) -> None:
    answer = fw.replan(arch, plan.states[4], robots=3)
    np.testing.assert_array_equal(answer.plans[0].states[-1], plan.states[4])
    assert answer.plans[0].robots == 3


def test_one_function_reads_every_structure(arch: Assembly, tmp_path: Path) -> None:
    fw.export(arch, tmp_path / "folder")
    fw.export(arch, tmp_path / "arch.json", format="compas-dem")
    fw.export(arch, tmp_path / "arch.glb")
    assert fw.load_structure(tmp_path / "folder").identity == arch.identity
    assert fw.load_structure(tmp_path / "arch.json").identity == arch.identity
    assert fw.load_structure(str(tmp_path / "arch.json"), friction=0.3).friction == 0.3
    assert (tmp_path / "arch.glb").read_bytes()[:4] == b"glTF"
    with pytest.raises(InputError, match="no export format"):
        fw.export(arch, tmp_path / "arch.xyz", format="xyz")


PACKAGE = """
from pathlib import Path

import falsework as fw
from falsework import Exporter, Reader


def load(path, **options):
    return fw.load_structure(path.read_text(), **options)


def write(assembly, path, plan, step_seconds=1.0):
    Path(path).write_text(f"{assembly.name} {0 if plan is None else len(plan)} {step_seconds}")


READER = Reader((".mine",), load, recognizes=lambda path: path.read_text().startswith("arch"))
EXPORTER = Exporter(write, (".mine",), ("Assembly", "Plan"), ("step_seconds",))
"""


@pytest.fixture
def plugin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Another package with a format of its own, found as installed packages are."""
    (tmp_path / "my_format.py").write_text(PACKAGE)
    metadata = tmp_path / "my_format-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: my-format\nVersion: 1.0\n")
    groups = {"readers": "READER", "exporters": "EXPORTER"}
    text = "".join(f"[falsework.{group}]\nmine = my_format:{name}\n" for group, name in groups.items())
    (metadata / "entry_points.txt").write_text(text)
    monkeypatch.syspath_prepend(str(tmp_path))
    registry._points.cache_clear()
    yield tmp_path
    registry._points.cache_clear()
    sys.modules.pop("my_format", None)


def test_another_package_adds_a_format(arch: Assembly, plan: fw.Plan, plugin: Path) -> None:
    file = plugin / "arch.mine"
    file.write_text("arch:blocks=5")
    loaded = fw.load(file)
    assert isinstance(loaded, Assembly)
    assert loaded.identity == fw.load_structure(file).identity == arch.identity
    assert fw.load_structure(file, friction=0.9).friction == 0.9
    fw.save(arch, plugin / "out.mine")
    assert (plugin / "out.mine").read_text() == "arch:blocks=5 0 1.0"
    fw.export(plan, plugin / "plan.mine", arch, step_seconds=2.0)
    assert (plugin / "plan.mine").read_text() == f"arch:blocks=5 {len(plan)} 2.0"
    file.write_text("dome")
    with pytest.raises(InputError, match=r"cannot read .*arch.mine; a structure is .* mine \(\.mine\)"):
        fw.load_structure(file)
    with pytest.raises(InputError, match="--azimuth is no option of mine; leave it out"):
        fw.export(plan, plugin / "plan.mine", arch, azimuth=3.0)


def test_the_command_knows_formats_of_other_packages(plugin: Path) -> None:
    words = [(str(plugin / "out.mine"),), (str(plugin / "other"), "--format", "mine")]
    in_a_fresh_process(
        f"import sys; sys.path[:] = {sys.path!r}\n"
        "from falsework.cli.main import main\n"
        f"for words in {words!r}:\n"
        "    assert main(['export', 'arch:blocks=5', '--out', *words]) == 0\n"
    )
    for name, *_ in words:
        assert Path(name).read_text() == "arch:blocks=5 0 1.0"


def test_a_format_that_cannot_be_imported_is_left_out(plugin: Path) -> None:
    (plugin / "my_format.py").write_text("import a_package_that_is_not_there")
    with pytest.warns(ReadWarning, match="the format mine of my_format:READER cannot be used: No module named 'a_pack"):
        assert "mine" not in registry.formats(registry.READERS)


def test_without_an_installation_there_are_no_formats(plugin: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.metadata.entry_points", lambda group: ())
    with pytest.raises(DependencyError, match="it is not installed; pip install -e that folder"):
        registry.formats(registry.READERS)


def test_the_structure_of_a_plan_is_found(arch: Assembly, plan: fw.Plan, tmp_path: Path) -> None:
    built_in = replace(plan, source={"built_in": "arch:blocks=5"})
    assert structure_of_plan(built_in).identity == arch.identity
    assert structure_of_plan(plan, structure=arch) is arch
    assert structure_of_plan(plan, structure="arch:blocks=5").identity == arch.identity
    fw.save(arch, tmp_path / "mine")
    beside = replace(plan, source={"path": "mine"})
    assert structure_of_plan(beside, tmp_path / "plan.json").identity == arch.identity
    with pytest.raises(PlanError, match="gone"):
        structure_of_plan(beside, tmp_path / "elsewhere" / "plan.json")
    assert structure_of_plan(plan).identity == arch.identity  # as saved from Python: by its name, if that is built in
    for name in ("mine", "arch:blocks=6"):
        with pytest.raises(PlanError, match="does not say"):
            structure_of_plan(replace(plan, name=name))


def test_files_and_objects_are_opened_alike(arch: Assembly, plan: fw.Plan, tmp_path: Path) -> None:
    graph = fw.StateGraph.from_states(make_task(arch), plan.states, name="arch:blocks=5")
    fw.save(plan, tmp_path / "plan.json")
    fw.save(graph, tmp_path / "graph.npz")
    kinds = [
        fw.open_file(tmp_path / "plan.json", arch),
        fw.open_file(tmp_path / "graph.npz"),
        fw.open_file("arch:blocks=5"),
    ]
    assert [shown.kind for shown in kinds] == ["plan", "graph", "structure"]
    assert all(shown.assembly.identity == arch.identity for shown in kinds)
    opened = fw.load(tmp_path / "plan.json")
    assert isinstance(opened, fw.Plan)
    assert kinds[0].plan is not None
    assert plan_to_dict(kinds[0].plan) == plan_to_dict(opened)
    (tmp_path / "no.json").write_text('{"format": "falsework.census/1"}')
    with pytest.raises(InputError, match="cannot be shown"):
        fw.open_file(tmp_path / "no.json")


def test_pictures_are_drawn_by_one_call(arch: Assembly, plan: fw.Plan, tmp_path: Path) -> None:
    pytest.importorskip("PIL", reason="pictures need Pillow; pip install 'falsework[picture]'")
    sheet = fw.picture(plan, tmp_path / "sheet.png", arch, frames=4, columns=2, width=100)
    assert len(sheet.places) == 4
    assert sheet.unstable is None
    state = fw.picture(complete_state(arch.boundary), tmp_path / "state.png", arch, width=100, verdicts=True)
    assert state.unstable == ()
    lines = fw.picture(arch, tmp_path / "arch.svg")
    assert lines.places == (0,)
    assert (tmp_path / "sheet.png").read_bytes()[:4] == (tmp_path / "state.png").read_bytes()[:4] == b"\x89PNG"
    assert (tmp_path / "arch.svg").read_text().startswith("<svg")
    film = fw.animate(plan, tmp_path / "plan.gif", arch, width=80, rate=1.0, seconds=1.0)
    assert film.pictures >= len(plan) + 1
    with pytest.raises(InputError, match="which structure"):
        fw.picture(plan.states[0], tmp_path / "state.png")
    with pytest.raises(PlanError, match="does not say"):
        fw.picture(replace(plan, name="mine"), tmp_path / "sheet.png")


def test_a_plan_is_shown_by_one_call(arch: Assembly, plan: fw.Plan) -> None:
    pytest.importorskip("viser", reason="the page needs viser; pip install 'falsework[viewer]'")
    page = fw.view(plan, arch, port=0, browser=False, wait=False)
    try:
        assert page.address.startswith("http://localhost:")
        assert len(page.model.timeline) == len(plan)
        assert page.model.plan is plan
    finally:
        page.close()
    with pytest.raises(InputError, match="no port"):
        fw.view(plan, arch, port=70000)


def test_results_print_as_one_line(arch: Assembly, plan: fw.Plan) -> None:
    """What a notebook shows has the numbers that matter and no arrays."""
    planning, oracle = fw.find_plans(arch, robots=1), fw.StabilityOracle(arch)
    lines = {
        repr(arch): "7 parts, 2 of them boundary, 6 contacts",
        repr(arch.meshes[0]): "voussoir-0: 8 vertices",
        repr(arch.contacts): "6 with 24 points",
        repr(plan): "10 steps with 2 robots, criterion contact",
        repr(planning): "proved_impossible",
        repr(fw.find_plans(arch, robots=2)): "found, <Plan",
        repr(fw.min_robots(arch)): "found, 2",
        repr(make_task(arch)): "for 2 robots: from 7 to 2 of 7 parts",
        repr(fw.replan(plan, step=2, structure=arch)): "found, <Plan",
        repr(fw.check(arch, plan)): "all 11 states are stable as built",
        repr(fw.sheet(arch, plan)): "10 steps with 2 supports",
        repr(fw.margins(arch)[0]): "friction 0.2",
        repr(oracle.verdicts(plan.states, require_certificate=True)): "11 states: 11 stable",
        repr(oracle.verdicts(plan.states[:1] * 0 + 2 * arch.boundary, require_certificate=True)): "1 state",
        repr(fw.load_cell("bottle-12", check=False)): "robots front, back",
    }
    for line, words in lines.items():
        assert line.startswith("<")
        assert words in line
        assert len(line) < 200
        assert "\n" not in line


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda arch, plan: UNTYPED.find_plans(arch, robots="2"), "robots is '2'; give a whole number"),
        (lambda arch, plan: UNTYPED.find_plans(arch, robots=2.5), "robots is 2.5; give a whole number"),
        (lambda arch, plan: UNTYPED.find_plans(arch, missing=["door"]), "missing is part 'door', which does not exist"),
        (lambda arch, plan: UNTYPED.find_plans(arch, fixed="3"), "give a list of part numbers or names"),
        (lambda arch, plan: UNTYPED.replan(arch, plan.states[4], missing=[2.5]), "give a list of part numbers"),
        (
            lambda arch, plan: arch.replace(loads=fw.assembly.Loads.from_arrays(3)),
            "loads are of 3 parts, but there are",
        ),
        (lambda arch, plan: UNTYPED.Assembly.from_meshes([5], boundary=[0]), "a part is a int; make it a TriangleMesh"),
        (
            lambda arch, plan: fw.Assembly.from_meshes([replace(mesh, name=" ") for mesh in arch.meshes], boundary=[0]),
            "the name of part 0 is ' '; give a text that is not blank",
        ),
        (
            lambda arch, plan: UNTYPED.picture(plan, None, arch, frames=float("nan")),
            "frames is nan; give a whole number",
        ),
        (lambda arch, plan: UNTYPED.animate(plan, "a.gif", arch, width=300.5), "width is 300.5; give a whole number"),
        (lambda arch, plan: UNTYPED.doctor(None), "NoneType names no structure or file; give a name or a path"),
        (lambda arch, plan: UNTYPED.load(None), "NoneType names no structure or file; give a name or a path"),
        (lambda arch, plan: UNTYPED.save([plan], "plan.json"), "list has no file; save an assembly, a plan"),
        (lambda arch, plan: UNTYPED.check(plan, arch), "Assembly is no plan; give the structure first"),
        (lambda arch, plan: UNTYPED.sheet(plan, arch), "Assembly is no plan; give the structure first"),
        (lambda arch, plan: UNTYPED.picture(fw.StabilityOracle(arch), "arch.png"), "StabilityOracle cannot be shown"),
    ],
)
def test_wrong_types_get_one_line(arch: Assembly, plan: fw.Plan, call: Callable[..., Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        call(arch, plan)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (
            lambda arch, plan: UNTYPED.load_structure("arch", frcition=0.5),
            "load_structure: the option frcition is not known; did you mean",
        ),
        (
            lambda arch, plan: UNTYPED.doctor("tests", boundaries=[0]),
            "doctor: the option boundaries is not known; did you mean",
        ),
        (
            lambda arch, plan: UNTYPED.picture(plan, None, arch, frame=3),
            "picture: the option frame is not known; did you mean",
        ),
        (
            lambda arch, plan: UNTYPED.animate(plan, "a.gif", arch, second=3),
            "animate: the option second is not known; did you mean",
        ),
        (lambda arch, plan: UNTYPED.view(plan, arch, prot=80), "view: the option prot is not known; did you mean"),
        (
            lambda arch, plan: UNTYPED.open_file("arch", robot=2),
            "open_file: the option robot is not known; did you mean",
        ),
        (
            lambda arch, plan: UNTYPED.export(arch, "a.glb", formatt="glb"),
            "export: the option formatt is not known; did you mean",
        ),
        (
            lambda arch, plan: UNTYPED.min_robots(arch, missing_parts=[2]),
            "min_robots: the option missing_parts is not known; did you mean",
        ),
        (
            lambda arch, plan: UNTYPED.replan(plan, step=1, structure=arch, deadlin=9),
            "replan: the option deadlin is not known; did you mean",
        ),
    ],
)
def test_a_misspelt_option_names_the_one_meant(
    arch: Assembly, plan: fw.Plan, call: Callable[..., Any], words: str
) -> None:
    with pytest.raises(InputError, match=words):
        call(arch, plan)


def test_parts_are_given_by_number_or_name(arch: Assembly, plan: fw.Plan) -> None:
    name = arch.names[2]
    assert fw.find_plans(arch, missing=[name]).plans[0].missing == (2,)
    assert fw.find_plans(arch, target=plan.states[-3], fixed=[arch.names[-1]]).found
    by_name, by_number = (fw.replan(arch, plan.states[0], missing=[part]).plans[0] for part in (name, 2))
    np.testing.assert_array_equal(by_name.states, by_number.states)
    named = fw.Assembly.from_meshes(arch.meshes, boundary=[arch.names[part] for part in np.flatnonzero(arch.boundary)])
    np.testing.assert_array_equal(named.boundary, arch.boundary)


def test_numbers_of_numpy_are_numbers(arch: Assembly) -> None:
    assert UNTYPED.find_plans(arch, robots=np.int64(2), missing=np.array([2])).found


def test_planners_answer_with_one_kind_of_result(arch: Assembly, plan: fw.Plan) -> None:
    """A value with what is known of it, or the reason why there is none; the kinds differ in their values alone."""
    found: list[fw.Result[Any]] = [
        fw.find_plans(arch, robots=2),
        fw.replan(arch, plan.states[4]),
        fw.min_robots(arch),
        fw.maximise_margin(arch, make_task(arch, 2), "friction"),
    ]
    for result, kind in zip(found, (fw.Plan, fw.Plan, int, fw.Plan), strict=True):
        assert isinstance(result, fw.Result)
        assert isinstance(result.unwrap(), kind)
        assert result.unwrap() is result.value
        assert (result.found, result.outcome, result.reason) == (True, Outcome.FOUND, "")
        assert result.statistics["seconds"] >= 0
        assert result.statistics["verdicts"] > 0
    assert [result.bound for result in found[:3]] == [None, None, 2]  # two robots are proved to be the fewest
    friction = fw.margins(arch, found[3].unwrap(), ["friction"])
    weakest = max(state.friction.value or 0.0 for state in friction if state.friction is not None)
    assert 0 < (found[3].bound or 0.0) <= weakest * 1.03  # no plan needs less than the bound says


def test_results_without_a_value_say_why(arch: Assembly, plan: fw.Plan) -> None:
    none: list[fw.Result[Any]] = [fw.find_plans(arch, robots=1), fw.replan(arch, plan.states[-1], robots=1)]
    for result in none:
        assert (result.found, result.value, result.outcome) == (False, None, Outcome.PROVED_IMPOSSIBLE)
        with pytest.raises(NotFoundError, match="it is proved that there is none"):
            result.unwrap()


def test_margins_of_plans_and_of_states_agree(arch: Assembly, plan: fw.Plan) -> None:
    whole, row = fw.margins(arch, plan, ["friction"]), 3
    assert len(whole) == len(plan.states)
    one, same = fw.margins("arch:blocks=5", plan.states[row], ["friction"])[0].friction, whole[row].friction
    assert one is not None
    assert same is not None
    assert one.value == pytest.approx(same.value, rel=0.02)
    (complete,) = fw.margins(arch, kinds=["tilt"])
    assert complete.tilt is not None
    assert complete.friction is None
    with pytest.raises(PlanError, match="the plan"):
        fw.margins("arch:blocks=7", plan)


def test_margins_of_a_plan_are_those_of_states_as_built() -> None:
    """As of the command: a state may slide from rest that the plan reaches in balance."""
    vault = fw.load_structure("vault:parts=30")
    plan = fw.find_plans(vault, robots=2).unwrap()
    row = int(np.argmax(fw.StabilityOracle(vault).verdicts(plan.states).slides))
    assert row
    assert not fw.margins(vault, plan.states[row], ["friction"])[0].stands
    assert all(state.stands for state in fw.margins(vault, plan, ["held"]))


def test_a_plan_without_motions_needs_no_cell(arch: Assembly, plan: fw.Plan) -> None:
    with pytest.raises(InputError, match="needs no cell; leave it out"):
        UNTYPED.check(arch, plan, "bottle-12")
