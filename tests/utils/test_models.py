"""Models of files: every wrong value gets one line with its path, the value, and what is expected."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

import jsonschema
import pytest
from msgspec import Meta

from falsework.errors import InputError
from falsework.utils.models import FileModel, ForeignModel, model_schema, plain, read_model


class Wheel(FileModel, frozen=True):
    """Wheel of a cart."""

    radius: Annotated[float, Meta(gt=0)]
    """Radius, m. Without the tyre."""
    kind: Literal["spoked", "solid"] = "solid"


class Spare(ForeignModel, frozen=True, rename="camel"):
    """Spare parts."""

    spare_wheel: Wheel | None = None
    """Its wheel."""
    sizes: dict[str, list[float]] | None = None
    owners: list[int | str] | None = None


class Store(ForeignModel, frozen=True):
    """Store of another program."""

    spares: dict[str, Spare]
    """By their names."""


class Cart(FileModel, frozen=True):
    """Cart."""

    wheels: list[Wheel]
    """Its wheels."""
    place: tuple[float, float] | None = None
    count: Annotated[int, Meta(ge=1)] = 1
    """Number of carts."""
    loaded: bool = False


GOOD: dict[str, Any] = {"wheels": [{"radius": 0.5}, {"radius": 1, "kind": "spoked"}], "place": [0.0, 1.0]}


def read(data: Any) -> Cart:
    return read_model(Cart, data, "cart.json: ", InputError, remedy="; write it again")


def test_what_is_right_is_read() -> None:
    cart = read(GOOD)
    assert [wheel.radius for wheel in cart.wheels] == [0.5, 1.0]
    assert (cart.place, cart.count, cart.loaded) == ((0.0, 1.0), 1, False)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"wheels": None}, "wheels is None; give a list (its wheels)"),
        ({"wheels": [{"radius": "x"}]}, "wheels[0].radius is 'x'; give a number (radius, m)"),
        ({"wheels": [{"radius": 1.0}, {"radius": 0}]}, "wheels[1].radius is 0; give a number > 0 (radius, m)"),
        ({"wheels": [{"radius": True}]}, "wheels[0].radius is True; give a number (radius, m)"),
        ({"wheels": [{"radius": math.nan}]}, "wheels[0].radius is nan; give a number > 0 (radius, m)"),
        ({"place": [0.0, math.inf]}, "place[1] is not finite; give a number"),
        ({"place": [1.0]}, "place is [1.0]; give a list of length 2"),
        ({"wheels": [{}]}, "wheels[0].radius is missing; write it again"),
        ({"wheels": [{"radius": 1, "knid": "solid"}]}, "wheels[0].knid is not known; did you mean kind?; write it"),
        ({"x": 1}, "x is not known; known are count, loaded, place, wheels; write it again"),
        ({"wheels": [{"radius": 1, "kind": "\x1b[2K"}]}, r"wheels[0].kind is '\x1b[2K'; give one of solid, spoked"),
        ({"count": 2.5}, "count is 2.5; give a whole number (number of carts)"),
        ({"wheels": [{"radius": 10**400}]}, "wheels[0].radius is 1000000000"),
        ({"count": "7" * 500}, f"count is '{'7' * 56}...; give a whole number (number of carts)"),
        ({"wheels": [{"radius": 1, "kind": "\ud800"}]}, "a text in it holds half a character; write it as UTF-8"),
        ({"loaded": 1}, "loaded is 1; give true or false"),
    ],
)
def test_what_is_wrong_is_named(change: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError) as caught:
        read(GOOD | change)
    assert str(caught.value).startswith(f"cart.json: {message}")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("spares", "message"),
    [
        ({"a": {}, "left side": 3}, "spares.left side is 3; give an object"),
        ({"a": {"sizes": {"x": [1], "y": [2, True], "z": [""]}}}, "spares.a.sizes.y[1] is True; give a number"),
        ({"a": {"spareWheel": 1}}, "spares.a.spareWheel is 1; give an object (its wheel)"),
        ({"a": {"spareWheel": {}}}, "spares.a.spareWheel.radius is missing; write it again"),
        ({"a": {"owners": [1, "b", True]}}, "spares.a.owners[2] is True; give a whole number or a text"),
        ({"a": {}, "b": {"sizes": {"x": [math.inf]}}}, "spares.b.sizes.x[0] is not finite; give a number"),
        ({"k" * 99: 1}, f"spares.{'k' * 56}.. is 1; give an object"),
    ],
)
def test_what_is_wrong_below_keys_of_a_file_is_named(spares: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError) as caught:
        read_model(Store, {"spares": spares}, "a.json: ", InputError, remedy="; write it again")
    assert str(caught.value).startswith(f"a.json: {message}")


def test_further_keys_of_other_programs_may_be_anything() -> None:
    data = {"spares": {"a": {"sizes": {"x": [1, 2.5]}, "more": math.nan, "else": {"deep": [None]}}}, "more": 1}
    assert read_model(Store, data, "a.json: ", InputError) == Store({"a": Spare(sizes={"x": [1.0, 2.5]})})


@pytest.mark.parametrize(("data", "found"), [([], "[]"), (3, "3"), (None, "None"), ("cart", "'cart'")])
def test_what_is_no_object(data: Any, found: str) -> None:
    with pytest.raises(InputError, match="the content is") as caught:
        read(data)
    assert str(caught.value) == f"cart.json: the content is {found}; give an object"


def test_the_schema_says_the_same() -> None:
    schema = model_schema(Cart, "cart-1", "cart", "A cart.")
    jsonschema.Draft202012Validator.check_schema(schema)
    jsonschema.validate(GOOD, schema)
    assert schema["properties"]["count"]["description"] == "Number of carts."
    assert schema["$defs"]["Wheel"]["properties"]["radius"]["description"] == "Radius, m. Without the tyre."
    for change in ({"wheels": [{}]}, {"x": 1}, {"count": 0}, {"loaded": 1}):
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate(GOOD | change, schema)


def test_values_of_callers_become_those_of_files() -> None:
    import numpy as np

    assert plain({"a": (np.int64(1), np.array([1.0, 2.0])), "b": "x"}) == {"a": [1, [1.0, 2.0]], "b": "x"}
