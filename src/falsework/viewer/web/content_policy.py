"""Content security policy of the page: browsers run the scripts of viser's client and no others.

viser serves its client as one HTML file. A script in it unpacks the rest (base 88, then Zstandard) and inserts the
style sheet and the program as elements. The policy names both scripts by their digests, so script that gets into the
page in another way, such as in the name of a part, does not run.
"""

from __future__ import annotations

import base64
import hashlib
import re
from pathlib import Path
from typing import Any

import numpy as np

from falsework.errors import DependencyError

_SCRIPT = re.compile(r"<script([^>]*)>(.*?)</script>", re.DOTALL)
_PACKED = re.compile(r'data-p="([^"]*)" data-ss="(\d+)" data-cs="(\d+)"')
"""Attributes of the script that unpacks: the packed text, and the sizes of style sheet and program in it, bytes."""
ALPHABET = (
    "!#$%()*+,-./0123456789:;=?@ABCDEFGHIJKLMNOPQRSTUVWXYZ[\\]^_abcdefghijklmnopqrstuvwxyz{|}~"  # digits of base 88
)
_GROUP = 5
"""Digits that hold four bytes."""
_REST = (
    "default-src 'none'; style-src 'unsafe-inline'; img-src data: blob:; font-src data:; "
    "connect-src 'self' data: blob:; worker-src blob: data:; base-uri 'none'; form-action 'none'; object-src 'none'"
)


def content_policy(viser: Any) -> str:
    """Return the value of the header `Content-Security-Policy` for the client of viser."""
    client = Path(viser.__file__).parent / "client" / "build" / "index.html"
    try:
        return policy_of(client.read_text(encoding="utf-8"))
    except (OSError, ValueError, IndexError) as error:
        raise DependencyError("this version of viser cannot be guarded; pip install 'falsework[viewer]'") from error


def policy_of(page: str) -> str:
    """Return the policy for a page."""
    sources = ["'wasm-unsafe-eval'"]
    for attributes, script in _SCRIPT.findall(page):
        sources.append(_source(script.encode()))
        packed = _PACKED.search(attributes)
        if packed is None and "data-p" in attributes:
            raise ValueError("the page is not packed as expected")
        if packed is not None:
            styles, code = int(packed[2]), int(packed[3])
            sources.append(_source(unpack(packed[1], styles + code)[styles:]))
    if len(sources) == 1:
        raise ValueError("there is no script in the page")
    return f"script-src {' '.join(sources)}; {_REST}"


def unpack(text: str, size: int) -> bytes:
    """Return what the client unpacks from a text.

    Args:
        text: digits of base 88, five for four bytes, of a Zstandard frame.
    """
    import zstandard

    value_of = np.full(128, -1)
    value_of[np.frombuffer(ALPHABET.encode(), np.uint8)] = np.arange(len(ALPHABET))
    digits = value_of[np.frombuffer(text.encode("ascii"), np.uint8)]
    whole = len(digits) // _GROUP * _GROUP
    groups = digits[:whole].reshape(-1, _GROUP) @ (len(ALPHABET) ** np.arange(_GROUP)[::-1])
    last = 0
    for digit in digits[whole:].tolist():
        last = last * len(ALPHABET) + digit
    ending = b"" if whole == len(digits) else last.to_bytes(len(digits) - whole - 1, "big")
    try:
        content = zstandard.ZstdDecompressor().decompress(groups.astype(">u4").tobytes() + ending, max_output_size=size)
    except zstandard.ZstdError as error:
        raise ValueError(f"the page is not packed as expected: {error}") from error
    if len(content) != size or digits.min(initial=0) < 0:
        raise ValueError("the page is not packed as expected")
    return content


def _source(script: bytes) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(script).digest()).decode()}'"
