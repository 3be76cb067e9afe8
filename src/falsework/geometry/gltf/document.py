"""glTF 2.0 file: its JSON, with types checked, and the numbers in its buffers."""

from __future__ import annotations

import base64
import binascii
import struct
from functools import cache
from pathlib import Path
from typing import Literal, NoReturn
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from falsework.errors import MeshError
from falsework.geometry.gltf.gltf_model import GltfFile
from falsework.utils.files.input_file import read_content
from falsework.utils.json_text import parse_json
from falsework.utils.models import read_model

_COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC3": 3}
_AGAIN = "it may be damaged; export it again"


class GltfDocument:
    """Contents of a glTF file, binary (.glb) or text (.gltf).

    Raises:
        MeshError: a file that is damaged, or of another version.
    """

    def __init__(self, file: Path, content: bytes) -> None:
        self.file = file
        self._chunk = b""
        if content[:4] == b"glTF":
            content = self._chunks(content)
        try:
            data = parse_json(content.decode("utf-8-sig"))
        except UnicodeDecodeError:
            self.fail("it is neither a binary glTF file nor text in UTF-8", "export it as .glb or .gltf")
        except ValueError as error:
            self.fail(str(error), "export it again")
        self.json = read_model(GltfFile, data, f"cannot read {file}: ", MeshError, remedy=f"; {_AGAIN}")
        if dangling := self.json.dangling():
            self.fail(dangling, _AGAIN)
        self.buffer = cache(self._buffer)
        """Return the bytes of a buffer by its number."""

    def numbers(self, index: int, kind: Literal["SCALAR", "VEC3"]) -> NDArray[np.float64]:
        """Return the values of an accessor, shape (count, width)."""
        where, accessor = f"accessors[{index}]", self.json.accessors[index]
        if accessor.sparse is not None or accessor.buffer_view is None:
            self.fail("it has sparse accessors", "export it again without them")
        if accessor.type != kind:
            self.fail(f"{where}.type is {accessor.type[:40]!r} where {kind} is needed", _AGAIN)
        view, dtype = self.json.buffer_views[accessor.buffer_view], np.dtype(_COMPONENTS[accessor.component_type])
        if kind == "SCALAR" and dtype.kind != "u":
            self.fail(f"{where}.componentType of corners is {accessor.component_type}, of no natural numbers", _AGAIN)
        width, count = _WIDTHS[kind], accessor.count
        stride = view.byte_stride or width * dtype.itemsize
        start, buffer = view.byte_offset + accessor.byte_offset, self.buffer(view.buffer)
        size = (count - 1) * stride + width * dtype.itemsize if count else 0
        if accessor.byte_offset + size > view.byte_length or start + size > len(buffer):
            self.fail(f"the {count} values of {where} go beyond the end of their view or of the buffer", _AGAIN)
        values = np.ndarray((count, width), dtype, buffer, start, (stride, dtype.itemsize)).astype(np.float64)
        if accessor.normalized and dtype.kind != "f":
            values = np.maximum(values / np.iinfo(dtype).max, -1.0)
        return values

    def size_beside(self) -> int:
        """Return the bytes of the files beside it that it consists of."""
        beside = {self._beside(buffer.uri) for buffer in self.json.buffers if buffer.uri}
        return sum(file.stat().st_size for file in beside if file is not None)

    def fail(self, what: str, remedy: str) -> NoReturn:
        """Refuse the file."""
        raise MeshError(f"cannot read {self.file}: {what}; {remedy}")

    def _chunks(self, content: bytes) -> bytes:
        """Return the JSON of a binary file, and keep its buffer."""
        if len(content) < 12:
            self.fail("it ends within its header", _AGAIN)
        version, _ = struct.unpack_from("<II", content, 4)
        if version != 2:
            self.fail(f"its version of glTF is {version}, not 2", "export it as glTF 2.0")
        at, text = 12, b""
        while at + 8 <= len(content):
            size, kind = struct.unpack_from("<I4s", content, at)
            chunk = content[at + 8 : at + 8 + size]
            if len(chunk) < size:
                self.fail(f"it ends {size - len(chunk)} bytes too soon", _AGAIN)
            if kind == b"JSON" and not text:
                text = chunk
            elif kind == b"BIN\0" and not self._chunk:
                self._chunk = chunk
            at += 8 + size
        if not text:
            self.fail("it has no JSON", _AGAIN)
        return text

    def _buffer(self, index: int) -> bytes:
        """Return a buffer: that in the file, in its text, or in a file beside it."""
        uri = self.json.buffers[index].uri
        if uri is None:
            return self._chunk
        if uri.startswith("data:"):
            try:
                return base64.b64decode(uri.partition(",")[2], validate=True)
            except (binascii.Error, ValueError):
                self.fail(f"the data in buffers[{index}].uri are not in base64", _AGAIN)
        beside = self._beside(uri)
        if beside is None:
            self.fail(f"its data are in {uri[:80]!r}, which is no file beside it", "export it as .glb")
        return read_content(beside)

    def _beside(self, uri: str) -> Path | None:
        """Return the file beside this one that a buffer names; None if it is no such file."""
        name = unquote(uri).removeprefix("./")
        beside = self.file.parent / Path(name).name
        return beside if self.file.suffix.lower() == ".gltf" and beside.name == name and beside.is_file() else None
