"""The page in a real browser: load, slide, click, disrupt, replan, and the picture after each."""

from __future__ import annotations

import io
import json
import re
import signal
import subprocess
import time
import urllib.request
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from falsework import make_task
from falsework.assembly import HELD, REMOVED
from falsework.errors import InputError
from falsework.search.plans.steps import NO_ROBOT
from falsework.utils.quantity import format_quantity
from falsework.viewer import Timeline
from falsework.viewer.page.disruption import ClickMode
from falsework.viewer.page.page import Page
from falsework.viewer.page.scene import SIZE
from falsework.viewer.page.viewer_state import ViewerState
from falsework.viewer.palette import ROBOTS, rgb
from tests.viewer.conftest import CHROMIUM_FLAGS, chromium, planned

pytest.importorskip("viser", reason="the page needs viser; pip install 'falsework[viewer]'")
playwright = pytest.importorskip("playwright.sync_api", reason="needs playwright to steer a browser")
pil = pytest.importorskip("PIL.Image")

WINDOW = {"width": 800, "height": 500}
PATIENCE = 60.0
# Chromium says these of software rendering, and of parts of viser that the page does not use: they are no errors of it.
HARMLESS = (
    "Evaluating a string as JavaScript",
    "GPU stall",
    "deprecated",
    "swiftshader",
    "SwiftShader",
    "GL Driver Message",
    "favicon",
)


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """One headless Chromium for all tests here."""
    path = chromium()
    with playwright.sync_playwright() as driver:
        started = driver.chromium.launch(executable_path=path, args=CHROMIUM_FLAGS)
        yield started.new_context(viewport=WINDOW)
        started.close()


@pytest.fixture(scope="module")
def tab(browser: Any) -> Any:
    """One tab for all pages that are served here: another has a process of its own, which reads all scripts anew."""
    return browser.new_page()


@dataclass
class Open:
    """A page in a tab."""

    page: Page
    tab: Any
    complaints: list[str]

    @property
    def model(self) -> ViewerState:
        return self.page.model

    def until(self, true: Callable[[], bool], what: str) -> None:
        """Wait for something to come true; what the tab reports comes in meanwhile."""
        end = time.monotonic() + PATIENCE
        while not true():
            assert time.monotonic() < end, f"waited in vain: {what}"
            self.tab.wait_for_timeout(50)

    def picture(self, shows: Callable[[np.ndarray], Any] = lambda seen: True) -> np.ndarray:
        """What the tab shows left of the controls, once it stays as it is and shows what it should."""
        before, end = None, time.monotonic() + PATIENCE
        while True:
            clip = {"x": 0, "y": 0, "width": 410, "height": 500}
            now = np.asarray(pil.open(io.BytesIO(self.tab.screenshot(clip=clip))).convert("RGB")).astype(int)
            if before is not None and np.abs(now - before).max() < 40 and shows(now):
                return now
            assert time.monotonic() < end, "the picture does not come to rest, or does not show what it should"
            before = now
            self.tab.wait_for_timeout(120)

    def point_of(self, part: int, window: tuple[int, int] = (WINDOW["width"], WINDOW["height"])) -> tuple[float, float]:
        """Where in the tab the middle of a part is drawn."""
        width, height = window
        camera = next(iter(self.page.server.get_clients().values())).camera
        position, target = np.asarray(camera.position), np.asarray(camera.look_at)
        ahead = (target - position) / np.linalg.norm(target - position)
        right = np.cross(ahead, np.asarray(camera.up_direction))
        right /= np.linalg.norm(right)
        way = self.page.scene.place(self.model.assembly.mass.center[part]) - position
        scale = height / 2 / np.tan(camera.fov / 2) / (way @ ahead)
        return width / 2 + scale * (way @ right), height / 2 - scale * (way @ np.cross(right, ahead))

    def click(self, part: int) -> None:
        """Click the middle of a part as a person would."""
        x, y = self.point_of(part)
        self.tab.mouse.move(x - 3, y)
        self.tab.mouse.move(x, y)
        self.tab.mouse.down()
        self.tab.wait_for_timeout(60)
        self.tab.mouse.up()

    def slide(self, place: int) -> None:
        """Type a step into the box beside the slider."""
        box = self.tab.locator("input[type=text]").first
        box.fill(str(place))
        box.press("Enter")
        self.until(lambda: self.model.position == place, f"step {place}")

    def choose(self, label: str, value: str) -> None:
        """Take an entry of a list."""
        self.tab.get_by_label(label).first.click()
        self.tab.get_by_role("option", name=value, exact=True).click()


