"""Functions in a process of their own: results, errors and warnings come back, and a crash is an error."""

from __future__ import annotations

import operator
import os
import sys
import time

import pytest

from falsework.utils.child_process import ChildDiedError, run_in_child
from falsework.utils.json_text import parse_json


def test_results_and_errors_come_back() -> None:
    assert run_in_child(operator.add, "a", "b") == "ab"
    with pytest.raises(ValueError, match="nested deeper"):
        run_in_child(parse_json, "[" * 100 + "]" * 100)


def test_a_crash_is_an_error() -> None:
    with pytest.raises(ChildDiedError, match="exit code 7"):
        run_in_child(os._exit, 7)
    with pytest.raises(ChildDiedError, match="SIGABRT" if os.name == "posix" else "exit code"):
        run_in_child(os.abort)


def test_time_is_limited() -> None:
    with pytest.raises(ChildDiedError, match="no answer within 1 s"):
        run_in_child(time.sleep, 60, seconds=1)


@pytest.mark.skipif(sys.platform != "linux", reason="Linux limits the memory of a process")
def test_memory_is_limited() -> None:
    with pytest.raises(MemoryError):
        run_in_child(bytearray, 1 << 32, memory=1 << 31)
    assert len(run_in_child(bytearray, 1 << 20, memory=1 << 31)) == 1 << 20


def test_warnings_come_back() -> None:
    from falsework.utils.cache.folder import CacheWarning, warn_of_no_cache

    with pytest.warns(CacheWarning, match="cannot be kept in here"):
        run_in_child(warn_of_no_cache, "here")
