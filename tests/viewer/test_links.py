"""Links of the page: to a step or second, without leaving it, and only from the page itself."""

from __future__ import annotations

import http.client
import time
from dataclasses import replace

import pytest

from falsework.viewer import Timeline
from falsework.viewer.page.step_list import matching_places, step_list
from falsework.viewer.page.viewer_state import ViewerState
from falsework.viewer.web.links import link_to, target_of


def test_links_name_a_step_or_a_second() -> None:
    assert target_of("/go?step=12") == ("step", 12.0)
    assert target_of("/go?seconds=1.25") == ("seconds", 1.25)
    assert link_to("seconds", 1.25, "<b>x</b>").startswith('<a href="/go?seconds=1.25"')
    for path in ("/", "/go", "/go?step=", "/go?step=nan", "/go?step=two", "/go/?step=1", "/gone?step=1"):
        assert target_of(path) is None


def test_a_link_goes_there_and_the_page_stays(timeline: Timeline) -> None:
    pytest.importorskip("viser", reason="the page needs viser; pip install 'falsework[viewer]'")
    from falsework.viewer.page.page import Page

    page = Page(ViewerState(timeline), port=0)

    def status(**headers: str) -> int:
        link = http.client.HTTPConnection("localhost", page.port, timeout=10)
        link.request("GET", "/go?step=3", headers=headers)
        return link.getresponse().status

    try:
        assert status(**{"Sec-Fetch-Site": "cross-site"}) == 403
        assert page.model.position == 0
        assert status(**{"Sec-Fetch-Site": "same-origin"}) == 204  # at which a browser stays where it is
        end = time.monotonic() + 10
        while page.model.position != 3:
            assert time.monotonic() < end
            time.sleep(0.02)
    finally:
        page.close()


def test_the_list_of_steps_is_that_of_the_plan(timeline: Timeline) -> None:
    text = step_list(timeline, linked=True)
    for step in timeline.steps:
        assert f"/go?step={step.number}" in text
        assert step.words in text
    assert "<a " not in step_list(timeline)


def test_steps_are_found_by_part_robot_number_and_action(timeline: Timeline) -> None:
    count = len(timeline)
    assert matching_places(timeline, "") == list(range(1, count + 1))
    name = timeline.assembly.names[timeline.steps[0].part]
    found = matching_places(timeline, f"insert {name}")
    assert [timeline.steps[place - 1].words for place in found] == [f"insert {name}"]
    by = matching_places(timeline, "r2")
    assert by
    assert all(timeline.steps[place - 1].robot == 1 for place in by)
    assert matching_places(timeline, "no-such-part") == []
    named = replace(timeline, robot_names=("front", "back"))
    assert matching_places(named, "back") == by
    assert named.label(by[0]).endswith("(back)")


def test_names_in_the_list_are_text(timeline: Timeline) -> None:
    text = step_list(replace(timeline, robot_names=("<script>", "<script>")))
    assert "<script>" not in text
    assert "&lt;script&gt;" in text