@pytest.fixture
def opened(tab: Any) -> Iterator[Callable[..., Open]]:
    """Serve a model and open it in the tab; whatever the console says against it fails the test."""
    pages: list[Page] = []
    listening: list[tuple[str, Callable[[Any], None]]] = []

    def listen(event: str, hear: Callable[[Any], None]) -> None:
        tab.on(event, hear)
        listening.append((event, hear))

    def show(model: ViewerState, *, shadows: bool = False, window: dict[str, int] = WINDOW) -> Open:
        page = Page(model, port=8190)
        pages.append(page)
        if not shadows:  # most of what it takes to draw a picture without a graphics card
            page.server.scene.configure_default_lights(enabled=True, cast_shadow=False)
        tab.set_viewport_size(window)
        now = Open(page, tab, [])
        listen("console", lambda said: now.complaints.append(said.text) if said.type == "error" else None)
        listen("pageerror", lambda error: now.complaints.append(str(error)))
        tab.goto(page.address)
        tab.get_by_role("tab", name="Look").wait_for(timeout=1000 * PATIENCE)
        now.until(lambda: bool(page.server.get_clients()), "the browser connects")
        tab.add_style_tag(content=".mantine-Notifications-root { display: none }")
        return now

    yield show
    for event, hear in listening:
        tab.remove_listener(event, hear)
    tab.goto("about:blank")
    for page in pages:
        page.close()


def complaints_of(now: Open) -> list[str]:
    return [text for text in now.complaints if not any(word in text for word in HARMLESS)]


def near(picture: np.ndarray, color: str, reach: int = 90) -> int:
    """Pixels whose colour is of the same kind; light changes what is drawn."""
    value = np.array(rgb(color))
    hue, wanted = picture - picture.mean(axis=2, keepdims=True), value - value.mean()
    length = np.maximum(np.linalg.norm(hue, axis=2), 1e-9)
    along = (hue @ wanted) / length / np.linalg.norm(wanted)
    return int(((along > 0.93) & (length > reach / 2)).sum())


