"""Time pictures and the viewer: one JSON object per line.

    python benchmarks/viewer.py                       pictures, and the page for a vault of 1,000 parts
    python benchmarks/viewer.py --parts 250           another size
    python benchmarks/viewer.py --no-browser          without Chromium

`update` is the server time to change the page from one state to another, `sent` the number of meshes sent. Frames
a second are those of a headless Chromium that draws in software, on the CPU: any graphics card is faster.
"""

from __future__ import annotations

import argparse
import shutil
import time
from pathlib import Path

import numpy as np
from record import report, write_to

from falsework import Assembly, Direction, find_plans, load_structure, make_task
from falsework.assembly import HELD, REMOVED, complete_state
from falsework.viewer import Timeline
from falsework.viewer.page.page import Page
from falsework.viewer.page.viewer_state import ViewerState
from falsework.viewer.pictures.contact_sheet import contact_sheet, one_state
from falsework.viewer.timeline import holders, interesting

FLAGS = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]
COUNT = """() => new Promise(done => {
  let frames = 0; const begun = performance.now();
  const tick = () => { frames += 1; performance.now() - begun < 4000 ? requestAnimationFrame(tick)
    : done(frames / (performance.now() - begun) * 1000); };
  requestAnimationFrame(tick);
})"""


def pictures() -> None:
    """Time a contact sheet and one state of the built-in vault, after compilation."""
    vault = load_structure("vault")
    timeline = Timeline.from_plan(find_plans(vault, make_task(vault)).plans[0], vault, Direction.ASSEMBLY)
    one_state(timeline, 0.5)
    begun = time.perf_counter()
    contact_sheet(timeline, interesting(timeline, 12))
    sheet = time.perf_counter() - begun
    begun = time.perf_counter()
    one_state(timeline, len(timeline) / 2)
    report(
        "viewer pictures",
        structure="vault",
        sheet_seconds=round(sheet, 3),
        state_seconds=round(time.perf_counter() - begun, 3),
    )


def from_the_top(assembly: Assembly) -> Timeline:
    """Return a timeline of disassembly from the top; not proven, since only the page is measured."""
    order = np.argsort(-assembly.mass.center[:, 2], kind="stable")
    states, actions = [complete_state(assembly.boundary)], []
    for part in order[~assembly.boundary[order]]:
        for action, value in ((part, HELD), (part + assembly.part_count, REMOVED)):
            state = states[-1].copy()
            state[part] = value
            states.append(state)
            actions.append(int(action))
    rows = np.array(states)
    who = holders(rows, assembly.boundary)
    return Timeline(assembly, rows, np.array(actions), who, Direction.DISASSEMBLY, 1)


def page(parts: int, browser: bool) -> None:
    """Time steps and jumps on the page of a large vault."""
    timeline = from_the_top(load_structure(f"vault:parts={parts}"))
    begun = time.perf_counter()
    shown = Page(ViewerState(timeline), port=8195)
    opened = time.perf_counter() - begun
    rng = np.random.default_rng(0)
    found: dict[str, object] = {"parts": parts, "open_seconds": round(opened, 2)}
    for name, places in (
        ("steps", np.arange(1, 201)),
        ("frames", np.arange(200, 210, 1 / 15)),
        ("jumps", rng.integers(0, len(timeline), 60)),
    ):
        spent, sent = [], []
        for place in places.tolist():
            shown.model.go_to(place)
            begun = time.perf_counter()
            with shown.server.atomic():
                sent.append(shown.scene.show(shown.model.appearance()))
            spent.append(time.perf_counter() - begun)
        found[f"{name}_update_ms"] = [round(1000 * float(np.percentile(spent, share)), 2) for share in (50, 95)]
        found[f"{name}_sent"] = [round(float(np.mean(sent)), 2), int(max(sent))]
    found["nodes"] = shown.scene.node_count
    chromium = shutil.which("chromium")
    if browser and chromium:
        from playwright.sync_api import sync_playwright

        with sync_playwright() as driver:
            started = driver.chromium.launch(executable_path=chromium, args=FLAGS)
            tab = started.new_page(viewport={"width": 1000, "height": 640})
            begun = time.perf_counter()
            tab.goto(shown.address)
            tab.get_by_text("Step", exact=True).wait_for()
            found["load_seconds"] = round(time.perf_counter() - begun, 2)
            tab.wait_for_timeout(3000)
            tab.get_by_role("button", name="Play").click()
            found["frames_a_second_playing_in_software"] = round(tab.evaluate(COUNT), 1)
            started.close()
    shown.close()
    report("viewer page", **found, seeds=(0,))


def main() -> None:
    """Run the benchmark of the command line."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--parts", type=int, default=1000)
    options.add_argument("--no-browser", action="store_true")
    options.add_argument("--out", type=Path, help="file to which the records are appended")
    chosen = options.parse_args()
    write_to(chosen.out)
    pictures()
    page(chosen.parts, not chosen.no_browser)


if __name__ == "__main__":
    main()
