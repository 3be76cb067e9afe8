"""Blocks are written as falsework reads them, and what makes no structure is refused in one line."""

from __future__ import annotations

import json
import tempfile
import unittest
from dataclasses import replace
from pathlib import Path
from typing import Any

from falsework_client import Block, ClientError, write_folder
from falsework_client.blocks import center_of
from tests.arch import CUBE, FACES, arch, pair


class Folder(unittest.TestCase):
    def setUp(self) -> None:
        scratch = tempfile.TemporaryDirectory()
        self.addCleanup(scratch.cleanup)
        self.folder = Path(scratch.name) / "new"

    def described(self, blocks: list[Block], **options: Any) -> Any:
        write_folder(blocks, self.folder, **options)
        return json.loads((self.folder / "assembly.json").read_text(encoding="utf-8"))

    def test_meshes_keep_every_digit(self) -> None:
        blocks = arch()
        self.described(blocks, unit="m")
        for number, block in enumerate(blocks):
            lines = (self.folder / f"{number}.obj").read_text().splitlines()
            vertices = [[float(word) for word in line.split()[1:]] for line in lines if line.startswith("v ")]
            faces = [[int(word) - 1 for word in line.split()[1:]] for line in lines if line.startswith("f ")]
            self.assertEqual(vertices, [list(vertex) for vertex in block.vertices])
            self.assertEqual(faces, [list(face) for face in block.faces])

    def test_the_description(self) -> None:
        found = self.described(pair(), unit="mm", friction=0.7, density=1900, name="two")
        self.assertEqual(
            found,
            {
                "format": "falsework.assembly/1",
                "name": "two",
                "unit": "mm",
                "parts": 2,
                "names": ["top", "base"],
                "boundary": [1],
                "friction": 0.7,
                "density": 1900,
            },
        )

    def test_numbers_that_are_not_given_are_left_to_falsework(self) -> None:
        found = self.described(pair(), unit="m")
        self.assertNotIn("friction", found)
        self.assertNotIn("density", found)

    def test_a_density_of_its_own(self) -> None:
        top, base = pair()
        found = self.described([replace(top, density=500.0), base], unit="m", density=2000)
        self.assertEqual(found["density"], [500.0, 2000])


class Refused(unittest.TestCase):
    def refuse(self, blocks: list[Block], *hints: str, **options: Any) -> None:
        with tempfile.TemporaryDirectory() as scratch, self.assertRaises(ClientError) as caught:
            write_folder(blocks, scratch, **{"unit": "m", **options})
        text = str(caught.exception)
        self.assertNotIn("\n", text)
        for hint in hints:
            self.assertIn(hint, text)

    def test_units(self) -> None:
        self.refuse(pair(), "'yd'", "mm", unit="yd")
        self.refuse(pair(), "unit", unit="")

    def test_blocks(self) -> None:
        top, base = pair()
        self.refuse([], "no blocks")
        self.refuse([top], "support")
        self.refuse([replace(top, faces=[]), base], "block 0 (top)", "no faces")
        self.refuse([Block([], [], support=True)], "block 0 has no faces")
        self.refuse([Block(CUBE, [[0, 1, 8]]), base], "[0, 1, 8]", "0 to 7")
        self.refuse([Block(CUBE, [[0, 1]]), base], "[0, 1]")
        self.refuse([Block(CUBE, [[0, 1, -1]]), base], "-1")
        self.refuse([Block([[0, 0, float("nan")]] * 3, [[0, 1, 2]]), base], "finite")
        self.refuse([Block([[0, 0]] * 3, [[0, 1, 2]]), base], "three")
        self.refuse([top, replace(base, name="top")], "'top'")

    def test_numbers(self) -> None:
        self.refuse(pair(), "friction", "-0.1", friction=-0.1)
        self.refuse(pair(), "density", "0", density=0.0)
        self.refuse(pair(), "density", density=float("inf"))
        self.refuse([replace(block, density=-1.0) for block in pair()], "block 0", "-1")

    def test_a_folder_that_cannot_be_written(self) -> None:
        with tempfile.NamedTemporaryFile() as file, self.assertRaises(ClientError) as caught:
            write_folder(pair(), file.name, unit="m")
        self.assertIn(file.name, str(caught.exception))

    def test_a_ground_takes_the_place_of_supports(self) -> None:
        with tempfile.TemporaryDirectory() as scratch:
            write_folder(pair()[:1], scratch, unit="m", ground=True)


class Center(unittest.TestCase):
    def test_of_a_cube_anywhere(self) -> None:
        moved = Block([[x + 7, y - 3, 2 * z] for x, y, z in CUBE], FACES)
        for found, right in zip(center_of(moved) or (), (7.5, -2.5, 1.0)):
            self.assertAlmostEqual(found, right)

    def test_of_a_sheet(self) -> None:
        self.assertIsNone(center_of(Block(CUBE, FACES[:1])))
