"""Models of files: strict reading of untrusted values with messages of one line, and the JSON Schemas of files."""

from __future__ import annotations

import ast
import math
import re
from bisect import bisect_left
from collections.abc import Callable, Iterable, Mapping, Sequence
from difflib import get_close_matches
from functools import cache, reduce
from inspect import cleandoc, getsource
from itertools import pairwise
from operator import getitem
from os import PathLike, fspath
from typing import Any, TypeVar

from msgspec import Struct, ValidationError, convert, inspect, json, to_builtins

from falsework.errors import InputError

Kind = TypeVar("Kind")

_SHOWN = 60
"""Characters of a wrong value that a message repeats."""
_LONG = 80
"""Characters of a description from which messages leave it out."""
_WORDS = {
    "int": "a whole number",
    "float": "a number",
    "str": "a text",
    "bool": "true or false",
    "array": "a list",
    "object": "an object",
}
"""Types of a model in messages."""


class FileModel(Struct, forbid_unknown_fields=True, frozen=True, omit_defaults=True):
    """Base of the models of files: keys of its fields only, those with a default may be missing.

    The texts below fields are their descriptions in messages and schemas.
    """


class ForeignModel(FileModel, forbid_unknown_fields=False, frozen=True):
    """Base of models of what other programs write, as far as it is used: further keys may be anything.

    They are in no schema.
    """


def read_model(
    kind: type[Kind], data: Any, about: str, error: Callable[[str], InputError], where: str = "", remedy: str = ""
) -> Kind:
    """Convert plain values, such as those of JSON or TOML, to a model.

    Args:
        kind: a `FileModel`.
        data: the values; nothing is converted that is not exact.
        about: beginning of messages, with the name of the file.
        error: makes the error of a message.
        where: path of the values within the file.
        remedy: end of messages about missing and unknown keys.

    Raises:
        InputError: what `error` makes of a message with the path of the first wrong value, the value, and what is
            expected; also if a number is not finite.
    """
    try:
        model = convert(data, kind)
        if place := _not_finite(to_builtins(model), where):
            raise error(f"{about}{place} is not finite; give a number")
        return model
    except UnicodeEncodeError:
        raise error(f"{about}a text in it holds half a character; write it as UTF-8") from None
    except ValidationError as wrong:
        raise error(about + _message(kind, data, str(wrong), where, remedy)) from None


def model_schema(kind: type[FileModel], identifier: str, title: str, description: str) -> dict[str, Any]:
    """Return the JSON Schema (2020-12) of a model.

    Args:
        identifier: name of the schema at the address of all of them.
    """
    schemas = model_schemas((kind,), "#/$defs/{name}")
    about = {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "$id": f"https://falsework.dev/schema/{identifier}.json",
        "title": title,
        "description": description,
    }
    return {**schemas.pop(kind.__name__), **about, "$defs": schemas}


def model_schemas(kinds: Iterable[type[FileModel]], references: str) -> dict[str, Any]:
    """Return the JSON Schemas of models and of the models in them, by name.

    Args:
        references: how one refers to another, with `{name}` in it.
    """
    _, schemas = json.schema_components(kinds, ref_template=references)
    models = {model.__name__: model for model in _below(FileModel)}
    for name, entry in schemas.items():
        if "description" in entry:  # the docstring, which some versions of msgspec leave indented
            entry["description"] = cleandoc(entry["description"])
        for field, text in _field_texts(models[name]).items() if name in models else ():
            entry["properties"][field]["description"] = text
    return json.decode(json.encode(schemas))


def _below(model: type) -> list[type]:
    kinds = [below for below in model.__subclasses__() if below is not ForeignModel]
    return [found for below in kinds for found in (below, *_below(below))]


@cache
def _field_texts(model: type) -> dict[str, str]:
    """Return the texts below the fields of a model."""
    texts = {}
    for kind in reversed(model.__mro__[: model.__mro__.index(FileModel)]):
        try:
            body = ast.parse(getsource(kind)).body[0]
        except (OSError, TypeError):  # of a model that no source defines
            continue
        for field, text in pairwise(body.body if isinstance(body, ast.ClassDef) else ()):
            if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant):
                texts[ast.unparse(field.target)] = cleandoc(str(text.value.value)).replace("\n", " ")
    return texts


def to_json_values(model: Any) -> Any:
    """Return a model as plain JSON values; texts in it may hold what UTF-8 cannot."""
    return plain(to_builtins(model))


