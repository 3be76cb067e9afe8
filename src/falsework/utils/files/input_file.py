"""Input files: their whole content, of pipes as far as these end, and as text with or without a byte order mark."""

from __future__ import annotations

import errno
import io
import stat
from pathlib import Path

MOST_STREAMED = 1 << 28
"""Bytes that are read of what is no regular file, 256 MiB: pipes and devices such as `/dev/zero` need not end."""


def read_content(path: Path | str) -> bytes:
    """Return the bytes of a file.

    Raises:
        OSError: it cannot be read, or is a pipe or device that does not end within `MOST_STREAMED`.
    """
    with open(path, "rb") as file:
        if stat.S_ISREG(Path(path).stat().st_mode):
            return file.read()
        content = bytearray()
        while piece := file.read(1 << 20):
            content += piece
            if len(content) > MOST_STREAMED:
                raise OSError(errno.EFBIG, f"it is no regular file, and has more than {MOST_STREAMED >> 20} MiB")
        return bytes(content)


def read_text(path: Path | str, errors: str = "strict") -> str:
    """Return the text of a file in UTF-8, with newlines of any system, without the byte order mark of some editors.

    Raises:
        OSError: as `read_content`.
        UnicodeDecodeError: it is no such text.
    """
    return io.TextIOWrapper(io.BytesIO(read_content(path)), "utf-8-sig", errors).read()
