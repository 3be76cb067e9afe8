"""Archives and JSON: names and sizes are checked before anything is read, and no entry occurs twice."""

from __future__ import annotations

import io
import json
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from falsework.errors import InputError, PlanError
from falsework.utils.archive import check_header, read_archive, read_array, write_archive
from falsework.utils.json_file import read_format, read_json
from falsework.utils.json_text import parse_json

Peak = Callable[[Callable[[], Any]], int]

FORM = "some/1"


def numbers(array: Any) -> bytes:
    out = io.BytesIO()
    np.lib.format.write_array(out, np.asarray(array), allow_pickle=False)
    return out.getvalue()


def write(path: Path, entries: dict[str, bytes], header: str = json.dumps({"format": FORM})) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as out:
        out.writestr("header.npy", numbers(np.array(header)))
        for name, content in entries.items():
            out.writestr(name, content)


@pytest.mark.parametrize(
    "values",
    [np.arange(6).reshape(2, 3), np.asfortranarray(np.arange(6.0).reshape(2, 3)), np.zeros((0, 4)), np.array(3)],
)
def test_arrays_come_back(tmp_path: Path, values: Any) -> None:
    write_archive(tmp_path / "some.npz", FORM, {"a": 1}, {"values": values})
    header, arrays = read_archive(tmp_path / "some.npz", FORM, frozenset({"values"}))
    assert header == {"format": FORM, "a": 1}
    assert arrays["values"].dtype == values.dtype
    assert np.array_equal(arrays["values"], values)
    arrays["values"][...] = 0  # it belongs to the caller
    np.save(tmp_path / "some.npy", values)
    assert np.array_equal(read_array(tmp_path / "some.npy"), values)


def test_an_array_that_nobody_asked_for_is_not_read(tmp_path: Path, peak: Peak) -> None:
    path = tmp_path / "some.npz"
    write(path, {"values.npy": numbers([1.0]), "more.npy": numbers(np.zeros(20_000_000, np.uint8))})

    def read() -> None:
        with pytest.raises(
            InputError, match=r"some\.npz is not a valid some/1 file: unexpected or absent entries more"
        ):
            read_archive(path, FORM, frozenset({"values"}))

    assert peak(read) < 2_000_000


def test_arrays_far_larger_than_the_file_are_not_read(tmp_path: Path, peak: Peak) -> None:
    path = tmp_path / "some.npz"
    write(path, {"values.npy": numbers(np.zeros(20_000_000, np.uint8))})
    assert len(read_archive(path, FORM)[1]["values"]) == 20_000_000

    def read() -> None:
        with pytest.raises(InputError, match=r"claims arrays of 200\d{5}, more than the \d+ that are read") as caught:
            read_archive(path, FORM, room=1_000_000)
        assert "\n" not in str(caught.value)

    assert peak(read) < 2_000_000


@pytest.mark.parametrize(
    ("entries", "what"),
    [
        ({"values": b"raw"}, "its entry 'values' is no array"),
        ({"values.npy": b"raw"}, "its array 'values.npy' is damaged"),
        ({"values.npy": numbers([1.0, 2.0])[:-1]}, "its array 'values.npy' is damaged"),
        ({"values.npy": numbers([1.0, 2.0]) + b"0"}, "its array 'values.npy' is damaged"),
        ({"values.npy": numbers([1.0, 2.0]).replace(b"(2,)", b"(3,)")}, "its array 'values.npy' is damaged"),
        ({"values.npy": numbers([1.0, 2.0]).replace(b"<f8", b"|O8")}, "its array 'values.npy' is damaged"),
        ({"header.npy": numbers(np.array(json.dumps({"format": FORM})))}, "an entry occurs twice"),
    ],
    ids=["raw", "raw named array", "short", "long", "larger", "objects", "header twice"],
)
def test_entries_that_are_no_arrays(tmp_path: Path, entries: dict[str, bytes], what: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of a name that is there twice
        write(tmp_path / "some.npz", entries)
    with pytest.raises(InputError, match=rf"some\.npz is damaged or not a some/1 file: {what}; write it again"):
        read_archive(tmp_path / "some.npz", FORM)


def test_what_is_no_archive_or_has_no_header(tmp_path: Path) -> None:
    (tmp_path / "some.npz").write_bytes(b"PK")
    with pytest.raises(InputError, match=r"not a some/1 file: it is no whole \.npz; write it again"):
        read_archive(tmp_path / "some.npz", FORM)
    write(tmp_path / "some.npz", {}, header="{")
    with pytest.raises(InputError, match="its header cannot be read: it is not valid JSON at line 1, column 2"):
        read_archive(tmp_path / "some.npz", FORM)
    with zipfile.ZipFile(tmp_path / "some.npz", "w") as out:
        out.writestr("values.npy", numbers([1.0]))
    with pytest.raises(InputError, match="not a some/1 file: it has no header; write it again"):
        read_archive(tmp_path / "some.npz", FORM)


@pytest.mark.parametrize("claimed", [(1 << 31, 7), (10**12,), (3,)])
def test_an_array_has_the_size_that_it_claims(tmp_path: Path, peak: Peak, claimed: tuple[int, ...]) -> None:
    out = io.BytesIO()
    np.lib.format.write_array_header_1_0(out, {"descr": "|i1", "fortran_order": False, "shape": claimed})
    (tmp_path / "states.npy").write_bytes(out.getvalue() + b"\0" * 7)

    def read() -> None:
        with pytest.raises(ValueError, match="claims the shape"):
            read_array(tmp_path / "states.npy")

    assert peak(read) < 1_000_000


@pytest.mark.parametrize(
    ("header", "message"),
    [
        ({"robots": 2}, "unexpected or absent header entries fixed"),
        ({"robots": 2, "fixed": [], "more": 1}, "unexpected or absent header entries more"),
        ({"robots": "two", "fixed": []}, "its header entry robots is 'two'"),
        ({"robots": True, "fixed": []}, "its header entry robots is 'True'"),
        ({"robots": 2, "fixed": [1.5]}, r"its header entry fixed is '\[1.5\]'"),
        ({"robots": 2, "fixed": None}, "its header entry fixed is 'None'"),
    ],
)
def test_headers_have_the_entries_of_their_kind(header: dict[str, Any], message: str) -> None:
    kinds = {"robots": int, "fixed": list}
    check_header("some.npz", {"format": FORM, "robots": 2, "fixed": [1, 2]}, kinds, "make it anew")
    with pytest.raises(InputError, match=rf"some\.npz is damaged: {message}; make it anew"):
        check_header("some.npz", {"format": FORM, **header}, kinds, "make it anew")


@pytest.mark.parametrize(
    "text", ['{"a": 1, "a": 1}', '[{"b": {"c": 2, "d": 1, "c": 3}}]', '{"a\\nb": 1, "a\\u000ab": 2}']
)
def test_an_object_may_not_have_an_entry_twice(tmp_path: Path, text: str) -> None:
    path = tmp_path / "some.json"
    path.write_text(text)
    with pytest.raises(ValueError, match=r"an object in it has the entry '.+' twice"):
        parse_json(text)
    for read in (read_json, read_format):
        with pytest.raises(PlanError, match="twice") as caught:
            read(path)
        assert "\n" not in str(caught.value)
    assert parse_json('[{"a": 1}, {"a": 2}]') == [{"a": 1}, {"a": 2}]
