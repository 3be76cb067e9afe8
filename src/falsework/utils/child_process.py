"""Functions that run in a process of their own, since the library below them may end the process that calls it."""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import falsework
from falsework.errors import InputError

Result = TypeVar("Result")
_MAIN = f"from {__name__} import answer; answer()"
_ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
"""Environment without threads for linear algebra, whose stacks would count as memory on a machine of many cores."""
_MEMORY, _MEMORY_PER_BYTE = 4 << 30, 2000
"""Address space of the process: for the libraries, and for each byte of the file."""
_SECONDS, _SECONDS_PER_BYTE = 20.0, 20e-6
"""Time of the process: for its start, and for each byte of the file."""


class ChildDiedError(Exception):
    """End of the other process without an answer; the text says how."""


def child_environment() -> dict[str, str]:
    """Return the environment in which another interpreter imports this package from the same place."""
    paths = [str(Path(falsework.__file__).parents[1]), os.environ.get("PYTHONPATH", "")]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, paths))}


def run_in_child(
    function: Callable[..., Result], *arguments: object, memory: int | None = None, seconds: float | None = None
) -> Result:
    """Call a function in a new interpreter and return its result.

    Unlike the processes of `multiprocessing` it does not run the main module of the program again, which a library must
    not ask for. Exceptions and warnings of the function are raised and issued here; what it prints is dropped.

    Args:
        function: function of a module; arguments and result can be pickled.
        memory: address space of the process, bytes, where the system can limit it.

    Raises:
        ChildDiedError: the process ended without an answer, or was ended.
    """
    try:
        done = subprocess.run(
            [sys.executable, "-P", "-c", _MAIN],
            input=pickle.dumps((function, arguments, memory)),
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=child_environment() | _ONE_THREAD,
            timeout=seconds,
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise ChildDiedError(f"no answer within {seconds:.0f} s") from None
    if not done.stdout:
        raise ChildDiedError(_how(done.returncode))
    result, error, said = pickle.loads(done.stdout)
    for category, text in said:
        warnings.warn(text, category, stacklevel=2)
    if error is not None:
        raise error
    return result


def read_apart(read: Callable[..., Result], path: Path, *arguments: object, library: str) -> Result:
    """Read a file in a process of its own.

    Raises:
        InputError: no such file, or the process ended, took too long or too much memory; or as `read`.
    """
    if not path.is_file():
        raise InputError(f"there is no file {path}; name another")
    size = path.stat().st_size
    memory, seconds = _MEMORY + _MEMORY_PER_BYTE * size, _SECONDS + _SECONDS_PER_BYTE * size
    try:
        return run_in_child(read, path, *arguments, memory=memory, seconds=seconds)
    except ChildDiedError as error:
        how = f"stopped ({error})"
    except MemoryError:
        how = "takes more memory than a file of its size may"
    raise InputError(f"{path} cannot be read: {library} {how}; the file is damaged, export it again")


def answer() -> None:
    """Carry out the request at the standard input; the main program of the other process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # an interrupt is for the process that waits, which ends this one
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # whatever libraries print, compiled ones too, stays out of the answer
    function, arguments, memory = pickle.load(sys.stdin.buffer)
    if memory is not None and sys.platform == "linux":
        import resource

        most = resource.getrlimit(resource.RLIMIT_AS)[1]
        resource.setrlimit(resource.RLIMIT_AS, (memory if most < 0 else min(memory, most), most))
    result, error = None, None
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            result = function(*arguments)
        except Exception as failure:
            error = failure
    said = [(entry.category, str(entry.message)) for entry in caught if issubclass(entry.category, UserWarning)]
    content = pickle.dumps((result, error, said))
    out.write(content)
    out.flush()


def _how(code: int) -> str:
    if code >= 0:
        return f"exit code {code}"
    try:
        return signal.Signals(-code).name
    except ValueError:
        return f"signal {-code}"
