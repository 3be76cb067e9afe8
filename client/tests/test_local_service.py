"""Start and end of a local service, with a stand-in for falsework."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
import unittest
from pathlib import Path
from typing import Any
from unittest import mock

from falsework_client import ClientError, LocalService, local_service, shared_structure
from falsework_client.local_service import find_command, path_for
from tests.arch import pair

STAND_IN = """
import json, os, sys
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path


class Handler(BaseHTTPRequestHandler):
    def do_GET(self):
        self.send_response(200)
        self.send_header("Content-Type", "application/json")
        self.end_headers()
        self.wfile.write(b"{}")

    def log_message(self, *_):
        pass


def main():
    folder = Path(sys.argv[2])
    assert sys.argv[1] == "serve" and json.loads((folder / "assembly.json").read_text())["parts"] == 2
    assert "FALSEWORK_TOKEN" not in os.environ
    sys.stderr.write("falsework: warning: part 0 was mended\\n")
    MODE
    server = HTTPServer(("127.0.0.1", 0), Handler)
    sys.stderr.flush()
    print(json.dumps({"url": f"http://127.0.0.1:{server.server_port}", "arguments": sys.argv[3:]}), flush=True)
    server.serve_forever()
"""


class Started(unittest.TestCase):
    def setUp(self) -> None:
        scratch = tempfile.TemporaryDirectory()
        self.addCleanup(scratch.cleanup)
        self.package = Path(scratch.name)
        (self.package / "falsework" / "cli").mkdir(parents=True)
        for name in ("falsework", "falsework/cli"):
            (self.package / name / "__init__.py").touch()
        self.stand_in("pass")
        environment = {"PYTHONPATH": str(self.package), "FALSEWORK_PYTHON": sys.executable, "FALSEWORK_TOKEN": "x" * 20}
        self.enter(mock.patch.dict(os.environ, environment))
        self.temporary = Path(scratch.name) / "tmp"
        self.temporary.mkdir()
        self.enter(mock.patch.object(tempfile, "tempdir", str(self.temporary)))

    def enter(self, patch: Any) -> None:
        patch.start()
        self.addCleanup(patch.stop)

    def stand_in(self, mode: str) -> None:
        (self.package / "falsework" / "cli" / "main.py").write_text(STAND_IN.replace("MODE", mode), encoding="utf-8")

    def refused(self, *hints: str, **options: Any) -> None:
        with self.assertRaises(ClientError) as caught:
            LocalService(pair(), unit="m", **options)
        self.assertNotIn("\n", str(caught.exception))
        for hint in hints:
            self.assertIn(hint, str(caught.exception))
        self.assertEqual(list(self.temporary.iterdir()), [])

    def test_it_starts_and_ends_and_leaves_nothing(self) -> None:
        service = LocalService(pair(), unit="m")
        self.assertEqual(len(list(self.temporary.iterdir())), 1)
        local_service.ask(service.url + "/health")
        end = time.monotonic() + 10.0
        while not service.warnings and time.monotonic() < end:  # another thread reads them
            time.sleep(0.01)
        self.assertEqual(service.warnings, ["part 0 was mended"])
        service.stop()
        service.stop()
        self.assertEqual(list(self.temporary.iterdir()), [])
        with self.assertRaises(ClientError):
            local_service.ask(service.url + "/health")

    def test_it_ends_with_this_process_even_if_that_is_killed(self) -> None:
        program = (
            "import os, sys\nfrom falsework_client import LocalService\nfrom tests.arch import pair\n"
            "service = LocalService(pair(), unit='m')\nprint(service.url, flush=True)\n"
        )
        paths = [str(self.package), *(path for path in sys.path if path), str(Path(__file__).parents[1])]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths), "TMPDIR": str(self.temporary)}
        for end in ("", "os.kill(os.getpid(), 9)\n"):
            done = subprocess.run(
                [sys.executable, "-c", program + end], env=environment, stdout=subprocess.PIPE, text=True, timeout=60
            )
            until = time.monotonic() + 20
            while self.answers(done.stdout.strip()):
                self.assertLess(time.monotonic(), until, "the service outlived the process that started it")
                time.sleep(0.05)
            self.assertEqual(done.returncode == 0, not end)

    def answers(self, url: str) -> bool:
        try:
            local_service.ask(url + "/health")
        except ClientError:
            return False
        return True

    def test_a_python_without_falsework(self) -> None:
        self.refused("has no falsework", "FALSEWORK_PYTHON", "pip install", python=f"{sys.executable} -I -S")

    def test_a_python_that_is_not_there(self) -> None:
        self.refused("/nowhere/python3", "FALSEWORK_PYTHON", python="/nowhere/python3")
        self.refused("FALSEWORK_PYTHON", python=" ")

    def test_falsework_says_why_not(self) -> None:
        self.stand_in("sys.stderr.write('falsework: part 0 has no volume; mend it\\n'); sys.exit(2)")
        self.refused("did not start: part 0 has no volume; mend it")
        self.stand_in("raise KeyError('x')")
        self.refused("did not start: KeyError: 'x'")
        self.stand_in("os._exit(3)")
        self.refused("exit code 3")

    def test_something_else(self) -> None:
        self.stand_in("print('hello', flush=True)")
        self.refused("something else than falsework")

    def test_it_takes_too_long(self) -> None:
        self.stand_in("import time; time.sleep(60)")
        with mock.patch.object(local_service, "START_SECONDS", 0.2):
            self.refused("not ready within 0.2 s")

    def test_variables_of_the_python_of_rhino_are_not_handed_on(self) -> None:
        with mock.patch.dict(os.environ, {"PYTHONHOME": "/rhino", "PYTHONPATH": "/rhino"}):
            # The stand-in is found through PYTHONPATH only, which is gone with the home of the other Python.
            self.refused("has no falsework", python=f"{sys.executable} -S")

    def test_services_of_older_structures_end(self) -> None:
        structures = [shared_structure(pair(), unit=unit) for unit in ("m", "cm", "mm")]
        self.addCleanup(lambda: [structure.close() for structure in structures])
        self.assertEqual([self.answers(structure.url) for structure in structures], [False, True, True])
        structures[2].close()
        structures.append(shared_structure(pair(), unit="mm"))
        self.assertIsNot(structures[3], structures[2])
        self.assertTrue(self.answers(structures[3].url))


class Command(unittest.TestCase):
    def test_the_python_beside_the_command(self) -> None:
        with (
            tempfile.TemporaryDirectory() as folder,
            mock.patch.dict(os.environ, {"FALSEWORK_PYTHON": "", "PATH": folder}),
        ):
            with self.assertRaises(ClientError) as caught:
                find_command()
            self.assertIn("FALSEWORK_PYTHON", str(caught.exception))
            for name in ("falsework", "python"):
                file = Path(folder) / name
                file.write_text("#!/bin/sh\n")
                file.chmod(0o755)
            self.assertEqual([Path(word).name for word in find_command()], ["python"])

    def test_paths_in_the_linux_subsystem_of_windows(self) -> None:
        folder = "C:\\Users\\Ada L\\Temp\\falsework-1"
        for command in (["wsl"], ["C:\\Windows\\System32\\wsl.exe", "--exec", "/home/ada/bin/python"]):
            self.assertEqual(path_for(command, folder), "/mnt/c/Users/Ada L/Temp/falsework-1")
        self.assertEqual(path_for(["python"], folder), folder)
        self.assertEqual(path_for(["wsl"], "/tmp/falsework-1"), "/tmp/falsework-1")
