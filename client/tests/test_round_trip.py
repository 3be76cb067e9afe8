"""An arch, from its blocks to a picture of its plan, with a real falsework."""

from __future__ import annotations

import os
import struct
import tempfile
import unittest
from dataclasses import replace
from unittest import mock

from falsework_client import ClientError, Structure
from tests.arch import arch


@unittest.skipUnless(os.environ.get("FALSEWORK_PYTHON"), "needs FALSEWORK_PYTHON, a Python that has falsework")
class RoundTrip(unittest.TestCase):
    @classmethod
    def setUpClass(cls) -> None:
        cls.structure = Structure(arch(scale=1000), unit="mm", friction=0.6, density=2200, name="test arch")
        cls.addClassCleanup(cls.structure.close)

    def test_verdicts(self) -> None:
        whole = self.structure.stability()
        self.assertEqual((whole.verdict, whole.criterion, whole.proof), ("stable", "contact", "displacement"))
        without_keystone = self.structure.stability([2, 1, 1, 0, 1, 1, 2])
        self.assertFalse(without_keystone.stable)
        self.assertTrue({2, 4} <= set(without_keystone.moving))
        self.assertTrue(self.structure.stability("empty").stable)

    def test_a_plan_every_state_of_which_stands(self) -> None:
        plan = self.structure.plan(robots=2, seconds=60)
        self.assertTrue(plan.found, plan.reason)
        self.assertEqual((plan.start, plan.steps[-1].state), ((2, 0, 0, 0, 0, 0, 2), (2, 1, 1, 1, 1, 1, 2)))
        self.assertEqual({step.name for step in plan.steps}, {f"v{number}" for number in range(1, 6)})
        for step in plan.steps:
            self.assertTrue(self.structure.stability(step.state).stable)
            self.assertLessEqual(sum(value == 2 for value in step.state[1:-1]), 2)
        for shown, width in (({"frames": 3}, 3 * 200), ({"step": 2}, 200)):
            png = self.structure.picture(plan=plan.plan, width=200, **shown)
            self.assertEqual(png[:8], b"\x89PNG\r\n\x1a\n")
            self.assertEqual(struct.unpack(">I", png[16:20]), (width,))

    def test_one_robot_is_not_enough(self) -> None:
        plan = self.structure.plan(robots=1, seconds=60)
        self.assertEqual((plan.found, plan.outcome), (False, "proved_impossible"))
        self.assertTrue(plan.reason)

    def test_a_refusal(self) -> None:
        with self.assertRaises(ClientError) as caught:
            self.structure.stability([1, 1])
        self.assertIn("7 values", str(caught.exception))

    def test_a_client_of_the_service_that_runs(self) -> None:
        other = Structure(arch(), unit="m", friction=0.6, url=self.structure.url)
        self.assertTrue(other.stability().stable)
        with self.assertRaises(ClientError):
            Structure(arch(thickness=0.2), unit="m", friction=0.6, url=self.structure.url)

    def test_a_ground_instead_of_supports(self) -> None:
        legs = [replace(block, support=False) for block in arch()]
        with Structure(legs, unit="m", ground=True) as structure:
            self.assertEqual(structure.plan("complete", "empty", seconds=60).steps[-1].state, (0,) * 7 + (2,))

    def test_blocks_that_falsework_refuses(self) -> None:
        twice = [*arch(), replace(arch()[2], name="again")]
        with tempfile.TemporaryDirectory() as scratch, mock.patch.object(tempfile, "tempdir", scratch):
            with self.assertRaises(ClientError) as caught:
                Structure(twice, unit="m")
            self.assertEqual(os.listdir(scratch), [])
        self.assertTrue(str(caught.exception).startswith("the service did not start: "))
        self.assertNotIn("\n", str(caught.exception))