@pytest.mark.slow
def test_a_day_on_site(opened: Callable[..., Open], arch: Any) -> None:
    """Load, slide, click a part, mark one as missing, plan anew, lose the server."""
    assembly, plan = arch
    model = ViewerState(Timeline.from_plan(plan, assembly), plan=plan)
    now = opened(model)
    tab = now.tab
    empty = now.picture()
    tab.get_by_text("held by R1").wait_for()

    held = next(
        place for place in range(len(plan) + 1) if (model.timeline.holders[model.timeline.row(place)] >= 0).any()
    )
    now.slide(held)
    tab.get_by_text(plan[held - 1].words).wait_for()
    now.picture(lambda seen: near(seen, ROBOTS[0]) > near(empty, ROBOTS[0]) + 100)

    steps = len(model.timeline)
    now.slide(steps)
    whole = now.picture(lambda seen: (np.abs(seen - empty).max(axis=2) > 40).sum() > 3000)

    top = int(np.argmax(assembly.mass.center[:, 2]))
    now.click(top)
    now.until(lambda: model.selected == top, "the part is selected")
    tab.get_by_text(f"{assembly.names[top]} (number {top})").wait_for()
    tab.get_by_text(format_quantity(float(assembly.mass.mass[top]), "mass")).wait_for()
    selected = now.picture(lambda seen: (np.abs(seen - whole).max(axis=2) > 25).sum() > 50)

    for name in ("Contact forces", "Friction", "Gravity"):
        tab.get_by_label(name).check()
    tab.get_by_text("stable: contact forces balance").wait_for()
    tab.get_by_text(re.compile(r"contact forces, up to [\d.]+ k?N")).wait_for()
    now.picture(lambda seen: near(seen, "#f08c00") > near(selected, "#f08c00") + 20)
    for name in ("Contact forces", "Friction", "Gravity"):
        tab.get_by_label(name).uncheck()

    now.slide(3)
    tab.get_by_role("tab", name="Disrupt").click()
    before = now.picture()
    now.choose("A click will", str(ClickMode.MISSING))
    now.until(lambda: model.tool is ClickMode.MISSING, "the tool is chosen")
    assert model.state[top] == REMOVED  # what is not there yet is hinted at and can be clicked
    now.picture()
    now.click(top)
    now.until(lambda: model.disruption.missing == {top}, "the part is marked")
    tab.get_by_text(f"Marked missing: {assembly.names[top]}").wait_for()
    marked = now.picture(lambda seen: (np.abs(seen - before).max(axis=2) > 25).sum() > 50)

    tab.get_by_role("button", name="Replan").click()
    tab.get_by_text("decided by").wait_for(timeout=1000 * PATIENCE)
    assert model.plan is not None
    assert model.plan.missing == (top,)
    now.until(lambda: model.disruption.empty, "the marks are in the plan")
    tab.get_by_text(f"step 3 of {len(model.timeline)}").wait_for()  # what is built stays, and its numbers go on
    tab.get_by_text(f"{assembly.names[top]} is needed at step").wait_for()
    now.slide(len(model.timeline))
    now.picture(lambda seen: (np.abs(seen - marked).max(axis=2) > 40).sum() > 500)

    tab.get_by_role("button", name="Back to the previous plan").click()
    now.until(lambda: len(model.timeline) == steps, "the old plan is back")
    assert complaints_of(now) == []

    said = "getComputedStyle(document.body, '::before').content"
    assert "server has stopped" not in tab.evaluate(said)
    now.page.close()
    now.until(lambda: "server has stopped" in tab.evaluate(said), "the page says that the server has stopped")


def test_an_unstable_state(opened: Callable[..., Open]) -> None:
    """A thin arch cannot stand: the page shows how it would fall, and that there is no plan."""
    from falsework import load_structure
    from falsework.assembly import complete_state

    thin = load_structure("arch:blocks=11,thickness=0.06")
    model = ViewerState(Timeline.from_state(thin, complete_state(thin.boundary)))
    now = opened(model, shadows=True)
    now.tab.get_by_text("would move").wait_for()
    moving = now.picture()  # without being asked for
    now.tab.get_by_role("checkbox", name="Motion").uncheck()
    now.picture(lambda seen: near(moving, "#00c08b", 40) > near(seen, "#00c08b", 40) + 100)
    for label in ("Step", "Order", "Steps per second", "Arms", "Presses", "Contact forces", "Section leaves"):
        assert now.tab.get_by_text(label, exact=True).count() == 0, label  # it would do nothing here
    now.tab.get_by_role("tab", name="Disrupt").click()
    now.tab.get_by_role("button", name="Find a plan").click()
    now.tab.get_by_text("there is no plan").wait_for()
    assert complaints_of(now) == []


def test_playing_probabilities_and_the_graph(opened: Callable[..., Open], arch: Any, policy: Any) -> None:
    from falsework import Direction, StateGraph

    assembly, plan = arch
    graph = StateGraph.from_states(make_task(assembly), plan.states, name=assembly.name)
    model = ViewerState(
        Timeline.from_plan(plan, assembly, Direction.DISASSEMBLY), plan=plan, policy=policy, graph=graph
    )
    now = opened(model)
    now.tab.get_by_text("probability of the action on a part").wait_for()
    coloured = now.picture()
    now.tab.get_by_label("Probabilities of the policy").uncheck()
    now.until(lambda: not model.show_probabilities, "probabilities are off")
    now.picture(lambda seen: (np.abs(seen - coloured).max(axis=2) > 25).sum() > 100)
    now.page.play.speed.value = 8.0
    now.tab.get_by_role("button", name="Play").click()
    now.until(lambda: model.position == 0, "the plan is played to its end")
    now.tab.get_by_text(f"step 1 of {len(plan)}").wait_for()
    now.tab.get_by_role("tab", name="Graph").click()
    now.tab.get_by_text(f"{len(graph)} states").wait_for()
    now.until(lambda: now.tab.locator("img").count() > 0, "the picture of the graph")
    now.tab.get_by_role("button", name="Coverage by the policy").click()
    now.tab.get_by_text(f"of {len(graph)} states (").wait_for()
    assert complaints_of(now) == []


