"""Tests look at what is public: private names of the package in them are few, and they replace no constants."""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

TESTS = Path(__file__).parent
MOST_PRIVATE = 10
PUBLIC = {"_replace", "_asdict", "_fields", "_make", "_exit", "_repr_mimebundle_", "_repr_html_"}
"""Names of named tuples, of `os` and of Jupyter, which are public in spite of the underscore."""
PLACES = {"ARCHIVE", "STRUCTURES", "PRETRAINED"}
"""Constants that say where something is."""
PRIVATE = re.compile(r"_(?!_)\w+")


def called(call: ast.Call) -> str:
    """Return the name that is called, after a point where it is an attribute; empty where it has no name."""
    return f".{call.func.attr}" if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")


def private_names(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Yield private names of other objects, with lines: attributes, imports, and texts that name what is replaced."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute):
            own = isinstance(node.value, ast.Name) and node.value.id in ("self", "cls")
            names = [] if own else [node.attr]
        elif isinstance(node, ast.ImportFrom):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.Call) and called(node).endswith(("setattr", "getattr")):
            texts = [word.value for word in node.args if isinstance(word, ast.Constant) and isinstance(word.value, str)]
            names = [text.rpartition(".")[2] for text in texts]
        else:
            continue
        yield from ((node.lineno, name) for name in names if PRIVATE.fullmatch(name) and name not in PUBLIC)


def replaced_constants(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Yield constants of the package that a test replaces by other values, with lines; an argument would do."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and called(node).endswith((".setattr", ".setitem")):
            said = " ".join(ast.unparse(word) for word in node.args[:2]).replace("'", "")
            found = None if "sys.modules" in said else re.search(r"(?:\.|^|\s)(_?[A-Z][A-Z_]{2,})\b", said)
            if found and found[1] not in PLACES and "ctypes" not in said:
                yield node.lineno, found[1]


@cache
def trees() -> dict[Path, ast.Module]:
    """All files of tests."""
    return {path: ast.parse(path.read_text(encoding="utf-8")) for path in sorted(TESTS.rglob("*.py"))}


def listed(kind: Callable[[ast.AST], Iterator[tuple[int, str]]]) -> list[str]:
    """Return what a function yields for all files of tests, by place."""
    return [f"{path.relative_to(TESTS)}:{line}: {name}" for path, tree in trees().items() for line, name in kind(tree)]


def test_private_names_are_few() -> None:
    found = listed(private_names)
    assert len(found) <= MOST_PRIVATE, "\n".join(found)


def test_no_constants_are_replaced() -> None:
    assert listed(replaced_constants) == []


def test_the_checks_see_them() -> None:
    tree = ast.parse("from m import _a\nx._b\nself._c\np.setattr(m, '_D', 1)\np.setattr('m.EDGES', 2)\nt._replace()")
    assert [name for _, name in private_names(tree)] == ["_a", "_b", "_D"]
    replaced = ast.parse("p.setattr(m, '_FEW', 1)\np.setattr('m.MOST', 2)\np.setattr(m, 'ask', f)")
    assert [name for _, name in replaced_constants(replaced)] == ["_FEW", "MOST"]
