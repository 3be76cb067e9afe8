"""Local service: a process of a Python that has falsework, for as long as this process lives."""

from __future__ import annotations

import collections
import contextlib
import json
import os
import queue
import re
import shlex
import shutil
import subprocess
import tempfile
import threading
import time
import weakref
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TextIO

from falsework_client.blocks import Block, write_folder
from falsework_client.errors import ClientError
from falsework_client.http import ask

PYTHON_VARIABLE = "FALSEWORK_PYTHON"
START_SECONDS = 300.0
"""For a service to start; the first start on a machine compiles the solvers."""
_STOP_SECONDS = 10.0
_NO_FALSEWORK = 86
"""Exit code of a Python that has no falsework."""

# The service ends when its standard input does, which also happens if this process is killed.
_RUN = f"""\
import os, signal, sys, threading


def watch():
    while os.read(0, 1024):
        pass
    os.kill(os.getpid(), signal.SIGTERM)


if __name__ == "__main__":
    try:
        from falsework.cli.main import main
    except (ImportError, SyntaxError):
        sys.exit({_NO_FALSEWORK})
    threading.Thread(target=watch, daemon=True).start()
    sys.exit(main())
"""


class LocalService:
    """Service for some blocks on a free port of this machine; it ends with `stop`, or with this process."""

    def __init__(
        self, blocks: Sequence[Block], *, python: str | None = None, ground: bool = False, **options: Any
    ) -> None:
        """Start the service and wait until it is healthy.

        Args:
            blocks: of the structure.
            python: the Python that has falsework, or a command that runs it; by default the environment variable
                `FALSEWORK_PYTHON`, then the command `falsework` on the path.
            ground: whether falsework adds a fixed ground below the lowest point, as the last part.
            **options: of `write_folder`.

        Raises:
            ClientError: the blocks make no structure, or no service can be started for them.
        """
        command = find_command(python)
        folder = Path(tempfile.mkdtemp(prefix="falsework-"))
        self._end = weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
        try:
            write_folder(blocks, folder / "structure", ground=ground, **options)
            (folder / "run.py").write_text(_RUN, encoding="utf-8")
            process = _start(command, folder, ground)
            self._end.detach()
            self._end = weakref.finalize(self, _stop, process, folder)
            self._lines: collections.deque[str] = collections.deque(maxlen=200)
            self.url = self._wait(process, command)
            """Where it answers."""
        except BaseException:
            self._end()
            raise

    @property
    def warnings(self) -> list[str]:
        """What falsework remarks on the blocks, such as a mesh that it mended."""
        mark = "falsework: warning: "
        return [line[len(mark) :].strip() for line in list(self._lines) if line.startswith(mark)]

    def stop(self) -> None:
        """End the service."""
        self._end()

    def _wait(self, process: subprocess.Popen[str], command: Sequence[str]) -> str:
        """Return the address once the service is healthy."""
        first: queue.Queue[str] = queue.Queue()
        assert process.stdout is not None
        assert process.stderr is not None
        listener = threading.Thread(target=_gather, args=(process.stderr, self._lines.append), daemon=True)
        listener.start()
        threading.Thread(target=_gather, args=(process.stdout, first.put), daemon=True).start()
        end = time.monotonic() + START_SECONDS
        try:
            line = first.get(timeout=START_SECONDS)
        except queue.Empty:
            raise ClientError(
                f"the service was not ready within {START_SECONDS:g} s; try a smaller structure"
            ) from None
        try:
            answer = json.loads(line) if line else {}
            if not line or answer.get("ok") is False:
                code = process.wait()
                listener.join(_STOP_SECONDS)
                raise ClientError(_why(command, code, [text.strip() for text in self._lines if text.strip()]))
            url = answer["url"]
        except (ValueError, TypeError, KeyError, AttributeError):
            raise ClientError(f"{' '.join(command)} runs something else than falsework; {_REMEDY}") from None
        while True:
            try:
                ask(url + "/health")
                return url
            except ClientError:
                if time.monotonic() > end:
                    raise
                time.sleep(0.1)


_REMEDY = f"set {PYTHON_VARIABLE} to the Python in which pip install 'falsework[service,picture]' was run"


def find_command(python: str | None = None) -> list[str]:
    """Return the words of the command that runs a Python with falsework.

    The Python of this process is never used: in Rhino, its executable is Rhino.

    Raises:
        ClientError: there is none, or it cannot be run.
    """
    given = python or os.environ.get(PYTHON_VARIABLE)
    if given:
        words = [given] if shutil.which(given) else shlex.split(given, posix=os.name != "nt")
        if not words or shutil.which(words[0]) is None:
            raise ClientError(f"there is no Python {given}; {_REMEDY}")
        return words
    script = shutil.which("falsework")
    if script is not None:
        for name in ("python", "python3", "python.exe"):
            beside = shutil.which(name, path=str(Path(script).resolve().parent))
            if beside is not None:
                return [beside]
    raise ClientError(f"no Python with falsework is known; {_REMEDY}")


def path_for(command: Sequence[str], path: Path | str) -> str:
    """Return a path as the command sees it: a drive of Windows is a folder in its Linux subsystem."""
    drive = re.match(r"([A-Za-z]):[\\/](.*)", str(path))
    if drive and Path(command[0].replace("\\", "/")).stem.lower() == "wsl":
        return f"/mnt/{drive[1].lower()}/" + drive[2].replace("\\", "/")
    return str(path)


def _start(command: Sequence[str], folder: Path, ground: bool) -> subprocess.Popen[str]:
    words = [*command, path_for(command, folder / "run.py"), "serve", path_for(command, folder / "structure")]
    words += ["--port", "0", "--workers", "1", "--json"] + (["--ground"] if ground else [])
    environment = {name: value for name, value in os.environ.items() if name != "FALSEWORK_TOKEN"}
    if environment.pop("PYTHONHOME", None) is not None:  # Rhino sets both, for its own Python
        environment.pop("PYTHONPATH", None)
    try:
        return subprocess.Popen(
            words,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            encoding="utf-8",
            errors="replace",
            env=environment,
            creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
        )
    except OSError as error:
        raise ClientError(f"{command[0]} cannot be run ({error.strerror or error}); {_REMEDY}") from None


def _gather(stream: TextIO, take: Callable[[str], object]) -> None:
    """Hand on each line of a stream until its end, and then an empty one."""
    with stream:
        for line in stream:
            take(line)
    take("")


def _why(command: Sequence[str], code: int, lines: Sequence[str]) -> str:
    """Return why a service did not start, in one line."""
    if code == _NO_FALSEWORK:
        return f"{' '.join(command)} has no falsework; {_REMEDY}"
    said = [line for line in lines if not line.startswith("falsework: warning: ")]
    mark = "falsework: "
    reason = next((line[len(mark) :] for line in reversed(said) if line.startswith(mark)), said[-1] if said else "")
    return f"the service did not start: {reason}" if reason else f"the service ended with exit code {code}; {_REMEDY}"


def _stop(process: subprocess.Popen[str], folder: Path) -> None:
    """End a service that was started here, and remove its folder."""
    with contextlib.suppress(OSError):
        assert process.stdin is not None
        process.stdin.close()
    try:
        process.wait(_STOP_SECONDS)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    shutil.rmtree(folder, ignore_errors=True)