def test_steps_are_found_and_gone_to(opened: Callable[..., Open], arch: Any) -> None:
    """Search in the list of steps, click a step, and use the arrow keys."""
    assembly, plan = arch
    now = opened(ViewerState(Timeline.from_plan(plan, assembly), plan=plan))
    tab = now.tab
    tab.get_by_role("tab", name="Steps").click()
    rows = tab.locator("tr[id^=falsework-step-]")
    search = tab.locator("input.mantine-TextInput-input:visible").last  # the address of the server may be another
    now.until(lambda: rows.count() == len(plan), "all steps are listed")
    step = plan.steps[5]
    search.fill(step.words)
    now.until(lambda: rows.count() == 1, "one step is found")
    rows.first.locator("a").click()
    now.until(lambda: now.model.position == 6, "the step that was clicked")
    assert tab.url.rstrip("/") == now.page.address  # the page has not been left
    search.fill("nothing of this kind")
    tab.get_by_text("no step matches").wait_for()
    tab.mouse.click(100, 450)
    tab.keyboard.press("ArrowRight")
    now.until(lambda: now.model.position == 7, "the arrow key goes on")
    tab.keyboard.press("ArrowLeft")
    tab.keyboard.press("ArrowLeft")
    now.until(lambda: now.model.position == 5, "the arrow key goes back")

    def camera() -> NDArray[np.float64]:
        return np.asarray(next(iter(now.page.server.get_clients().values())).camera.position)

    def rests() -> bool:
        before = camera()
        time.sleep(0.3)
        return np.array_equal(before, camera())

    now.until(rests, "what the arrow keys turned has come to rest")
    before = camera()
    tab.keyboard.press("N", delay=300)
    now.until(lambda: now.model.position == 6, "N goes on")
    tab.keyboard.press("P", delay=300)
    now.until(lambda: now.model.position == 5, "P goes back")
    np.testing.assert_allclose(camera(), before)  # the view stays
    assert complaints_of(now) == []


@pytest.mark.slow
def test_files_come_and_go(opened: Callable[..., Open], arch: Any, tmp_path: Path) -> None:
    """Download the plan, the page and a screenshot, and open a plan and a structure."""
    import falsework as fw

    assembly, plan = arch
    now = opened(ViewerState(Timeline.from_plan(plan, assembly), plan=plan))
    tab = now.tab

    def download(button: str, name: str) -> Path:
        with tab.expect_download(timeout=1000 * PATIENCE) as loaded:
            tab.get_by_role("button", name=button).click()
        assert loaded.value.suggested_filename == f"arch-blocks-5{name}"
        loaded.value.save_as(tmp_path / f"saved{name}")
        return tmp_path / f"saved{name}"

    pixels = np.asarray(pil.open(download("Screenshot", ".png")).convert("RGB"))
    assert pixels.shape == (WINDOW["height"], WINDOW["width"], 3)
    assert pixels.std() > 5
    tab.get_by_role("tab", name="Files").click()
    kept = fw.load(download("Download the plan", ".json"))
    assert isinstance(kept, fw.Plan)
    np.testing.assert_array_equal(kept.states, plan.states)
    assert "__VISER_EMBED_DATA__" in download("Download as a page", ".html").read_text(encoding="utf-8")

    def upload(path: Path) -> None:
        with tab.expect_file_chooser() as chooser:
            tab.get_by_role("button", name="Open a plan or structure").click()
        chooser.value.set_files(path)

    (tmp_path / "wrong.json").write_text("{}")
    upload(tmp_path / "wrong.json")
    tab.get_by_role("tab", name="Disrupt").click()
    tab.locator("strong").filter(has_text="wrong").wait_for(timeout=1000 * PATIENCE)
    assert len(now.model.timeline) == len(plan)  # nothing is lost
    fw.export(fw.load_structure("stack:blocks=2"), tmp_path / "stack.glb")
    tab.get_by_role("tab", name="Files").click()
    upload(tmp_path / "stack.glb")
    now.until(lambda: now.model.assembly.part_count == 3, "the structure is shown")
    tab.get_by_text("falsework: stack").wait_for()
    tab.get_by_role("tab", name="Steps").wait_for(state="detached")
    tab.get_by_role("tab", name="Disrupt").click()
    tab.get_by_role("button", name="Find a plan").click()
    tab.get_by_role("tab", name="Steps").wait_for(timeout=1000 * PATIENCE)  # it has a plan now
    tab.get_by_role("tab", name="Disrupt").click()
    tab.get_by_text("decided by").wait_for()
    # The browser applies changes of controls after removals that came later in one message: those of "planning ...".
    late = "Tried to update non-existent component"
    assert [text for text in complaints_of(now) if late not in text] == []


