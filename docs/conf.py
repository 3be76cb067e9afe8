"""Sphinx configuration; `make docs` builds with warnings as errors."""

from __future__ import annotations

import gc
import re
import sys
from pathlib import Path
from typing import Any

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.application import Sphinx

gc.set_threshold(200_000, 20, 100)  # at the usual thresholds collections take two fifths of the time

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent / "src"))

from falsework import __version__  # noqa: E402

project = "falsework"
author = "The falsework authors"
project_copyright = "The falsework authors, Apache-2.0"
version = release = __version__

extensions = ["sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode", "myst_parser", "sphinx_copybutton"]
exclude_patterns = ["_build", "pictures"]
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


def setup(app: Sphinx) -> None:
    """Connect what is defined here."""
    # Formulas as MathML: every browser shows it, without scripts from elsewhere.
    app.add_html_math_renderer(
        "mathml", inline_renderers=(_inline_formula, None), block_renderers=(_display_formula, None)
    )
    # Before napoleon, which takes the first colon for the end of a type even inside code.
    app.connect("autodoc-process-docstring", _code_in_backticks, priority=400)
    app.connect("doctree-read", _leave_out_of_search)
    app.connect("source-read", _link_to_copies)


def _copy(source: str, name: str, replaced: dict[str, str]) -> None:
    """Copy a page from elsewhere in the repository to where Sphinx finds it, with links as from there."""
    text = (HERE.parent / source).read_text(encoding="utf-8")
    for pattern, link in replaced.items():
        text = re.sub(pattern, link, text)
    (HERE / "_generated").mkdir(exist_ok=True)
    (HERE / "_generated" / name).write_text(text, encoding="utf-8")


def _link_to_copies(_app: Sphinx, name: str, text: list[str]) -> None:
    """Let links to the results lead to their copy."""
    up = "../" * name.count("/")
    text[0] = text[0].replace(f"]({up}../benchmarks/RESULTS.md", f"]({up}_generated/results.md")


def _leave_out_of_search(app: Sphinx, _document: nodes.document) -> None:
    """Leave the pages on decisions, which repeat the words of the manual, out of the search."""
    if app.env.docname.startswith("decisions/"):
        app.env.metadata[app.env.docname]["nosearch"] = True


_copy("CHANGELOG.md", "changelog.md", {r"\]\(docs/": "](../"})
_copy(
    "benchmarks/RESULTS.md",
    "results.md",
    {
        r"\]\(\.\./docs/": "](../",
        r"\[[^]]*\]\((results[^)]*)\)": r"`benchmarks/\1`",
        r"\[([^]]*)\]\(\.\./README\.md[^)]*\)": r"\1",
    },
)
