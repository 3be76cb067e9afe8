"""Presses of robots in texts, pictures and on the page, and states of plans judged as built."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from falsework import Assembly, Direction, Plan, StabilityOracle
from falsework.stability.holds import Press
from falsework.stability.verdict import Criterion
from falsework.utils.quantity import format_quantity
from falsework.viewer import Camera, Timeline
from falsework.viewer.arrows import PRESSES, arrows_of_step
from falsework.viewer.page.disruption import ClickMode
from falsework.viewer.page.page_text import labels_of, where_text
from falsework.viewer.page.viewer_state import ViewerState
from falsework.viewer.palette import PRESS, rgb
from falsework.viewer.pictures.contact_sheet import contact_sheet, one_state
from falsework.viewer.pictures.drawing import drawing
from falsework.viewer.proof import BuildProofs, proof_of_state
from falsework.viewer.timeline import interesting
from falsework.viewer.viewable import viewable_of

WRENCH = (30.0, 0.0, -40.0, 0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def pressed(arch: tuple[Assembly, Plan], press_once: Callable[..., tuple[Plan, int, int]]) -> tuple[Plan, int, int]:
    """A plan for assembly with one press of 50 N, the place after its step, and the part."""
    return press_once(arch[1], WRENCH)


def test_forces_in_words() -> None:
    values = (0.5, 49.96, 885.4, 999.4, 999.6, 3885.0, 99940.0, 120000.0)
    words = ["0.5 N", "50 N", "885 N", "999 N", "1 kN", "3.88 kN", "99.9 kN", "120 kN"]
    assert [format_quantity(value, "force") for value in values] == words


def test_the_step_names_the_press_in_assembly_alone(
    arch: tuple[Assembly, Plan], pressed: tuple[Plan, int, int]
) -> None:
    assembly, (plan, place, part) = arch[0], pressed
    timeline = Timeline.from_plan(plan, assembly)
    words = plan.words(place)
    assert words.startswith("release ")
    assert re.search(rf"; R\d presses {assembly.names[part]} with 50 N$", words)
    assert timeline.label(place) == f"step {place} of {len(plan)}: {plan[place - 1]}"
    assert timeline.label(place).endswith(" with 50 N")
    assert not any("presses" in step.words for step in plan if step.number != place)
    apart = timeline.turned(Direction.DISASSEMBLY)
    for at in range(len(plan) + 1):
        assert "presses" not in apart.label(at)
        assert apart.presses_at(at) == ()


def test_the_arrow_ends_at_the_centre_and_has_the_way_of_the_force(
    arch: tuple[Assembly, Plan], pressed: tuple[Plan, int, int]
) -> None:
    assembly, (plan, place, part) = arch[0], pressed
    timeline = Timeline.from_plan(plan, assembly)
    ((tail, tip),) = arrows_of_step(timeline, place)[PRESSES].ends
    np.testing.assert_allclose(tip, assembly.mass.center[part], atol=1e-12)
    np.testing.assert_allclose((tip - tail) / np.linalg.norm(tip - tail), np.array(WRENCH[:3]) / 50.0)
    assert [bool(arrows_of_step(timeline, at)) for at in range(len(plan) + 1)] == [
        at == place for at in range(len(plan) + 1)
    ]
    assert arrows_of_step(timeline.turned(Direction.DISASSEMBLY), place) == {}


def test_with_other_forces_it_is_on_their_scale(arch: tuple[Assembly, Plan], pressed: tuple[Plan, int, int]) -> None:
    assembly, (plan, place, _) = arch[0], pressed
    proof = BuildProofs(plan, StabilityOracle(assembly)).at(place)
    assert proof.stable

    def longest(kind: str) -> float:
        return float(np.linalg.norm(np.diff(proof.arrows[kind].ends, axis=1), axis=2).max())

    free = plan.states[place] == 1
    weight = float(9.81 * assembly.mass.mass[free].max())
    assert longest(PRESSES) / longest("gravity") == pytest.approx(50.0 / weight, rel=1e-6)


def test_pictures_show_it(arch: tuple[Assembly, Plan], pressed: tuple[Plan, int, int]) -> None:
    """The arrow and the legend where a robot presses, neither elsewhere."""
    pytest.importorskip("PIL", reason="pictures need Pillow; pip install 'falsework[picture]'")
    timeline, place = Timeline.from_plan(pressed[0], arch[0]), pressed[1]
    camera = Camera(width=300, height=200)

    def legend_there(pixels: np.ndarray) -> bool:
        return bool((pixels == rgb(PRESS)).all(axis=2).any())

    assert legend_there(contact_sheet(timeline, [place], camera=camera))
    assert not legend_there(contact_sheet(timeline, [place - 1], camera=camera))
    arrows = list(arrows_of_step(timeline, place).values())
    plain, drawn = (one_state(timeline, place, camera, arrows=some, words="") for some in ((), arrows))
    changed = (plain != drawn).any(axis=2)
    assert 0 < changed.mean() < 0.1  # the parts are not drawn pale
    assert f'stroke="{PRESS}"' in drawing(timeline, [place])
    assert f'stroke="{PRESS}"' not in drawing(timeline, [place - 1])


def test_a_contact_sheet_prefers_places_with_presses(
    arch: tuple[Assembly, Plan], pressed: tuple[Plan, int, int]
) -> None:
    timeline, place = Timeline.from_plan(pressed[0], arch[0]), pressed[1]
    frames = next(
        frames
        for frames in range(2, len(timeline) + 1)
        if place - 1 in np.linspace(0, len(timeline), frames).round().astype(int)[1:-1]
    )
    assert place in interesting(timeline, frames)


def test_states_of_a_plan_are_judged_as_they_are_reached(
    arch: tuple[Assembly, Plan], pressed: tuple[Plan, int, int]
) -> None:
    """In any order of questions, and the forces are those of the build."""
    assembly, (plan, place, _) = arch[0], pressed
    oracle = StabilityOracle(assembly)
    shown = viewable_of(plan, assembly)
    proofs = shown.proofs(range(len(plan) + 1))
    assert all(proof.stable and proof.words.endswith("(as built)") for proof in proofs.values())
    assert PRESSES in proofs[place].arrows
    backwards = BuildProofs(plan, oracle)
    for at in (len(plan), place, 0):
        again = backwards.at(at)
        assert again.words == proofs[at].words
        assert again.forces is not None
        assert proofs[at].forces is not None
        np.testing.assert_array_equal(again.forces, proofs[at].forces)
    rest = proof_of_state(oracle, plan.states[place])
    assert rest.words.endswith("(from rest)")
    reached = proofs[place].forces
    assert rest.forces is not None
    assert reached is not None
    off = float(np.abs(rest.forces - reached).max())
    assert off > 1.0, "the press changes the forces"
    equilibrium = shown.proofs([place], "equilibrium")[place]
    assert "(" not in equilibrium.words


def test_a_build_that_ends_too_soon_is_not_called_stable(
    arch: tuple[Assembly, Plan], pressed: tuple[Plan, int, int]
) -> None:
    assembly, (plan, place, _) = arch[0], pressed
    absent = next(other for other in range(assembly.part_count) if plan.states[place, other] == 0)
    wrong = replace(plan, presses=tuple((Press(absent, WRENCH),) if some else () for some in plan.presses))
    build = BuildProofs(wrong, StabilityOracle(assembly))
    fails, later, before = (build.at(at) for at in (place, place + 1, place - 1))
    assert before.stable
    assert not fails.stable
    assert f"a robot presses {assembly.names[absent]}, which it does not hold" in fails.words
    assert fails.verdict == "slides"
    assert later.words.endswith("(from rest)")


@pytest.mark.parametrize("criterion", ["contact", "equilibrium"])
def test_the_page_says_how_a_state_was_judged(
    criterion: Criterion, arch: tuple[Assembly, Plan], pressed: tuple[Plan, int, int]
) -> None:
    assembly, (plan, place, part) = arch[0], pressed
    model = ViewerState(
        Timeline.from_plan(plan, assembly),
        plan=plan,
        criterion=criterion,
    )
    contact = criterion == "contact"
    model.go_to(place)
    text = where_text(model, ask=True)
    assert re.search(rf"R\d presses {assembly.names[part]} with 50 N", text)
    assert ("(as built)" in text) == contact
    assert labels_of(model, model.appearance())[part].endswith(" presses 50 N")
    model.tool = ClickMode.FIXED
    model.click_part(part)
    assert ("(from rest)" in where_text(model, ask=False)) == contact


def test_the_scene_of_the_page_has_the_arrow(arch: tuple[Assembly, Plan], pressed: tuple[Plan, int, int]) -> None:
    pytest.importorskip("viser", reason="the page needs viser; pip install 'falsework[viewer]'")
    from falsework.viewer.page.page import Page

    assembly, (plan, place, _) = arch[0], pressed
    page = Page(ViewerState(Timeline.from_plan(plan, assembly), plan=plan), port=0)
    try:
        page.model.go_to(place)
        page.refresh()
        assert "/arrows/presses" in page.scene.shown
        page.look.presses.value = False
        page.refresh()
        assert "/arrows/presses" not in page.scene.shown
        page.look.presses.value = True
        page.model.go_to(place - 1)
        page.refresh()
        assert "/arrows/presses" not in page.scene.shown
    finally:
        page.close()


def test_the_command_says_it(
    arch: tuple[Assembly, Plan], pressed: tuple[Plan, int, int], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("PIL", reason="pictures need Pillow; pip install 'falsework[picture]'")
    from falsework.cli.main import main
    from falsework.search.plans.plan_file import save_plan

    plan, place, part = pressed
    file = tmp_path / "plan.json"
    save_plan(replace(plan, source={"built_in": "arch:blocks=5"}), file)
    words = ["picture", str(file), "--step", str(place), "--width", "200", "--out", str(tmp_path / "p.png"), "--forces"]
    assert main(words) == 0
    said = capsys.readouterr().out
    assert re.search(rf"step {place} of .* R\d presses {arch[0].names[part]} with 50 N", said)
    assert "(as built)" in said
    assert main(["check", str(file), "--steps"]) == 0
    steps = [line for line in capsys.readouterr().out.splitlines() if " presses " in line]
    assert len(steps) == 1
    assert re.match(re.escape(plan.line(place)) + r"; R\d bears ", steps[0])


def test_the_page_names_what_robots_bear(arch: tuple[Assembly, Plan]) -> None:
    """At held parts, in both orders."""
    assembly, plan = arch
    assert any(plan.loads)
    timeline = Timeline.from_plan(plan, assembly)
    for direction in Direction:
        shown = timeline.turned(direction)
        assert [shown.loads_at(place) for place in range(len(plan) + 1)] == list(plan.loads)