@pytest.mark.slow
def test_a_prop_is_placed_by_a_click(opened: Callable[..., Open]) -> None:
    """It stands at once, the new plan has it as its next step, and the page goes on from there."""
    assembly, plan = planned("arch:blocks=7", ground=True)
    model = ViewerState(Timeline.from_plan(plan, assembly), plan=plan)
    place = next(p for p in range(len(plan)) if (plan.holders[p] != NO_ROBOT).sum() == 2)
    now = opened(model)
    tab = now.tab
    now.slide(place)
    tab.get_by_role("tab", name="Disrupt").click()
    now.choose("A click will", "place a prop under it")
    before = now.picture()
    part = int(np.argmax(model.state == HELD))
    now.click(part)
    now.until(lambda: model.disruption.props == {part}, "the prop is marked")
    tab.get_by_text(f"a prop under: {assembly.names[part]}").wait_for()
    tab.get_by_text("stable: contact forces balance").wait_for()
    now.picture(lambda seen: (np.abs(seen - before).max(axis=2) > 40).sum() > 100)
    tab.get_by_role("button", name="Replan").click()
    tab.get_by_text(f"insert prop-{assembly.names[part]} instead of").wait_for(timeout=1000 * PATIENCE)
    tab.get_by_text(f"step {place + 1} of").wait_for()
    now.slide(len(model.timeline))
    tab.get_by_role("button", name="Back to the previous plan").click()
    now.until(lambda: model.plan is plan, "the old plan is shown again")
    assert complaints_of(now) == []


def test_one_sees_into_a_structure(opened: Callable[..., Open], arch: Any) -> None:
    assembly, plan = arch
    now = opened(ViewerState(Timeline.from_plan(plan, assembly), plan=plan))
    now.slide(len(plan))
    whole = now.picture()
    now.choose("Section", "across z")
    now.tab.get_by_text("Section leaves").wait_for()
    now.picture(lambda seen: (np.abs(seen - whole).max(axis=2) > 40).sum() > 1000)
    now.choose("Section", "none")
    now.tab.get_by_text("Explode", exact=True).wait_for()
    now.page.look.explode.value = 1.0
    now.until(lambda: now.model.view.explode == 1.0, "the parts are moved apart")
    now.picture(lambda seen: (np.abs(seen - whole).max(axis=2) > 40).sum() > 1000)
    assert complaints_of(now) == []


def test_bars_of_the_chart_are_clicked_and_arms_hidden(
    opened: Callable[..., Open], scheduled: Any, cell: Any, arch: Any
) -> None:
    from falsework.viewer.viewable import viewable_of

    shown = viewable_of(scheduled, arch[0], cell=cell)
    now = opened(ViewerState(shown.timeline, plan=shown.plan, arms=shown.arms))
    bars = now.tab.locator("svg.falsework-gantt a")
    now.until(lambda: bars.count() > 5, "the bars are drawn")
    assert "arm 0" in (now.tab.locator("svg.falsework-gantt").text_content() or "")
    middle = bars.nth(4)
    goal = float(re.findall(r"seconds=([\d.]+)", middle.get_attribute("href") or "")[0])
    middle.click()
    now.until(lambda: abs(now.model.seconds - goal) < 0.01, "the second of the bar")
    with_arms = now.picture()
    now.tab.get_by_role("checkbox", name="Arms").uncheck()
    now.picture(lambda seen: (np.abs(with_arms - seen).max(axis=2) > 40).sum() > 1000)
    assert complaints_of(now) == []


