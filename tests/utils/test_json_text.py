"""Untrusted JSON: what Python would accept in silence is refused."""

from __future__ import annotations

import pytest

from falsework.utils.json_text import LEVELS, parse_json


def test_plain_values() -> None:
    assert parse_json('{"a": [1, {"a": 2.5}], "b": null}') == {"a": [1, {"a": 2.5}], "b": None}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"a": 1, "a": 1}', "has the entry 'a' twice"),
        ('[{"b": {"long": 1, "x": 2, "long": 3}}]', "has the entry 'long' twice"),
        ("[" * (LEVELS + 3) + "]" * (LEVELS + 3), f"deeper than {LEVELS} levels"),
        ("[" * 100_000, "deeper than"),
        ("[99999999999999999999999]", "does not fit into 64 bits"),
        ("{", "it is not valid JSON at line 1, column 2; it may be truncated"),
    ],
)
def test_what_is_refused(text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        parse_json(text)
