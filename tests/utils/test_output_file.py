"""Output files: whole or not at all, at the end of links, into pipes, and never in place of a device."""

from __future__ import annotations

import errno
import os
import re
import socket
import stat
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import IO, NoReturn

import pytest

from falsework.errors import InputError
from falsework.utils.files import output_file
from falsework.utils.files.output_file import check_folder, check_writable, path_beside, write_whole

posix = pytest.mark.skipif(os.name != "posix", reason="links, pipes and devices of POSIX")


def hello(file: IO[bytes]) -> None:
    file.write(b"hello")


def broken(error: BaseException, file: IO[bytes]) -> NoReturn:
    file.write(b"he")
    raise error


@posix
def test_links_are_followed_and_stay(tmp_path: Path) -> None:
    target = tmp_path / "deep" / "target"
    target.parent.mkdir()
    link, chain = tmp_path / "link", tmp_path / "chain"
    link.symlink_to("deep/target")
    chain.symlink_to(link)
    for written in (b"none before", b"once more"):  # at first the link leads nowhere
        write_whole(chain, lambda file, written=written: file.write(written))
        assert target.read_bytes() == written
    assert link.is_symlink()
    assert chain.is_symlink()
    assert sorted(path.name for path in target.parent.iterdir()) == ["target"]


@posix
def test_links_that_lead_to_each_other(tmp_path: Path) -> None:
    one, two = tmp_path / "one", tmp_path / "two"
    one.symlink_to(two)
    two.symlink_to(one)
    for call in (check_writable, lambda path: write_whole(path, hello)):
        with pytest.raises(InputError, match="links lead to each other"):
            call(one)
    assert one.is_symlink()


@posix
def test_a_pipe_gets_the_content_and_stays(tmp_path: Path) -> None:
    pipe, got = tmp_path / "pipe", []
    os.mkfifo(pipe)
    reader = threading.Thread(target=lambda: got.append(pipe.read_bytes()))
    reader.start()
    check_writable(pipe)
    write_whole(pipe, lambda file: (file.write(b"hello"), file.seek(0), file.write(b"J")))  # as archives do
    reader.join(10)
    assert got == [b"Jello"]
    assert stat.S_ISFIFO(pipe.stat().st_mode)
    assert [path.name for path in tmp_path.iterdir()] == ["pipe"]


@posix
@pytest.mark.parametrize("name", ["/dev/stdout", "/dev/fd/1", "link"])
def test_standard_output_is_streamed_to(tmp_path: Path, name: str) -> None:
    (tmp_path / "link").symlink_to("/dev/stdout")
    code = (
        "from falsework.utils.files.output_file import *; import sys;"
        f"check_writable(Path({name!r}));"
        f"write_whole({name!r}, lambda file: file.write(b'hello')); print(' still open')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, cwd=tmp_path, check=True)
    assert done.stdout.split() == [b"hello", b"still", b"open"]
    if name == "link":  # leads to the file itself
        return
    with (tmp_path / "redirected").open("wb") as out:
        subprocess.run([sys.executable, "-c", code], stdout=out, check=True)
    assert (tmp_path / "redirected").read_bytes().split() == [b"hello", b"still", b"open"]


@posix
@pytest.mark.parametrize("kind", [stat.S_IFCHR, stat.S_IFBLK])
def test_devices_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: int) -> None:
    """No device is touched here: a file that says it is one."""
    device = tmp_path / "device"
    device.write_text("kept")
    real = Path.stat

    def stat_of(path: Path, **options: bool) -> os.stat_result:
        found = real(path, **options)
        return os.stat_result((kind | 0o666, *found[1:])) if path.name == "device" else found

    monkeypatch.setattr(Path, "stat", stat_of)
    link = tmp_path / "link"
    link.symlink_to(device)
    for path in (device, link):
        for call in (check_writable, lambda path: write_whole(path, hello)):
            with pytest.raises(InputError, match=r"is a device or socket.*name a file"):
                call(path)
    assert device.read_text() == "kept"


@posix
def test_sockets_and_folders_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # names of sockets are short
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind("socket")
        with pytest.raises(InputError, match="device or socket"):
            write_whole("socket", hello)
    (tmp_path / "folder").mkdir()
    with pytest.raises(InputError, match="is a folder; name a file in it"):
        write_whole("folder", hello)


def test_a_full_disk_is_named_with_the_file(tmp_path: Path) -> None:
    path = tmp_path / "plan.json"
    path.write_text("old")
    full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    with pytest.raises(InputError, match=re.escape(f"cannot write {path}: the disk is full; choose another place")):
        write_whole(path, lambda file: broken(full, file))
    assert path.read_text() == "old"
    assert [left.name for left in tmp_path.iterdir()] == ["plan.json"]


@pytest.mark.parametrize("error", [KeyboardInterrupt(), ValueError("defect"), MemoryError()])
def test_interruptions_leave_the_old_file(tmp_path: Path, error: BaseException) -> None:
    path = tmp_path / "plan.json"
    path.write_text("old")
    with pytest.raises(type(error)):
        write_whole(path, lambda file: broken(error, file))
    assert path.read_text() == "old"
    assert [left.name for left in tmp_path.iterdir()] == ["plan.json"]


@pytest.mark.parametrize("place", ["/proc", "/sys"])
def test_what_a_file_system_refuses_is_known_before_the_work(place: str) -> None:
    """Where permissions, of root above all, say nothing."""
    if not Path(place).is_dir():
        pytest.skip(f"no {place} here")
    path = Path(place) / "falsework.json"
    with pytest.raises(InputError, match=re.escape(f"cannot write {path}: ")):
        check_writable(path)
    for folder in (path, path / "deeper"):
        with pytest.raises(InputError, match=re.escape(f"cannot write into {folder}: ")):
            check_folder(folder)


def test_a_check_leaves_nothing_and_makes_no_folder(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("old")
    check_writable(tmp_path / "plan.json")
    check_writable(tmp_path / "file")
    check_folder(tmp_path / "deep" / "deeper")
    check_folder(tmp_path)
    for place in (tmp_path / "file", tmp_path / "file" / "deep"):
        with pytest.raises(InputError, match=f"cannot write into {re.escape(str(place))}: "):
            check_folder(place)
    assert [left.name for left in tmp_path.iterdir()] == ["file"]
    assert (tmp_path / "file").read_text() == "old"


def test_drafts_of_killed_processes_are_removed_by_the_next_write(tmp_path: Path) -> None:
    old, young, other = (tmp_path / name for name in (".a.json.0123abcd", ".a.json.89abcdef", ".b.json.0123abcd"))
    for draft in (old, young, other):
        draft.write_text("half")
    past = time.time() - 2 * output_file.ABANDONED
    for draft in (old, other):
        os.utime(draft, (past, past))
    write_whole(tmp_path / "a.json", hello)
    assert not old.exists()
    assert young.exists()  # another process may be writing it
    assert other.exists()


@posix
def test_permissions_stay(tmp_path: Path) -> None:
    path = tmp_path / "plan.json"
    path.write_text("old")
    path.chmod(0o600)
    write_whole(path, hello)
    assert stat.S_IMODE(path.stat().st_mode) == 0o600


def test_paths_in_files(tmp_path: Path) -> None:
    structure = tmp_path / "parts"
    structure.mkdir()
    assert path_beside(structure, tmp_path / "plans" / "plan.json") == "../parts"
    if os.name == "posix":
        assert path_beside(structure, Path("/dev/stdout")) == structure.resolve().as_posix()
