"""The client package: its own tests, by Python 3.9 where there is one, against a real local service."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from falsework.assembly.store import FORMAT
from falsework.geometry.mesh.read import UNITS

pytest.importorskip("fastapi", reason="the service needs fastapi; pip install 'falsework[service]'")
pytest.importorskip("PIL", reason="needs Pillow; pip install 'falsework[picture]'")

REPOSITORY = Path(__file__).resolve().parents[2]
CLIENT = REPOSITORY / "client"


def oldest_python() -> str:
    """Python 3.9, on the path or of pyenv; else the one that runs this."""
    root = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv"))
    found = [shutil.which("python3.9"), *map(str, sorted(root.glob("versions/3.9.*/bin/python")))]
    for python in filter(None, found):
        if subprocess.run([python, "-c", "import unittest"], capture_output=True, check=False).returncode == 0:
            return python
    return sys.executable


def run(*words: str) -> subprocess.CompletedProcess[str]:
    """Run the client's Python where the client alone can be imported, next to this falsework for its service."""
    paths = os.pathsep.join([str(CLIENT / "src"), str(REPOSITORY / "src")])
    environment = {**os.environ, "PYTHONPATH": paths, "FALSEWORK_PYTHON": sys.executable}
    for name in ("FALSEWORK_URL", "FALSEWORK_TOKEN"):
        environment.pop(name, None)
    command = [oldest_python(), "-B", *words]
    return subprocess.run(command, cwd=CLIENT, env=environment, capture_output=True, text=True, check=False)


def test_all_tests_of_the_client_pass_with_a_real_service() -> None:
    done = run("-m", "unittest", "discover", "-s", "tests", "-t", ".")
    assert done.returncode == 0, done.stderr
    last = done.stderr.strip().splitlines()[-1]
    assert last == "OK", f"tests were left out: {last}"
    ran = re.search(r"^Ran (\d+) tests", done.stderr, re.MULTILINE)
    assert ran is not None
    assert int(ran[1]) > 50


def test_the_client_needs_nothing_but_the_standard_library() -> None:
    program = (
        "import sys; sys.path[:] = [path for path in sys.path if 'site-packages' not in path]\n"
        "before = set(sys.modules)\n"
        "import falsework_client, falsework_client.grasshopper\n"
        "new = {name.partition('.')[0] for name in set(sys.modules) - before}\n"
        "print(*sorted(new - sys.stdlib_module_names))"
    )
    done = subprocess.run(
        [sys.executable, "-B", "-c", program],
        env={**os.environ, "PYTHONPATH": str(CLIENT / "src")},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.split() == ["falsework_client"]


def test_units_and_format_are_those_of_falsework() -> None:
    program = "import json, falsework_client; print(json.dumps(falsework_client.UNITS))"
    assert run("-c", program).stdout.strip() == str(UNITS).replace("'", '"')
    assert FORMAT in (CLIENT / "src" / "falsework_client" / "blocks.py").read_text(encoding="utf-8")


def test_the_code_of_the_readme_runs() -> None:
    (code,) = re.findall(r"^```python\n(.*?)^```", (CLIENT / "README.md").read_text(encoding="utf-8"), re.M | re.S)
    done = run("-c", code)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == ["stable", "insert top", "release top"]
