"""Requests on the page about the service are answered."""

from __future__ import annotations

import json
import re
import shlex
import time
from pathlib import Path
from typing import Any

import jsonschema
import pytest

PAGE = Path(__file__).resolve().parents[2] / "docs" / "service.md"
COMMANDS = [
    shlex.split(line[2:], comments=True)
    for block in re.findall(r"^```console\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
    for line in block.splitlines()
    if line.startswith("$ curl http://127.0.0.1:8080")
]


def test_the_page_has_commands() -> None:
    assert {words[1].rpartition("/")[2] for words in COMMANDS} == {"structure", "replan", "stability", "picture"}


@pytest.mark.parametrize("words", COMMANDS, ids=lambda words: " ".join(words[1:])[-60:])
def test_commands_of_the_page_are_answered(words: list[str], live: Any) -> None:
    path = "/" + words[1].rpartition("/")[2]
    if "-d" in words:
        assert words[words.index("-H") + 1] == "Content-Type: application/json"
        reply = live.post(path, json.loads(words[words.index("-d") + 1]))
    else:
        reply = live.client.get(path)
    assert reply.status_code == 200, reply.text
    document = live.client.get("/openapi.json").json()
    method = document["paths"][path]["post" if "-d" in words else "get"]
    (media,) = method["responses"]["200"]["content"]
    assert reply.headers["content-type"] == media
    if media == "image/png":
        assert reply.content.startswith(b"\x89PNG")
        return
    schema = method["responses"]["200"]["content"][media]["schema"]
    jsonschema.validate(reply.json(), {**schema, "components": document["components"]})
    # A busy machine may not find a plan in a deadline of milliseconds; it does when it is asked again.
    end = time.monotonic() + 120
    while reply.json().get("outcome") == "not_yet" and time.monotonic() < end:
        reply = live.post(path, json.loads(words[words.index("-d") + 1]))
    assert reply.json().get("outcome", "found") == "found"
