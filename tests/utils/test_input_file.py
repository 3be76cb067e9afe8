"""Input files: whole, also from pipes, with or without a byte order mark; what does not end is refused."""

from __future__ import annotations

import os
import threading
from pathlib import Path

import pytest

from falsework.errors import FalseworkError
from falsework.geometry.mesh.read import read_surfaces
from falsework.interop.compas_read import read_compas
from falsework.robots.cells.cell_file import load_cell
from falsework.search.plans.plan_file import load_plan
from falsework.utils.files.input_file import read_content, read_text

posix = pytest.mark.skipif(os.name != "posix", reason="links, pipes and devices of POSIX")


def test_text_has_no_mark_and_newlines_of_any_system(tmp_path: Path) -> None:
    file = tmp_path / "text"
    file.write_bytes("\ufeffä\r\nb\rc\n".encode())
    assert read_text(file) == "ä\nb\nc\n"


@posix
def test_a_pipe_is_read_to_its_end(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    writer = threading.Thread(target=pipe.write_bytes, args=(b"x" * 3_000_000,))
    writer.start()
    assert read_content(pipe) == b"x" * 3_000_000
    writer.join(10)


@posix
@pytest.mark.parametrize(
    ("read", "name"), [(load_plan, "a.json"), (read_surfaces, "a.obj"), (load_cell, "a.toml"), (read_compas, "a.json")]
)
def test_what_does_not_end_is_refused(read: object, name: str, tmp_path: Path) -> None:
    endless = tmp_path / name
    endless.symlink_to("/dev/zero")
    with pytest.raises(FalseworkError, match=r"no regular file, and has more than 256 MiB|there is no file"):
        read(endless)  # type: ignore[operator]


@pytest.mark.parametrize("where", ["plan.json", "cell.toml"])
def test_files_of_editors_that_write_a_mark_are_read(where: str, tmp_path: Path) -> None:
    file = tmp_path / where
    file.write_text("{}" if where == "plan.json" else "", encoding="utf-8-sig")
    with pytest.raises(FalseworkError) as refused:
        (load_plan if where == "plan.json" else load_cell)(file)
    assert "not valid" not in str(refused.value)
