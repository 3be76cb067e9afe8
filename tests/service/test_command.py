"""`falsework serve`: starts, answers and stops as a process of its own, with a structure or with a trained run."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest

from falsework import load_structure
from falsework.cli.main import main
from falsework.search.plans.plan_check import validate_plan
from falsework.search.plans.plan_file import plan_from_dict

TOKEN = "a-token-of-many-letters"


@contextmanager
def served(
    *options: str | Path, end_by: signal.Signals = signal.SIGTERM, **environment: str
) -> Iterator[dict[str, Any]]:
    """A service in a process of its own; yields what it printed when it was ready, and ends it by a signal."""
    command = [sys.executable, "-m", "falsework", "serve", *map(str, options), "--port", "0", "--workers", "1"]
    pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen([*command, "--json"], env={**os.environ, **environment}, **pipes) as process:
        try:
            assert process.stdout is not None
            yield json.loads(process.stdout.readline())
            children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
            process.send_signal(end_by)
            _, error = process.communicate(timeout=30)
            assert process.returncode == 0, error
            assert error.splitlines()[-1].endswith(" has ended"), error
            assert "Traceback" not in error, error
            assert "a worker was lost" not in error, error
            end = time.monotonic() + 10
            while any(Path(f"/proc/{pid}").exists() for pid in children):
                assert time.monotonic() < end, "a worker outlived the service"
                time.sleep(0.05)
        finally:
            process.kill()


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of a few steps; what its policy does not know, searches do."""
    pytest.importorskip("torch", reason="needs torch; pip install 'falsework[learn]'")
    folder = tmp_path_factory.mktemp("trained") / "run"
    rules = ("--robots", "3", "--removable-only-if-clear")
    assert main(["train", "arch:blocks=3", "--out", str(folder), "--steps", "20", *rules]) == 0
    return folder


def test_a_run_is_served_with_its_policy_and_the_token_of_the_environment(trained: Path) -> None:
    with served(trained, "--host", "0.0.0.0", FALSEWORK_TOKEN=TOKEN) as ready:
        assert ready["structure"] == "arch:blocks=3"
        with httpx.Client(base_url=ready["url"].replace("0.0.0.0", "127.0.0.1"), timeout=60) as client:
            assert client.get("/structure").status_code == 401
            client.headers["Authorization"] = f"Bearer {TOKEN}"
            assert client.get("/structure").json()["policy"] is True
            answers = [client.post("/replan", json={"seed": seed}).json() for seed in range(4)]
    assembly = load_structure("arch:blocks=3")
    for answer in answers:
        plan = plan_from_dict(answer["plans"][0])
        assert validate_plan(plan, assembly).good
        assert (plan.robots, plan.removable_only_if_clear) == (3, True)  # as in training
    assert {answer["decided_by"] for answer in answers} <= {"policy greedy", "policy sampled", "guided search"}


def test_an_interrupt_ends_it_as_a_request_to_terminate_does() -> None:
    with served("arch:blocks=3", end_by=signal.SIGINT) as ready:
        assert ready["structure"] == "arch:blocks=3"


@pytest.mark.parametrize(
    ("options", "hint"),
    [
        (("arch", "--host", "0.0.0.0"), "other machines"),
        (("arch", "--host", "0.0.0.0", "--token", "short"), "openssl rand"),
        (("arch", "--port", "99999"), "99999"),
        (("arch", "--workers", "0"), "workers"),
        (("arhc",), "arhc"),
        (("arch", "--policy", "nowhere"), "nowhere"),
    ],
)
def test_what_cannot_be_served(
    options: tuple[str, ...], hint: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv("FALSEWORK_TOKEN", raising=False)
    assert main(["serve", *options]) == 2
    error = capsys.readouterr().err
    assert hint in error
    assert error.count("\n") == 1


def test_a_run_says_itself_what_its_structure_is(trained: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["serve", str(trained), "--friction", "0.4"]) == 2
    assert "--friction" in capsys.readouterr().err
    assert main(["serve", str(trained), "--policy", str(trained)]) == 2
    assert "--policy" in capsys.readouterr().err


def test_a_run_for_another_structure(trained: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["serve", "arch:blocks=5", "--policy", str(trained)]) == 2
    error = capsys.readouterr().err
    assert "another structure" in error
    assert error.count("\n") == 1


def test_without_fastapi_the_extra_is_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import importlib.util

    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "fastapi" else find(name))
    assert main(["serve", "arch"]) == 2
    assert "falsework[service]" in capsys.readouterr().err
