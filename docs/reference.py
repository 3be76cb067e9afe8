"""Parts of the documentation that come from the source: help texts, benchmarks and tables of public names.

They are in the pages themselves, between two comments, so that the pages read well as files too. `make reference`
writes them anew; a test compares them.
"""

from __future__ import annotations

import ast
import contextlib
import io
import os
import re
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path

DOCS = Path(__file__).resolve().parent
REPOSITORY = DOCS.parent
WIDTH = 84
"""Columns of a help text."""
_PLACE = re.compile(r"(<!-- from the source: (?P<what>[^>]+) -->\n).*?(<!-- /from the source -->)", re.DOTALL)


def pages() -> Iterator[tuple[Path, str]]:
    """Return the pages with such parts, and their texts as they should be."""
    for path in sorted(DOCS.rglob("*.md")):
        text = path.read_text(encoding="utf-8")
        if _PLACE.search(text):
            yield path, _PLACE.sub(lambda place: f"{place[1]}\n{_written(place['what'])}\n\n{place[3]}", text)


def words_of(text: str) -> list[str]:
    """Return the words of a page without the frames of help texts, whose lines break by the width of the terminal."""
    return re.sub(r"[─-╿]", " ", text).split()


def _written(what: str) -> str:
    kind, _, name = what.partition(" ")
    return {"help": help_text, "benchmarks": lambda _: benchmarks(), "names": names_of}[kind](name)


def help_text(command: str) -> str:
    """Return the help text of a command with all its options, as code; of the command line itself for no name."""
    from falsework.cli.main import main

    text, before = io.StringIO(), os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = str(WIDTH)
    try:
        with contextlib.redirect_stdout(text):
            code = main([*command.split(), "--help-all" if command else "--help"])
    finally:
        os.environ.pop("COLUMNS")
        if before is not None:
            os.environ["COLUMNS"] = before
    if code != 0:
        raise RuntimeError(f"falsework {command} --help failed")
    lines = [line if line[:1] in ("", " ") else textwrap.fill(line, WIDTH) for line in text.getvalue().splitlines()]
    return "```text\n" + "\n".join(line.rstrip() for line in lines).strip() + "\n```"


def benchmarks() -> str:
    """Return the descriptions of the benchmarks that have a command line."""
    texts = []
    for path in sorted((REPOSITORY / "benchmarks").glob("[!_]*.py")):
        first, _, rest = _docstring(path).partition("\n")
        if f"benchmarks/{path.name}" in rest:
            texts.append(f"## {path.name}\n\n{first}\n\n```text\n{textwrap.dedent(rest).strip()}\n```")
    return "\n\n".join(texts)


def names_of(package: str) -> str:
    """Return a table of the public names of a package or module, with the first sentence of their docstrings."""
    place = REPOSITORY / "src" / Path(*package.split("."))
    stub = place / "__init__.pyi"
    rows = []
    if stub.is_file():
        found = [
            (alias.asname or alias.name, _module(str(statement.module)))
            for statement in ast.parse(stub.read_text(encoding="utf-8")).body
            if isinstance(statement, ast.ImportFrom)
            for alias in statement.names
        ]
        rows = [(name, about) for name, path in found if path is not None and (about := _about(path, name))]
    else:
        path = place.with_suffix(".py")
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, (ast.FunctionDef, ast.ClassDef)) and not node.name.startswith("_"):
                rows.append((node.name, _about(path, node.name)))
    rows.sort(key=lambda row: row[0].lower())
    lines = ["| `{}` | {} |".format(name, about.replace("|", "\\|")) for name, about in rows]
    return "\n".join(["| name | |", "| --- | --- |", *lines])


def _module(name: str) -> Path | None:
    place = REPOSITORY / "src" / Path(*name.split("."))
    return next((one for one in (place.with_suffix(".py"), place / "__init__.py") if one.is_file()), None)


def _about(path: Path, name: str) -> str:
    """Return the first sentence of the docstring of a class, function or constant; empty if it has none."""
    body = ast.parse(path.read_text(encoding="utf-8")).body
    for number, node in enumerate(body):
        text: str | None = None
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)) and node.name == name:
            text = ast.get_docstring(node)
        elif name in _assigned(node) and number + 1 < len(body):
            after = body[number + 1]
            if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant):
                text = str(after.value.value)
        if text:
            first = " ".join(text.split("\n\n")[0].split())
            return re.split(r"(?<=[.;])\s", first)[0].rstrip(".;")
    return ""


def _assigned(node: ast.stmt) -> list[str]:
    targets = node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
    return [target.id for target in targets if isinstance(target, ast.Name)]


def _docstring(path: Path) -> str:
    return ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""


if __name__ == "__main__":
    sys.path.insert(0, str(REPOSITORY / "src"))
    for page, wanted in list(pages()):
        if page.read_text(encoding="utf-8") != wanted:
            page.write_text(wanted, encoding="utf-8")
            print(f"{page.relative_to(REPOSITORY)} was out of date")