def test_joints_and_clearance_are_plotted(opened: Callable[..., Open], scheduled: Any, cell: Any, arch: Any) -> None:
    from falsework.viewer.viewable import viewable_of

    shown = viewable_of(scheduled, arch[0], cell=cell)
    now = opened(ViewerState(shown.timeline, plan=shown.plan, arms=shown.arms))
    now.tab.get_by_role("tab", name="Plots").click()
    plots = now.tab.locator("svg.falsework-plot")
    now.until(lambda: plots.count() == 4, "position and speed of the joints of both arms")
    assert plots.first.locator("polyline").count() == len(scheduled.robots[0].joint_names)
    now.tab.get_by_role("button", name="Clearance").click()
    now.until(lambda: plots.count() == 5, "the clearance of the arms")
    link = now.tab.get_by_text("least:").first.locator("a")
    goal = float(re.findall(r"seconds=([\d.]+)", link.get_attribute("href") or "")[0])
    link.click()
    now.until(lambda: abs(now.model.seconds - goal) < 0.01, "the second of the least clearance")
    assert complaints_of(now) == []


def test_a_phone_shows_the_structure_above_the_controls(opened: Callable[..., Open], arch: Any) -> None:
    assembly, plan = arch
    model = ViewerState(Timeline.from_plan(plan, assembly), plan=plan)
    model.go_to(len(plan))
    now = opened(model, window={"width": 390, "height": 780})
    now.tab.get_by_role("tab", name="Look").wait_for()
    shape = "e => { const r = e.getBoundingClientRect(); return [r.left, r.top, r.right, r.bottom]; }"
    left, top, right, bottom = now.tab.locator('div[style*="max-height: 60%"]').first.evaluate(shape)
    assert (left, right, bottom) == (0, 390, 780)
    assert 0.5 * 780 < top < 0.65 * 780
    now.until(lambda: all(_inside(now.point_of(part, (390, 780)), top) for part in range(7)), "all parts are seen")
    assert now.tab.evaluate("document.documentElement.scrollWidth") == 390
    assert complaints_of(now) == []


def _inside(point: tuple[float, float], bottom: float) -> bool:
    return 0 < point[0] < 390 and 0 < point[1] < bottom


def test_a_file_plays_without_a_server(browser: Any, arch: Any, tmp_path: Path) -> None:
    from falsework.viewer.page.recording import save_page
    from falsework.viewer.viewable import viewable_of

    assembly, plan = arch
    save_page(viewable_of(plan, assembly), tmp_path / "plan.html")
    tab = browser.new_page()
    wrong: list[str] = []
    tab.on("pageerror", lambda error: wrong.append(str(error)))
    tab.goto((tmp_path / "plan.html").as_uri(), timeout=1000 * PATIENCE)
    tab.locator("canvas").first.wait_for(timeout=1000 * PATIENCE)
    tab.add_style_tag(content=".mantine-Notifications-root { display: none }")
    tab.locator("summary").click()
    tab.get_by_text(plan.steps[0].words, exact=True).wait_for()
    tab.locator("summary").click()
    time_box = tab.locator("input.mantine-NumberInput-input").first
    end, seen = time.monotonic() + PATIENCE, set()
    while len(seen) < 3:  # it plays
        assert time.monotonic() < end
        seen.add(time_box.input_value())
        tab.wait_for_timeout(100)
    tab.locator("button.mantine-ActionIcon-root").first.click()  # pause, so that the time stays as it is set

    def at(step: int) -> np.ndarray:
        time_box.fill(str(step))
        time_box.press("Enter")
        shots, end = [shot()], time.monotonic() + PATIENCE
        while len(shots) < 3 or changed(*shots[-2:]):  # until the picture rests
            assert time.monotonic() < end
            tab.wait_for_timeout(250)
            shots.append(shot())
        return shots[-1]

    def shot() -> np.ndarray:
        return np.asarray(pil.open(io.BytesIO(tab.screenshot())).convert("RGB")).astype(int)

    def changed(one: np.ndarray, other: np.ndarray) -> int:
        return int((np.abs(one - other).max(axis=2) > 60).sum())

    first, last = at(1), at(len(plan))
    assert changed(first, last) > 2000
    again, end = at(1), time.monotonic() + PATIENCE
    while changed(first, again) >= 500:  # going back leaves nothing of what came later
        assert time.monotonic() < end
        tab.wait_for_timeout(250)
        again = shot()
    assert [text for text in wrong if not any(word in text for word in HARMLESS)] == []
    tab.close()


