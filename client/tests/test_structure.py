"""Questions and answers over HTTP, with a service of fixed answers."""

from __future__ import annotations

import os
import unittest
from typing import Any
from unittest import mock

from falsework_client import Block, ClientError, Structure, shared_structure
from falsework_client.http import ask
from tests.arch import CUBE, FACES, arch, pair
from tests.stub_service import PLAN, PNG, StubService


class Asked(unittest.TestCase):
    def setUp(self) -> None:
        self.service = StubService()
        self.service.__enter__()
        self.addCleanup(self.service.__exit__)
        clean = mock.patch.dict(os.environ, {"FALSEWORK_URL": "", "FALSEWORK_TOKEN": "", "FALSEWORK_PYTHON": ""})
        clean.start()
        self.addCleanup(clean.stop)

    def refused(self, blocks: list[Block], *hints: str, **options: Any) -> None:
        with self.assertRaises(ClientError) as caught:
            Structure(blocks, **{"unit": "m", "url": self.service.url, **options})
        self.assertNotIn("\n", str(caught.exception))
        for hint in hints:
            self.assertIn(hint, str(caught.exception))

    def test_a_verdict(self) -> None:
        with Structure(pair(), unit="m", url=self.service.url + "/") as structure:
            verdict = structure.stability([1, 2])
        self.assertEqual((verdict.verdict, verdict.stable, verdict.moving), ("unstable", False, (0,)))
        self.assertEqual(self.service.questions("/stability"), [{"states": [[1, 2]], "explain": True}])

    def test_a_plan_with_the_state_after_each_step(self) -> None:
        plan = Structure(pair(), unit="m", url=self.service.url).plan(robots=3, missing=[0], seconds=2.5)
        (question,) = self.service.questions("/replan")
        self.assertEqual(
            question,
            {
                "state": "empty",
                "target": "complete",
                "robots": 3,
                "missing": [0],
                "fixed": [],
                "removable_only_if_clear": False,
                "deadline": 2500,
            },
        )
        self.assertTrue(plan.found)
        self.assertEqual(plan.plan, PLAN)
        self.assertEqual(
            [(step.do, step.name, step.state) for step in plan.steps],
            [("insert", "top", (2, 2)), ("release", "top", (1, 2))],
        )
        self.assertEqual([plan.state_after(count) for count in (0, 1, 2, 9)], [(0, 2), (2, 2), (1, 2), (1, 2)])

    def test_robots_that_press(self) -> None:
        steps = [
            PLAN["steps"][0],
            {**PLAN["steps"][1], "presses": [{"part": 1, "wrench": [3.0, 0.0, -4.0, 0, 0, 9.0]}]},
        ]
        answer = {
            "outcome": "found",
            "reason": "",
            "direction": "assembly",
            "moving": [],
            "plans": [{**PLAN, "steps": steps}],
            "unreserved": "the target is not stable with friction divided by 1.1",
        }
        self.service.answers["/replan"] = answer
        plan = Structure(pair(), unit="m", url=self.service.url).plan(holds={"force": 5000.0}, reserve=1.1)
        (question,) = self.service.questions("/replan")
        self.assertEqual((question["holds"], question["reserve"]), ({"force": 5000.0}, 1.1))
        words = ["insert top", "release top; robot presses base with 5 N"]
        self.assertEqual([step.words for step in plan.steps], words)
        self.assertEqual((plan.found, plan.reason), (True, "the target is not stable with friction divided by 1.1"))

    def test_taking_apart_undoes_the_last_step_first(self) -> None:
        self.service.answers["/replan"] = {**self.service.answers["/replan"], "direction": "disassembly"}
        plan = Structure(pair(), unit="m", url=self.service.url).plan("complete", "empty")
        self.assertEqual(plan.start, (1, 2))
        self.assertEqual(
            [(step.number, step.words, step.state) for step in plan.steps],
            [(2, "hold top", (2, 2)), (1, "remove top", (0, 2))],
        )

    def test_no_plan(self) -> None:
        self.service.answers["/replan"] = {"outcome": "not_found", "reason": "no", "moving": [0], "plans": []}
        plan = Structure(pair(), unit="m", url=self.service.url).plan()
        self.assertEqual((plan.found, plan.outcome, plan.reason, plan.steps), (False, "not_found", "no", ()))
        self.assertEqual(plan.state_after(1), ())

    def test_a_picture(self) -> None:
        structure = Structure(pair(), unit="m", url=self.service.url)
        self.assertEqual(structure.picture(plan=PLAN, step=1, width=300), PNG)
        self.assertEqual(
            self.service.questions("/picture"),
            [{"state": "complete", "plan": PLAN, "step": 1, "proof": False, "width": 300}],
        )

    def test_address_and_token_of_the_environment(self) -> None:
        with mock.patch.dict(os.environ, {"FALSEWORK_URL": self.service.url, "FALSEWORK_TOKEN": "secret"}):
            Structure(pair(), unit="m").stability()
        self.assertEqual({token for _, _, token in self.service.asked}, {"Bearer secret"})

    def test_a_service_of_other_blocks(self) -> None:
        top, base = pair()
        self.refused(arch(), "2 parts", "7", "'pair'")
        self.refused([top, base], "friction", "0.5", friction=0.5)
        self.refused([base, top], "support")
        self.refused([top, base], "another place", unit="mm")
        self.refused([Block([[x + 0.1, y, z + 1] for x, y, z in CUBE], FACES), base], "part 0", "another place")

    def test_what_answers_is_no_service(self) -> None:
        for content in ({"hello": "world"}, [], b"<html>"):
            self.service.answers["/structure"] = content
            self.refused(pair(), self.service.url, "no falsework service")
        self.service.status = 404
        self.refused(pair(), "404", "no falsework service")

    def test_a_refusal_is_handed_on_in_one_line(self) -> None:
        structure = Structure(pair(), unit="m", url=self.service.url)
        self.service.status = 501
        self.service.answers["/picture"] = {"error": "pictures need Pillow;\ninstall it"}
        with self.assertRaises(ClientError) as caught:
            structure.picture()
        self.assertEqual(str(caught.exception), "pictures need Pillow; install it")

    def test_proxies_of_the_network_are_not_asked_for_this_machine(self) -> None:
        with mock.patch.dict(os.environ, {"http_proxy": "http://127.0.0.1:1"}):
            self.assertEqual(ask(self.service.url + "/health")["status"], "ok")

    def test_a_shared_structure_is_the_same_for_the_same_blocks(self) -> None:
        options: dict[str, Any] = {"unit": "m", "url": self.service.url}
        first = shared_structure(pair(), **options)
        self.assertIs(shared_structure(pair(), **options), first)
        self.assertIsNot(shared_structure(pair(), **options, friction=0.6), first)


class Unreachable(unittest.TestCase):
    def test_no_service(self) -> None:
        with StubService() as service:
            structure = Structure(pair(), unit="m", url=service.url)
        for asked in (structure.stability, structure.plan, structure.picture):
            with self.assertRaises(ClientError) as caught:
                asked()
            self.assertIn(f"no service answers at {service.url}", str(caught.exception))
            self.assertIn("falsework serve", str(caught.exception))
            self.assertNotIn("\n", str(caught.exception))

    def test_no_address(self) -> None:
        for url in ("nowhere", "http://", "ftp://127.0.0.1:1", "http://127.0.0.1:99999999", "http://[::1"):
            with self.assertRaises(ClientError, msg=url):
                Structure(pair(), unit="m", url=url)
