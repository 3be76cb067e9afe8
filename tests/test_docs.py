"""Commands and code of README and documentation run."""

from __future__ import annotations

import importlib
import re
import shlex
import tomllib
from dataclasses import replace
from importlib import resources
from pathlib import Path

import numpy as np
import pytest

from falsework import Assembly, load_structure
from falsework.assembly.store import save_assembly
from falsework.cli.main import COMMANDS, main

REPOSITORY = Path(__file__).resolve().parents[1]
MADE = {"_build", "_generated"}
PAGES = [
    REPOSITORY / "README.md",
    *(page for page in sorted((REPOSITORY / "docs").rglob("*.md")) if not MADE & set(page.parts)),
]
# What the pages call the reader's own files; made here so that the commands run.
OWN = ("my-folder", "my-vault")


def own_structure(folder: str) -> None:
    """An arch of five blocks whose first two parts are the supports, as the pages have it of the reader's vault."""
    arch = load_structure("arch:blocks=5")
    order = np.argsort(~arch.boundary, kind="stable")
    meshes = [replace(arch.meshes[part], name=str(number)) for number, part in enumerate(order)]
    save_assembly(Assembly.from_meshes(meshes, boundary=arch.boundary[order], friction=arch.friction), folder)


def blocks(page: Path, language: str) -> list[str]:
    """Code blocks of a page in one language."""
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)


def in_few_steps(words: list[str]) -> list[str]:
    """Return a command that takes long with few steps, parts, states or draws instead, a film small and short."""
    if words[1] == "evaluate":
        return with_value(words, "--states", "10")
    if words[1] == "graph":
        return of_few_parts(words)
    if words[1] == "margins" and "--draws" in words:
        return with_value(words, "--draws", "5")
    if words[1] == "picture" and "--frames" in words:
        return with_value(words, "--frames", "6")
    if words[1] == "picture" and words[-1].endswith((".mp4", ".gif")):
        return with_value(with_value(words, "--width", "160"), "--rate", "3")
    if words[1] != "train" or "--minutes" not in words:
        return words
    place = words.index("--minutes")
    return of_few_parts([*words[:place], "--steps", "10", *words[place + 2 :]])


def with_value(words: list[str], option: str, value: str) -> list[str]:
    """Return a command with another value of an option, or with that option."""
    place = words.index(option) if option in words else len(words)
    return [*words[:place], option, value, *words[place + 2 :]]


def of_few_parts(words: list[str]) -> list[str]:
    """Return a command about a small structure of the same family."""
    small = {"arch": "arch:blocks=7", "bottle": "arch:blocks=5", "shelf": "shelf:shelves=0", "vault": "vault:parts=30"}
    small["plan.json:31"] = "plan.json:3"
    return [small.get(word, word) for word in words]


@pytest.fixture
def nobody_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    """A page in the browser is served, and closed at once."""
    monkeypatch.setattr("falsework.viewer.web.served_page.ServedPage.wait", lambda _: None)
    monkeypatch.setattr("webbrowser.open", lambda *_: True)


def name_of(page: Path) -> str:
    return str(page.relative_to(REPOSITORY))


def test_the_readme_has_code() -> None:
    assert len(blocks(REPOSITORY / "README.md", "python")) == 1
    assert len(blocks(REPOSITORY / "README.md", "sh")) >= 3