def plain(value: Any) -> Any:
    """Return a value that a caller gave as a file would have it: lists for tuples and arrays, texts for paths."""
    if isinstance(value, Mapping):
        return {key: plain(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(entry) for entry in value]
    if isinstance(value, PathLike):
        return fspath(value)
    return value.tolist() if hasattr(value, "tolist") else value


def unknown_key(key: str, known: Iterable[str]) -> str:
    """Return what is wrong with a key that is not known, with the most similar known one."""
    near = get_close_matches(key, known := sorted(known), 1)
    return f"is not known; did you mean {near[0]}?" if near else f"is not known; known are {', '.join(known)}"


def check_options(taker: Callable[..., Any], given: Iterable[str], passed_on: Iterable[str]) -> None:
    """Raise for an option that a function does not take.

    Args:
        given: names of the options that the function collects.
        passed_on: those that it passes on, beside its own options.
    """
    known = {*passed_on, *(taker.__kwdefaults__ or ())}
    odd = next((name for name in given if name not in known), None)
    if odd is not None:
        raise InputError(f"{taker.__name__}: the option {odd} {unknown_key(odd, known)}")


def path_to(place: str, step: int | str) -> str:
    """Return the path of an entry of a list or an object, as messages show it.

    Args:
        place: path of the list or object; empty for all of the content.
    """
    if isinstance(step, int):
        return f"{place}[{step}]"
    name = shown(step)[1:-1]
    return f"{place}.{name}" if place else name


def shown(value: Any) -> str:
    """Return a value of a file as messages repeat it: short, and without control characters."""
    text = ascii(value)
    return text if len(text) <= _SHOWN else f"{text[: _SHOWN - 3]}..."


@cache
def _type_info(kind: Any) -> Any:
    return inspect.type_info(kind)


def _message(kind: Any, data: Any, text: str, where: str, remedy: str) -> str:
    """Return the message of msgspec with the value that was found, and what is expected there."""
    what, _, path = text.partition(" - at `")
    place, value, known, purpose = where, data, _type_info(kind), ""
    taken: list[int | str] = []
    for name, number in re.findall(r"\.(\w+)|\[(\d+|\.\.\.)\]", path):
        purpose = _purpose(known, name)
        step = name or (_wrong_key(kind, data, taken, text) if number == "..." else int(number))
        place = path_to(place, step)
        taken.append(step)
        value, known = value[step], _inside(known, name)
    key = re.search(r"field `(.+)`", what)
    if key and what.startswith("Object missing"):
        return f"{path_to(place, key[1])} is missing{remedy}"
    if key:
        fields = [field.encode_name for entry in _kinds(known) for field in getattr(entry, "fields", ())]
        return f"{path_to(place, key[1])} {unknown_key(key[1], fields)}{remedy}"
    if what == "Number out of range":
        return f"{place} is {shown(value)}; give a number that fits into 64 bits"
    expected = what.removeprefix("Expected ").partition(", got")[0]
    if what.startswith("Invalid value"):  # of the key that tells which of several objects it is
        known = None
        options = [entry.tag for entry in _kinds(_type_info(kind))]
    else:
        options = [str(option) for entry in _kinds(known) for option in _options(entry)]
    expected = f"one of {', '.join(options)}" if options else _in_words(expected) + purpose
    return f"{place or 'the content'} is {shown(value)}; give {expected}"


def _wrong_key(kind: Any, data: Any, taken: Sequence[int | str], text: str) -> str:
    """Return the key of the first wrong entry of an object that messages of msgspec call `[...]`.

    Args:
        taken: steps from the data to the object.
        text: message of msgspec, which it repeats for any beginning of the object that has the entry.
    """
    entries = list(reduce(getitem, taken, data).items())

    def is_wrong(count: int) -> bool:
        try:
            convert(_exchanged(data, taken, dict(entries[:count])), kind)
        except ValidationError as wrong:
            return str(wrong) == text
        return False

    return entries[bisect_left(range(1, len(entries)), True, key=is_wrong)][0]


def _exchanged(data: Any, taken: Sequence[int | str], value: Any) -> Any:
    """Return data with another value at the end of some steps."""
    if not taken:
        return value
    copy = data.copy()
    copy[taken[0]] = _exchanged(data[taken[0]], taken[1:], value)
    return copy


def _in_words(expected: str) -> str:
    """Return a type as msgspec writes it, such as "`float | null` >= 0.0", in words."""
    kinds, _, bound = expected.removeprefix("`").partition("`")
    named = [kind for kind in kinds.split(" | ") if kind != "null"]  # of what may be left out
    bound = re.sub(r"\.0$", "", bound).replace(r"matching regex '\\S'", "that is not blank")
    return " or ".join(_WORDS.get(kind, kind) for kind in named) + bound


def _kinds(kind: Any) -> list[Any]:
    """Return the types that a type stands for."""
    if isinstance(kind, inspect.Metadata):
        return _kinds(kind.type)
    return list(kind.types) if isinstance(kind, inspect.UnionType) else [kind]


def _inside(kind: Any, name: str) -> Any:
    """Return the type of a field of an object, or without a name, of the elements of a list."""
    for entry in _kinds(kind):
        found = [field.type for field in getattr(entry, "fields", ()) if field.encode_name == name]
        found += [getattr(entry, "item_type", getattr(entry, "value_type", None))] if not name else []
        if found:
            return found[0]
    return None


def _options(kind: Any) -> tuple[Any, ...]:
    if isinstance(kind, inspect.Metadata):
        return _options(kind.type)
    return tuple(kind.cls) if isinstance(kind, inspect.EnumType) else getattr(kind, "values", ())


def _purpose(kind: Any, name: str) -> str:
    """Return the first clause of the description of a field."""
    texts = [
        _field_texts(entry.cls).get(field.name, "")
        for entry in _kinds(kind)
        for field in getattr(entry, "fields", ())
        if field.encode_name == name
    ]
    text = re.split(r"[.;] |\.$", texts[0] if texts else "")[0]
    text = text[:1].lower() + text[1:] if re.match(r"[A-Z][a-z]{2}", text) else text  # not of units
    return f" ({text})" if 0 < len(text) < _LONG else ""


def _not_finite(value: Any, place: str) -> str:
    """Return the path of the first number that is not finite; empty if there is none."""
    if type(value) is float:
        return "" if math.isfinite(value) else place or "the content"
    if isinstance(value, (list, tuple)):
        try:  # of lists of numbers, most of a file
            if math.isfinite(sum(value)):
                return ""
        except (TypeError, OverflowError):
            pass
        inside: Iterable[tuple[str, Any]] = ((path_to(place, index), entry) for index, entry in enumerate(value))
    elif isinstance(value, dict):
        inside = ((path_to(place, str(key)), entry) for key, entry in value.items())
    else:
        return ""
    return next((found for name, entry in inside if (found := _not_finite(entry, name))), "")
