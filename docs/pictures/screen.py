"""Screenshot of the page, where a Chromium is there."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np

from falsework.assembly import load_structure
from falsework.search import find_plans, task_of
from falsework.viewer.page.page import Page
from falsework.viewer.page.viewer_state import ViewerState
from falsework.viewer.timeline import NO_ROBOT, Timeline

FLAGS = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]


def page(path: Path) -> None:
    """The page with a vault half built and one part selected."""
    vault = load_structure("vault")
    plan = find_plans(vault, task_of(vault)).plans[0].reverse()
    model = ViewerState(Timeline.of(plan, vault), plan=plan)
    busy = [(model.timeline.holders[model.timeline.row(place)] != NO_ROBOT).sum() for place in range(len(plan))]
    middle = len(plan) // 2
    model.go_to(middle - 8 + int(np.argmax(busy[middle - 8 : middle + 8])))
    model.selected = int(np.argmax(np.where(model.state == 1, vault.mass.center[:, 1], -np.inf)))
    shown = Page(model, port=8191)
    shown.refresh()
    shoot(shown.address, "Step", path)
    shown.close()


def shoot(address: str, text: str, path: Path) -> None:
    """Write a screenshot of a page that has a text; without Chromium the picture stays as it was."""
    chromium = shutil.which("chromium")
    if chromium is None:
        print(f"{path} is left as it is: there is no Chromium")
        return
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=chromium, args=FLAGS)
        tab = browser.new_page(viewport={"width": 1200, "height": 780})
        tab.goto(address)
        tab.get_by_text(text, exact=True).wait_for()
        tab.add_style_tag(content=".mantine-Notifications-root { display: none }")
        tab.wait_for_timeout(12_000)
        tab.screenshot(path=str(path))
        browser.close()