@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page, "python")], ids=name_of)
@pytest.mark.usefixtures("nobody_waits")
def test_python_runs(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The blocks of a page, one after the other, in an empty folder."""
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {"__name__": "__main__"}
    for block in blocks(page, "python"):
        exec(compile(block, name_of(page), "exec"), names)


@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page, "sh")], ids=name_of)
@pytest.mark.usefixtures("nobody_waits")
def test_commands_run(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Lines that begin with `falsework`, one after the other, exit with 0, or as a comment `# exit code 1` says."""
    monkeypatch.chdir(tmp_path)
    for folder in OWN:
        own_structure(folder)
    for block in blocks(page, "sh"):
        for line in block.splitlines():
            words = shlex.split(line, comments=True)
            if words[:1] == ["falsework"]:
                words = in_few_steps(words)
                said = re.search(r"#.*\bexit code (\d+)", line)
                assert main(words[1:]) == (int(said[1]) if said else 0), line


@pytest.mark.slow
@pytest.mark.usefixtures("nobody_waits")
def test_examples_in_help_texts_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from falsework.cli import main as entry

    monkeypatch.chdir(tmp_path)
    assert main(["export", "arch:blocks=5", "--out", "my-folder"]) == 0
    Path("states.json").write_text("[[1, 1, 1, 1, 1, 2, 2]]")
    built_in = resources.files("falsework.robots.cells").joinpath("bottle-12.toml")
    Path("cell.toml").write_text(built_in.read_text(encoding="utf-8"), encoding="utf-8")
    for name in (
        "structures",
        "doctor",
        "plan",
        "export",
        "check",
        "stability",
        "margins",
        "graph",
        "train",
        "evaluate",
        "replan",
        "view",
        "picture",
    ):
        for example in entry.command_class(name).examples:
            words = of_few_parts(in_few_steps(shlex.split(example)))
            assert words[:2] == ["falsework", name]
            if not {"shell.glb", "model.3dm", "--cell"} & set(words):
                assert main(words[1:]) == 0, example


def test_every_command_is_in_the_documentation() -> None:
    """On a page of its own, which the list of pages names."""
    listed = (REPOSITORY / "docs" / "cli.md").read_text(encoding="utf-8")
    pages = {path.stem for path in (REPOSITORY / "docs" / "cli").glob("*.md")}
    assert pages == {name.replace(" ", "-") for name in COMMANDS}
    for name in COMMANDS:
        page = REPOSITORY / "docs" / "cli" / f"{name.replace(' ', '-')}.md"
        assert page.read_text(encoding="utf-8").startswith(f"# falsework {name}\n")
        assert f"<!-- from the source: help {name} -->" in page.read_text(encoding="utf-8")
        assert f"(cli/{page.name})" in listed


def test_what_pages_take_from_the_source_is_up_to_date(monkeypatch: pytest.MonkeyPatch) -> None:
    """`make reference` writes it; the width of frames does not count."""
    monkeypatch.syspath_prepend(str(REPOSITORY / "docs"))
    reference = importlib.import_module("reference")
    pages = list(reference.pages())
    assert len(pages) > len(COMMANDS)
    stale = [
        name_of(page)
        for page, wanted in pages
        if reference.words_of(page.read_text(encoding="utf-8")) != reference.words_of(wanted)
    ]
    assert stale == [], "run: make reference"


def test_pages_read_well_as_files() -> None:
    """As hosts of code show them: text in every link, pictures and texts in the page itself, no roles of Sphinx."""
    for page in PAGES:
        whole = page.read_text(encoding="utf-8")
        text = re.sub(r"^( *)```.*?^\1```", "", whole, flags=re.DOTALL | re.MULTILINE)
        assert "[](" not in text, f"{name_of(page)} has a link without text"
        assert not re.search(r"\{\w+\}`", text), f"{name_of(page)} has a role of Sphinx"
        shown = re.findall(r"^ *```\{([\w-]+)\}", whole, re.MULTILINE)
        assert set(shown) <= {"toctree", "eval-rst"}, f"{name_of(page)} has blocks that only Sphinx shows"
        words = re.sub(r"^```\{.*?^```|<!--.*?-->|^# [^\n]*", "", whole, flags=re.DOTALL | re.MULTILINE).split()
        assert len(words) > 10, f"{name_of(page)} says nothing by itself"


def test_make_targets_exist() -> None:
    makefile = (REPOSITORY / "Makefile").read_text(encoding="utf-8")
    for page in (REPOSITORY / "README.md", REPOSITORY / "CONTRIBUTING.md", REPOSITORY / "docs" / "index.md"):
        for target in re.findall(r"^make (\w+)", page.read_text(encoding="utf-8"), re.MULTILINE):
            assert re.search(rf"^{target}:", makefile, re.MULTILINE), f"{page.name} names make {target}"


def test_smoke_tests_touch_every_layer() -> None:
    makefile = (REPOSITORY / "Makefile").read_text(encoding="utf-8").replace("\\\n", " ")
    chosen = re.search(r"^SMOKE := (.*)$", makefile, re.MULTILINE)
    assert chosen is not None
    places = chosen[1].split()
    assert all((REPOSITORY / place).exists() for place in places)
    layers = {path.name for path in (REPOSITORY / "tests").iterdir() if path.is_dir() and any(path.rglob("test_*.py"))}
    assert {place.split("/")[1] for place in places} >= layers - {"benchmarks"}


def test_links_lead_somewhere() -> None:
    for page in PAGES:
        for link in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8")):
            if "://" not in link:
                assert (page.parent / link).exists(), f"{name_of(page)}: {link}"


def test_modules_that_pages_name_exist() -> None:
    folders = ("src", "tests", "bench", "benchmarks", "client", "docs", "examples", "kernels")
    files = {path.name for folder in folders for path in (REPOSITORY / folder).rglob("*.py")}
    pages = [REPOSITORY / "docs" / "architecture.md", *(REPOSITORY / "docs" / "decisions").glob("*.md")]
    named = {(page.name, name) for page in pages for name in re.findall(r"`(?:[\w./-]*/)?(\w+\.py)`", page.read_text())}
    assert [(page, name) for page, name in sorted(named) if name not in files] == []


def test_keys_of_answers_that_pages_list_are_written() -> None:
    source = "\n".join(path.read_text() for path in (REPOSITORY / "src").rglob("*.py"))
    words = set(re.findall(r"\w+", source))
    pages = (REPOSITORY / "docs" / "cli").glob("*.md")
    rows = [(page.name, row) for page in pages for row in re.findall(r"^\| `(\w+)` \|", page.read_text(), re.M)]
    assert rows
    assert [(page, key) for page, key in rows if key not in words] == []


DECISIONS = sorted(page for page in (REPOSITORY / "docs" / "decisions").glob("*.md") if page.name != "index.md")


def test_pages_on_decisions_are_short() -> None:
    """As CONTRIBUTING says; generated tables, and what is no word, such as the lines of tables, do not count."""
    said = re.search(r"at most (\d+) words", (REPOSITORY / "CONTRIBUTING.md").read_text(encoding="utf-8"))
    assert said is not None
    table = re.compile(r"<!-- results: .*?<!-- /results -->", re.DOTALL)
    texts = {page.name: table.sub("", page.read_text(encoding="utf-8")) for page in DECISIONS}
    words = {name: len(re.findall(r"\S*\w\S*", text)) for name, text in texts.items()}
    assert len(words) > 20
    assert {name: count for name, count in words.items() if count > int(said[1])} == {}


@pytest.mark.parametrize("page", DECISIONS, ids=name_of)
def test_pages_on_decisions_say_what_holds_why_and_what_was_tried(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert re.findall(r"^## (.*)$", text, re.MULTILINE) == ["What holds", "Why", "Tried and left"]
    assert "\n| tried | result | why left |\n| --- | --- | --- |\n|" in text.partition("## Tried and left")[2]


def test_every_page_on_decisions_has_a_line_in_the_index() -> None:
    index = (REPOSITORY / "docs" / "decisions" / "index.md").read_text(encoding="utf-8")
    described = re.findall(r"^- \[[^]]+\]\(([\w-]+)\.md\): ", index, re.MULTILINE)
    listed = index.partition(":hidden:")[2].split("```")[0].split()
    assert sorted(described) == sorted(listed) == [page.stem for page in DECISIONS]


def test_decisions_are_named_by_topic() -> None:
    """Paths such as `docs/decisions/margins.md` exist, and nothing counts decisions, which have no numbers."""
    places = [REPOSITORY / "CHANGELOG.md", REPOSITORY / "CONTRIBUTING.md", *PAGES]
    for folder, kinds in {"src": ("*.py", "*.cuh"), "tests": ("*.py",), "benchmarks": ("*.py", "*.md")}.items():
        places += [path for kind in kinds for path in (REPOSITORY / folder).rglob(kind)]
    for path in places:
        text = path.read_text(encoding="utf-8")
        for named in re.findall(r"docs/decisions/(\w[\w.-]*\w)", text):
            assert (REPOSITORY / "docs" / "decisions" / named).exists(), f"{name_of(path)}: {named}"
        assert not re.search(r"\bdecisions? \d", text), name_of(path)


def test_extras_that_are_named_exist() -> None:
    extras = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    for page in PAGES:
        for named in re.findall(r"'\.\[([\w,]+)\]'", page.read_text(encoding="utf-8")):
            assert set(named.split(",")) <= set(extras), f"{name_of(page)}: {named}"
