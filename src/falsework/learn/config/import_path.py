"""Import paths `package.module:Name` of classes and functions that others have written."""

from __future__ import annotations

import re
from importlib import import_module
from typing import Any

from falsework.errors import InputError

_PATH = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_][\w.]*")


def is_import_path(text: str) -> bool:
    """Return whether a text has the form `package.module:Name`, which can be imported or not."""
    return bool(_PATH.fullmatch(text.replace("<locals>", "locals").replace("<lambda>", "lambda")))


def import_path_of(thing: Any) -> str:
    """Return the import path of a class or function; of another object, that of its class."""
    named = thing if hasattr(thing, "__qualname__") else type(thing)
    return f"{named.__module__}:{named.__qualname__}"


def import_by_path(path: str, what: str) -> Any:
    """Import a class or function from where Python finds its module; nothing is added to the places that it looks in.

    Args:
        path: `package.module:Name`.
        what: name of its role in the message.

    Raises:
        InputError: no such module, or no such name in it.
    """
    module, _, name = path.partition(":")
    try:
        found: Any = import_module(module)
        for part in name.split("."):
            found = getattr(found, part)
    except (ImportError, AttributeError, ValueError) as error:
        if "<" in name:
            reason = "it was defined inside a function"
        elif module == "__main__":
            reason = "it was defined in a script or notebook"
        else:
            reason = " ".join(str(error).split())
        raise InputError(
            f"cannot import the {what} {path} ({reason}); have it in a module that Python finds, for instance by "
            "PYTHONPATH, or hand it over in Python"
        ) from error
    return found
