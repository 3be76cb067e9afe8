"""The wheel and the sdist contain everything that the package needs, and versions and targets agree between files."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path
from typing import Any

import pytest

from falsework import __version__
from falsework.utils.kernel_code import ARCHIVE

pytest.importorskip("hatchling", reason="needs hatchling, of the dependency group test")

REPOSITORY = Path(__file__).resolve().parents[1]
COMPILED = {".a", ".bc", ".dll", ".dylib", ".ll", ".nbc", ".o", ".pyc", ".pyd", ".so", ".whl", ".zip"}
CACHES = {".pyc", ".nbi", ".nbc"}
USE = """
import falsework
from pathlib import Path
assert Path(falsework.__file__).is_relative_to(Path.cwd()), falsework.__file__
from falsework.robots.cells.cell_file import builtin_cells
from falsework.robots.plans.robot_plan_model import robot_plan_schema
from falsework.search.plans.plan_model import plan_schema
from falsework.stability.gpu.driver import kernel_source
assert builtin_cells() and robot_plan_schema() and plan_schema() and kernel_source()
"""


@pytest.fixture(scope="module")
def sdist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sdist, unpacked."""
    folder = tmp_path_factory.mktemp("sdist")
    command = [sys.executable, "-m", "hatchling", "build", "-t", "sdist", "-d", str(folder)]
    subprocess.run(command, cwd=REPOSITORY, check=True, capture_output=True, timeout=120)
    (packed,) = folder.iterdir()
    unpacked = tmp_path_factory.mktemp("unpacked")
    with tarfile.open(packed) as file:
        file.extractall(unpacked, filter="data")
    return next(unpacked.iterdir())


@pytest.fixture(scope="module")
def wheel(sdist: Path, tmp_path_factory: pytest.TempPathFactory) -> zipfile.ZipFile:
    """The wheel that a build frontend builds from the sdist, with the archive of kernels that is made already.

    As pip does where the package is installed as editable, its folder is taken out of `sys.path`.
    """
    if not ARCHIVE.path.is_file():
        pytest.skip("no archive of kernels here: make kernels")
    source = shutil.copytree(sdist, tmp_path_factory.mktemp("source") / sdist.name)
    shutil.copy(ARCHIVE.path, source / "src/falsework")
    folder, site = tmp_path_factory.mktemp("wheel"), tmp_path_factory.mktemp("site")
    editable = "import os, sys\nsys.path = [path for path in sys.path if not os.path.isdir(f'{path}/falsework')]\n"
    (site / "sitecustomize.py").write_text(editable)
    options = ["--no-build-isolation", "--no-deps", "--no-index", "--wheel-dir", str(folder)]
    command = [sys.executable, "-m", "pip", "wheel", *options, str(source)]
    environment = os.environ | {"PYTHONPATH": str(site)}
    subprocess.run(command, check=True, capture_output=True, timeout=120, env=environment)
    return zipfile.ZipFile(next(folder.iterdir()))


def test_the_wheel_holds_every_file_of_the_package(wheel: zipfile.ZipFile) -> None:
    source = REPOSITORY / "src"
    files = [path for path in (source / "falsework").rglob("*") if path.is_file() and path.suffix not in CACHES]
    expected = {path.relative_to(source).as_posix() for path in files}
    packed = {name for name in wheel.namelist() if ".dist-info/" not in name}
    assert packed == expected
    for suffix in (".cuh", ".schema.json", ".toml", "kernels.zip", "py.typed"):
        assert any(name.endswith(suffix) for name in packed), f"no {suffix} in the wheel"


def test_the_sdist_is_source(sdist: Path) -> None:
    """Wheels are built from it; compiled code is not in it."""
    assert (sdist / "kernels/backend.py").is_file()
    assert [path for path in sdist.rglob("*") if path.suffix in COMPILED] == []


def test_no_compiled_code_is_in_git() -> None:
    if not (REPOSITORY / ".git").exists():
        pytest.skip("not a repository")
    listed = subprocess.run(["git", "ls-files"], cwd=REPOSITORY, check=True, capture_output=True, text=True).stdout
    assert [name for name in listed.splitlines() if Path(name).suffix in COMPILED] == []


def test_the_wheel_works_from_its_own_files(wheel: zipfile.ZipFile, tmp_path: Path) -> None:
    """CUDA sources, schemas and cells are read where the wheel was unpacked."""
    wheel.extractall(tmp_path)
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", USE], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_the_wheel_has_licence_version_and_command(wheel: zipfile.ZipFile) -> None:
    info = f"falsework-{__version__}.dist-info"
    metadata = wheel.read(f"{info}/METADATA").decode()
    assert f"\nVersion: {__version__}\n" in metadata
    assert "\nLicense-Expression: Apache-2.0\n" in metadata
    assert f"{info}/licenses/LICENSE" in wheel.namelist()
    assert "falsework = falsework.__main__:main" in wheel.read(f"{info}/entry_points.txt").decode()


def test_the_sdist_can_be_tested(sdist: Path) -> None:
    for name in ("tests/conftest.py", "Makefile", "CHANGELOG.md", "CITATION.cff", "src/falsework/_version.py"):
        assert (sdist / name).is_file(), f"no {name} in the sdist"


@pytest.mark.parametrize(("name", "pattern"), [("CITATION.cff", r"^version: (\S+)$"), ("CHANGELOG.md", r"^## (\d\S*)")])
def test_other_files_name_the_same_version(name: str, pattern: str) -> None:
    found = re.search(pattern, (REPOSITORY / name).read_text(encoding="utf-8"), re.MULTILINE)
    assert found is not None
    assert found[1] == __version__


def configuration(name: str) -> Any:
    """A configuration in YAML, which is part of the repository but not of the sdist."""
    if not (REPOSITORY / name).is_file():
        pytest.skip(f"no {name} here")
    return pytest.importorskip("yaml").safe_load((REPOSITORY / name).read_text(encoding="utf-8"))


def project() -> Any:
    return tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))


def test_the_workflow_runs_targets_of_the_makefile_within_a_time_limit() -> None:
    jobs = configuration(".github/workflows/ci.yml")["jobs"]
    targets = set(re.findall(r"^(\w+):", (REPOSITORY / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    assert set(jobs) <= targets
    for name, job in jobs.items():
        assert [step["run"] for step in job["steps"] if "run" in step] == [f"make {name}"]
        assert job["timeout-minutes"] > 0


def test_the_workflow_tests_every_python_of_the_classifiers() -> None:
    matrix = configuration(".github/workflows/ci.yml")["jobs"]["test"]["strategy"]["matrix"]["python-version"]
    classifiers = " ".join(project()["project"]["classifiers"])
    assert matrix == re.findall(r"Python :: (3\.\d+)", classifiers)
    assert project()["project"]["requires-python"] == f">={matrix[0]}"


@pytest.mark.parametrize(("hook", "package"), [("ruff-pre-commit", "ruff"), ("codespell", "codespell")])
def test_the_hooks_before_a_commit_have_the_versions_of_the_group(hook: str, package: str) -> None:
    repositories = configuration(".pre-commit-config.yaml")["repos"]
    found = next(entry["rev"] for entry in repositories if entry["repo"].endswith(f"/{hook}"))
    pinned = next(text for text in project()["dependency-groups"]["lint"] if text.startswith(package))
    least = re.fullmatch(rf"{package}>=(\d+\.\d+),<\d+\.\d+", pinned)
    assert least is not None
    assert found.startswith(f"v{least[1]}.")
