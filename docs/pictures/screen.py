"""Screenshots of the page and of a notebook, where a Chromium is there."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from falsework import find_plans, load_structure, make_task
from falsework.search.plans.steps import NO_ROBOT
from falsework.viewer import Timeline
from falsework.viewer.page.page import Page
from falsework.viewer.page.viewer_state import ViewerState

FLAGS = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]
CELLS = (
    "import falsework as fw\n\narch = fw.load_structure('arch:blocks=9')\nfound = fw.find_plans(arch, robots=2)",
    "found.plans[0]",
)


@contextmanager
def opened(path: Path, address: str, width: int, height: int) -> Iterator[Any]:
    """A tab with a page of which a picture is written in the end; None without Chromium, which leaves it as it was."""
    chromium = shutil.which("chromium")
    if chromium is None:
        print(f"{path} is left as it is: there is no Chromium")
        yield None
        return
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=chromium, args=FLAGS)
        tab = browser.new_page(viewport={"width": width, "height": height})
        tab.goto(address)
        tab.add_style_tag(content=".mantine-Notifications-root { display: none }")
        yield tab
        tab.screenshot(path=str(path))
        browser.close()


def page(path: Path) -> None:
    """The page with a vault half built, its contact forces, and one part selected."""
    vault = load_structure("vault")
    plan = find_plans(vault, make_task(vault)).plans[0]
    model = ViewerState(Timeline.from_plan(plan, vault), plan=plan)
    busy = [(model.timeline.holders[model.timeline.row(place)] != NO_ROBOT).sum() for place in range(len(plan))]
    middle = len(plan) // 2
    model.go_to(middle - 8 + int(np.argmax(busy[middle - 8 : middle + 8])))
    model.selected = int(np.argmax(np.where(model.state == 1, vault.mass.center[:, 1], -np.inf)))
    shown = Page(model, port=8191)
    shown.refresh()
    with opened(path, shown.address, 1200, 840) as tab:
        if tab is not None:
            tab.get_by_role("tab", name="Look").wait_for()
            tab.get_by_label("Contact forces").check()
            tab.wait_for_timeout(12_000)
    shown.close()


def notebook(path: Path) -> None:
    """A notebook with a plan."""
    import nbformat
    from nbclient import NotebookClient
    from nbconvert import HTMLExporter

    book = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(source) for source in CELLS])
    with tempfile.TemporaryDirectory() as folder:
        NotebookClient(book, resources={"metadata": {"path": folder}}).execute()
        file = Path(folder) / "notebook.html"
        file.write_text(HTMLExporter().from_notebook_node(book)[0], encoding="utf-8")
        with opened(path, file.as_uri(), 1000, 760) as tab:
            if tab is not None:
                tab.locator("summary").click()
                tab.wait_for_timeout(2_000)


def shoot(address: str, text: str, path: Path) -> None:
    """Write a screenshot of a page that has a text; without Chromium the picture stays as it was."""
    with opened(path, address, 1200, 780) as tab:
        if tab is not None:
            tab.get_by_text(text, exact=True).wait_for()
            tab.wait_for_timeout(12_000)
