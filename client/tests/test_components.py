"""The two script components, run as Grasshopper runs them: inputs and outputs are global names."""

from __future__ import annotations

import os
import runpy
import sys
import tempfile
import types
import unittest
from pathlib import Path
from typing import Any
from unittest import mock

from falsework_client import grasshopper
from tests.stand_ins import GRASSHOPPER, RHINO, Circle, Component, brep_cube, mesh_cube
from tests.stub_service import PLAN, PNG, StubService

SCRIPTS = Path(__file__).resolve().parents[1] / "grasshopper"
INPUTS = {
    "falsework_stability.py": ("blocks", "supports", "friction", "density", "draw", "run"),
    "falsework_plan.py": ("blocks", "supports", "robots", "step", "friction", "density", "draw", "run"),
}
OUTPUTS = {
    "falsework_stability.py": ("stable", "verdict", "moving", "picture"),
    "falsework_plan.py": ("outcome", "steps", "placed", "held", "picture"),
}


class Components(unittest.TestCase):
    def setUp(self) -> None:
        self.service = StubService()
        self.service.__enter__()
        self.addCleanup(self.service.__exit__)
        scratch = tempfile.TemporaryDirectory()
        self.addCleanup(scratch.cleanup)
        self.top, self.base = brep_cube(up=1.0), mesh_cube()
        modules = {"Rhino": RHINO, "Rhino.Geometry": RHINO.Geometry, "Grasshopper": GRASSHOPPER}
        for patch in (
            mock.patch.dict(os.environ, {"FALSEWORK_URL": self.service.url, "FALSEWORK_TOKEN": ""}),
            mock.patch.dict(sys.modules, modules),
            mock.patch.object(tempfile, "tempdir", scratch.name),
        ):
            patch.start()
            self.addCleanup(patch.stop)
        self.messages: list[tuple[str, str]] = []

    def run_script(self, name: str, **inputs: Any) -> types.SimpleNamespace:
        component = Component()
        given = {**dict.fromkeys(INPUTS[name]), "blocks": [self.top], "supports": [self.base], "run": True, **inputs}
        names = runpy.run_path(
            str(SCRIPTS / name), {**given, "ghenv": types.SimpleNamespace(Component=component)}, "__main__"
        )
        self.messages = component.messages
        return types.SimpleNamespace(**{output: names[output] for output in OUTPUTS[name]})

    def test_the_header_of_each_script_lists_its_inputs_and_outputs(self) -> None:
        for name in INPUTS:
            words = (SCRIPTS / name).read_text(encoding="utf-8")
            found, _, rest = words.partition("Outputs:")
            self.assertEqual(tuple(self.listed(found)), INPUTS[name])
            self.assertEqual(tuple(self.listed(rest.partition('"""')[0])), OUTPUTS[name])

    def listed(self, text: str) -> list[str]:
        return [line.strip().partition(":")[0] for line in text.splitlines() if line.startswith("    ") and ":" in line]

    def test_a_verdict_with_the_blocks_that_move(self) -> None:
        found = self.run_script("falsework_stability.py", draw=True)
        self.assertIs(found.stable, False)
        self.assertEqual(found.verdict, "unstable: 1 blocks move")
        self.assertEqual(found.moving, [self.top])
        self.assertEqual(Path(found.picture).read_bytes(), PNG)
        self.assertEqual(self.messages, [])

    def test_nothing_happens_unless_it_is_run(self) -> None:
        for name in INPUTS:
            self.run_script(name, run=False)
            self.run_script(name, run=None)
        self.assertEqual(self.service.asked, [])

    def test_a_plan_and_the_slider_of_its_steps(self) -> None:
        for step, placed, held in (
            (0, [self.base], []),
            (1, [self.base], [self.top]),
            (2, [self.top, self.base], []),
            (None, [self.top, self.base], []),
            (99, [self.top, self.base], []),
            (-1, [self.base], []),
        ):
            found = self.run_script("falsework_plan.py", step=step, robots=1)
            self.assertEqual((found.outcome, found.placed, found.held), ("found", placed, held), step)
            self.assertEqual(found.steps, ["1: insert 0", "2: release 0"])
            self.assertIsNone(found.picture)
        self.assertEqual(len(self.service.questions("/replan")), 1)
        self.assertEqual(self.service.questions("/replan")[0]["robots"], 1)
        self.run_script("falsework_plan.py")
        self.assertEqual(self.service.questions("/replan")[1]["robots"], 2)

    def test_a_plan_without_a_reserve_says_why(self) -> None:
        self.service.answers["/replan"] = {**self.service.answers["/replan"], "unreserved": "it slides"}
        self.assertEqual(self.run_script("falsework_plan.py").outcome, "found, without a reserve: it slides")

    def test_pictures_of_a_step_and_of_the_plan(self) -> None:
        for step in (1, None):
            found = self.run_script("falsework_plan.py", step=step, draw=True)
            self.assertEqual(Path(found.picture).read_bytes(), PNG)
        asked = [(question["plan"], question["step"]) for question in self.service.questions("/picture")]
        self.assertEqual(asked, [(PLAN, 1), (PLAN, None)])

    def test_no_plan(self) -> None:
        self.service.answers["/replan"] = {"outcome": "not_yet", "reason": "the time is up", "moving": [], "plans": []}
        for _ in range(2):
            found = self.run_script("falsework_plan.py")
            self.assertEqual((found.outcome, found.steps), ("not_yet: the time is up", []))
        self.assertEqual(len(self.service.questions("/replan")), 2)

    def test_faults_are_one_line_on_the_component(self) -> None:
        for inputs, hint in (
            ({"blocks": []}, "no blocks"),
            ({"supports": None}, "no supports"),
            ({"blocks": [Circle()]}, "block 0 is a Circle"),
            ({"friction": -1.0}, "friction"),
        ):
            for name, output in (("falsework_stability.py", "verdict"), ("falsework_plan.py", "outcome")):
                said = getattr(self.run_script(name, **inputs), output)
                self.assertIn(hint, said)
                self.assertNotIn("\n", said)
                self.assertEqual(self.messages, [("error", said)])

    def test_the_unit_of_the_document(self) -> None:
        with mock.patch.object(RHINO.RhinoDoc.ActiveDoc, "ModelUnitSystem", "Yards"):
            self.assertIn("Yards", self.run_script("falsework_stability.py").verdict)
        with mock.patch.object(RHINO.RhinoDoc.ActiveDoc, "ModelUnitSystem", "Feet"):
            self.assertIn("another place", self.run_script("falsework_plan.py").outcome)

    def test_a_picture_that_cannot_be_written(self) -> None:
        Path(tempfile.gettempdir(), "falsework-pictures").touch()
        self.assertIn("falsework-pictures", self.run_script("falsework_stability.py", draw=True).verdict)

    def test_plans_do_not_outlive_their_structure(self) -> None:
        import gc

        from falsework_client import structure

        self.run_script("falsework_plan.py")
        self.assertGreater(len(grasshopper._plans), 0)
        structure._shared.clear()
        gc.collect()
        self.assertEqual(len(grasshopper._plans), 0)

    @unittest.skipUnless(os.environ.get("FALSEWORK_PYTHON"), "needs FALSEWORK_PYTHON, a Python that has falsework")
    def test_a_service_that_they_start_answers(self) -> None:
        del os.environ["FALSEWORK_URL"]  # put back at the end
        whole = self.run_script("falsework_stability.py")
        self.assertEqual((whole.stable, whole.verdict, whole.moving), (True, "stable", []))
        plan = self.run_script("falsework_plan.py", step=1)
        self.assertEqual((plan.outcome, plan.steps), ("found", ["1: insert 0", "2: release 0"]))
        self.assertEqual((plan.held, plan.placed), ([self.top], [self.base]))
        self.assertEqual(self.messages, [])
