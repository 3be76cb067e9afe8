"""Sphinx configuration; `make docs` builds with warnings as errors."""

from __future__ import annotations

import ast
import contextlib
import gc
import io
import os
import re
import sys
import textwrap
from pathlib import Path
from typing import Any

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.application import Sphinx

gc.set_threshold(200_000, 20, 100)  # at the usual thresholds collections take two fifths of the time

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent / "src"))

from falsework import __version__  # noqa: E402
from falsework.cli.main import COMMANDS, main  # noqa: E402

project = "falsework"
author = "The falsework authors"
project_copyright = "The falsework authors, Apache-2.0"
version = release = __version__

extensions = ["sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode", "myst_parser"]
exclude_patterns = ["_build", "_generated", "pictures"]
nitpicky = False

html_math_renderer = "mathml"
html_theme = "furo"
html_title = f"falsework {__version__}"
html_static_path: list[str] = []

myst_enable_extensions = ["dollarmath", "amsmath", "colon_fence", "deflist"]
myst_heading_anchors = 3

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_default_options = {"members": True, "show-inheritance": True}
napoleon_google_docstring = True
napoleon_numpy_docstring = False
# Optional packages are not installed to build the pages.
autodoc_mock_imports = [
    "torch",
    "gurobipy",
    "gymnasium",
    "safetensors",
    "fastapi",
    "starlette",
    "pydantic",
    "uvicorn",
    "prometheus_client",
    "reportlab",
]

suppress_warnings = ["misc.highlighting_failure"]


def _code_in_backticks(_app, _what, _name, _object, _options, lines: list[str]) -> None:
    """Docstrings write code between single backticks, as Markdown does, and bars for norms."""
    for number, line in enumerate(lines):
        pieces = re.split(r"(``.*?``|(?<![`:\w])`[^`]+`(?!`))", line)
        pieces[::2] = [text.replace("|", r"\|") for text in pieces[::2]]
        pieces[1::2] = [f"``{code.strip('`')}``" for code in pieces[1::2]]
        lines[number] = "".join(pieces)


def _inline_formula(translator: Any, node: nodes.math) -> None:
    translator.body.append(convert(node.astext()))
    raise nodes.SkipNode


def _display_formula(translator: Any, node: nodes.math_block) -> None:
    translator.body.append(f'<div class="math">{convert(node.astext(), display="block")}</div>')
    raise nodes.SkipNode


def _leave_out_of_search(app: Sphinx, _document: nodes.document) -> None:
    """Leave the pages on decisions, which repeat the words of the manual, out of the search."""
    if app.env.docname.startswith("decisions/"):
        app.env.metadata[app.env.docname]["nosearch"] = True


def setup(app: Sphinx) -> None:
    """Connect what is defined here."""
    app.connect("doctree-read", _leave_out_of_search)
    # Formulas as MathML: every browser shows it, without scripts from elsewhere.
    app.add_html_math_renderer(
        "mathml", inline_renderers=(_inline_formula, None), block_renderers=(_display_formula, None)
    )
    # Before napoleon, which takes the first colon for the end of a type even inside code.
    app.connect("autodoc-process-docstring", _code_in_backticks, priority=400)


def _write_help_texts() -> None:
    """Help texts as the command prints them, for the page on the command line."""
    folder = HERE / "_generated"
    folder.mkdir(exist_ok=True)
    os.environ["COLUMNS"] = "84"
    for name in ["", *COMMANDS]:
        text = io.StringIO()
        with contextlib.redirect_stdout(text):
            code = main([*name.split(), "--help-all" if name else "--help"])
        if code != 0:
            raise RuntimeError(f"falsework {name} --help failed")
        lines = [line if line[:1] in ("", " ") else textwrap.fill(line, 84) for line in text.getvalue().splitlines()]
        page = f"help-{name.replace(' ', '-') or 'falsework'}.txt"
        (folder / page).write_text("\n".join(lines) + "\n", encoding="utf-8")


def _write_benchmarks() -> None:
    """Write the descriptions of the benchmarks, for the page on benchmarks."""
    texts = []
    for path in sorted((HERE.parent / "benchmarks").glob("[!_]*.py")):
        about = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
        first, _, rest = about.partition("\n")
        if f"benchmarks/{path.name}" in rest:  # others are helpers without a command line
            texts.append(f"## {path.name}\n\n{first}\n\n```text\n{rest.strip()}\n```\n")
    (HERE / "_generated" / "benchmarks.md").write_text("\n".join(texts), encoding="utf-8")


def _write_results() -> None:
    """Write the results as a part of the page on benchmarks: one level lower, and with links that hold there."""
    text = (HERE.parent / "benchmarks" / "RESULTS.md").read_text(encoding="utf-8")
    text = re.sub(r"\[[^]]*\]\((results[^)]*)\)", r"`benchmarks/\1`", text)
    text = re.sub(r"\[([^]]*)\]\(\.\./README\.md[^)]*\)", r"\1", text)
    text = re.sub(r"^#", "##", text, flags=re.MULTILINE)
    (HERE / "_generated" / "results.md").write_text(text, encoding="utf-8")


_write_help_texts()
_write_benchmarks()
_write_results()
