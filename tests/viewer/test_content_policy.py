"""Content security policy: it names the scripts of the client, packed ones too, and comes with every answer."""

from __future__ import annotations

import base64
import hashlib
from http.client import HTTPConnection

import pytest

pytest.importorskip("viser", reason="the page needs viser; pip install 'falsework[viewer]'")

import zstandard

from falsework.errors import DependencyError
from falsework.viewer import Timeline
from falsework.viewer.page.page import Page
from falsework.viewer.page.viewer_state import ViewerState
from falsework.viewer.web import content_policy as policies

LOADER = "unpack(document.currentScript)"


def source(script: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()}'"


def pack(content: bytes) -> str:
    """Write bytes as digits, as the build of viser's client does."""
    alphabet, text = policies.ALPHABET, ""
    for begin in range(0, len(content), 4):
        group = content[begin : begin + 4]
        value, digits = int.from_bytes(group, "big"), ""
        for _ in range(len(group) + 1):
            value, digit = divmod(value, 88)
            digits = alphabet[digit] + digits
        text += digits
    return text


@pytest.mark.parametrize("code", ["run()", "run() // ü", "run(12)", "run(123)"])
def test_packed_scripts_are_named(code: str) -> None:
    style = "p { color: red }"
    packed = pack(zstandard.compress((style + code).encode()))
    sizes = f'data-ss="{len(style)}" data-cs="{len(code.encode())}"'
    policy = policies.policy_of(f'<head><script data-p="{packed}" {sizes}>{LOADER}</script></head>')
    scripts = policy.partition(";")[0].split()
    assert scripts == ["script-src", "'wasm-unsafe-eval'", source(LOADER), source(code)]
    assert "unsafe-inline" not in scripts
    assert "default-src 'none'" in policy


@pytest.mark.parametrize(
    "page",
    [
        "<p>no script</p>",
        f'<script data-p="ab>>" data-ss="1" data-cs="2">{LOADER}</script>',
        f'<script data-p="{pack(b"no frame")}" data-ss="1" data-cs="2">{LOADER}</script>',
        f'<script data-p="{pack(zstandard.compress(b"abc"))}" data-ss="1" data-cs="9">{LOADER}</script>',
    ],
)
def test_other_clients_are_refused(page: str) -> None:
    with pytest.raises(ValueError, match=r"no script|not packed"):
        policies.policy_of(page)


def test_a_client_that_is_not_known_is_not_served(monkeypatch: pytest.MonkeyPatch) -> None:
    import viser

    monkeypatch.setattr(policies, "policy_of", lambda _: policies.unpack("", 1))
    with pytest.raises(DependencyError, match="cannot be guarded"):
        policies.content_policy(viser)


def test_every_answer_has_the_policy(timeline: Timeline) -> None:
    page = Page(ViewerState(timeline), port=8260)
    try:
        for path, status in (("/", 200), ("/nothing", 404)):
            connection = HTTPConnection("127.0.0.1", page.port, timeout=10)
            connection.request("GET", path)
            answer = connection.getresponse()
            assert answer.status == status
            policy = answer.headers["Content-Security-Policy"]
            assert policy.startswith("script-src 'wasm-unsafe-eval' 'sha256-")
            assert answer.headers["X-Content-Type-Options"] == "nosniff"
            answer.read()  # all of it: a server waits for readers before it ends
            connection.close()
    finally:
        page.close()