def test_a_thousand_parts_are_few_draw_calls(opened: Callable[..., Open]) -> None:
    """Whatever the step, a hundredth of the nodes that a node a part would be, and little is sent anew."""
    from falsework import Direction, load_structure
    from falsework.assembly import complete_state, empty_state

    vault = load_structure("vault:parts=1000")
    order = np.argsort(-vault.mass.center[:, 2], kind="stable")
    order = order[~vault.boundary[order]]
    states = [complete_state(vault.boundary)]
    actions = []
    for part in order:  # as a plan would look, proven or not: what is measured is the page
        for action, value in ((part, 2), (part + vault.part_count, 0)):
            state = states[-1].copy()
            state[part] = value
            states.append(state)
            actions.append(int(action))
    from falsework.search.plans.steps import holders

    rows = np.array(states[::-1])
    timeline = Timeline(vault, rows, np.array(actions[::-1]), holders(rows, vault.boundary), Direction.ASSEMBLY, 1)
    np.testing.assert_array_equal(rows[0], empty_state(vault.boundary))
    now = opened(ViewerState(timeline))
    sent, seconds = [], []
    for place in (0, 1, 2, 3, 500, 501, 1200, 40, 1):
        now.model.go_to(place)
        begun = time.perf_counter()
        with now.page.server.atomic():
            sent.append(now.page.scene.show(now.model.appearance()))
        seconds.append(time.perf_counter() - begun)
        assert now.page.scene.node_count < 50
    assert max(sent[1:4]) <= 4
    assert np.median(seconds) < 0.25
    assert now.picture().std() > 1
    assert complaints_of(now) == []
    assert SIZE > 0


def test_only_this_machine_is_served_unless_told_otherwise(arch: Any) -> None:
    from falsework.viewer.web.served_page import check_host

    assert check_host("127.0.0.1") is None
    assert check_host("localhost") is None
    assert "no password" in (check_host("0.0.0.0") or "")
    with pytest.raises(InputError, match="--host"):
        check_host(" ")


def test_the_command_serves_until_interrupted(start_command: Callable[..., subprocess.Popen[str]]) -> None:
    """Standard output is for machines; the page answers on this machine; Ctrl-C is a good end."""
    process = start_command("view", "arch:blocks=3", "--json", "--port", "8198")
    assert process.stdout is not None
    about = json.loads(process.stdout.readline())
    assert about["kind"] == "structure"
    with urllib.request.urlopen(about["url"], timeout=PATIENCE) as answer:
        assert answer.status == 200
    time.sleep(0.5)  # until it waits
    process.send_signal(signal.SIGINT)
    rest, error = process.communicate()
    assert process.returncode == 0, error
    assert rest == ""
    assert error == ""


def test_in_the_background_the_command_says_how_to_end_it(start_command: Callable[..., subprocess.Popen[str]]) -> None:
    """Interrupts are meant for commands in the foreground: one that was started without them serves on."""
    process = start_command("view", "arch:blocks=3", "--port", "8199", foreground=False)
    assert process.stdout is not None
    said = process.stdout.readline()
    assert "Ctrl-C" not in said
    assert f"kill {process.pid} ends it" in said
    process.send_signal(signal.SIGINT)
    time.sleep(0.5)
    address = re.search(r"http://\S+(?=;)", said)
    assert address is not None
    with urllib.request.urlopen(address[0], timeout=PATIENCE) as answer:
        assert answer.status == 200
    process.terminate()
    process.communicate()
    assert process.returncode == -signal.SIGTERM
