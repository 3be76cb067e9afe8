"""Conversion of Rhino geometry, with stand-ins for its classes."""

from __future__ import annotations

import sys
import types
import unittest
from typing import Any
from unittest import mock

from falsework_client import ClientError
from falsework_client.rhino import blocks_of, mesh_of, unit_of
from tests.stand_ins import RHINO, Box, Brep, Circle, Extrusion, Face, Mesh, SubD, brep_cube, mesh_cube


class Converted(unittest.TestCase):
    def setUp(self) -> None:
        modules = mock.patch.dict(sys.modules, {"Rhino": RHINO, "Rhino.Geometry": RHINO.Geometry})
        modules.start()
        self.addCleanup(modules.stop)

    def volume(self, vertices: Any, faces: Any) -> float:
        """Of a closed mesh; positive if its faces are counter-clockwise from outside."""
        total = 0.0
        for face in faces:
            a, *others = (vertices[corner] for corner in face)
            for b, c in zip(others, others[1:]):
                total += a[0] * (b[1] * c[2] - b[2] * c[1]) + a[1] * (b[2] * c[0] - b[0] * c[2])
                total += a[2] * (b[0] * c[1] - b[1] * c[0])
        return total / 6

    def test_a_mesh_keeps_double_precision_quads_and_triangles(self) -> None:
        mesh = mesh_cube(size=0.1)
        mesh.Faces[0:1] = [Face(0, 3, 2), Face(0, 2, 1)]
        vertices, faces = mesh_of(mesh)
        self.assertEqual(sorted(map(len, faces)), [3, 3, 4, 4, 4, 4, 4])
        self.assertEqual({value for vertex in vertices for value in vertex}, {0.0, 0.1})
        self.assertAlmostEqual(self.volume(vertices, faces), 0.001)

    def test_the_meshes_of_the_faces_of_a_brep_become_one_closed_mesh(self) -> None:
        for item in (brep_cube(2.0), Extrusion(brep_cube(2.0)), Box(brep_cube(2.0)), SubD(brep_cube(2.0))):
            vertices, faces = mesh_of(item)
            self.assertEqual((len(vertices), len(faces)), (8, 6))
            self.assertAlmostEqual(self.volume(vertices, faces), 8.0)
            edges = [(a, b) for face in faces for a, b in zip(face, face[1:] + face[:1])]
            self.assertEqual(len(set(edges)), len(edges))
            self.assertEqual({(b, a) for a, b in edges}, set(edges))

    def test_corners_that_fall_together_leave_a_smaller_face_or_none(self) -> None:
        points = [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (1.0, 1.0, 0.0), (1.0, 1.0, 0.0)]
        vertices, faces = mesh_of(Mesh(points, [Face(0, 1, 2, 3), Face(1, 2, 3)]))
        self.assertEqual((len(vertices), faces), (3, [(0, 1, 2)]))

    def test_supports_come_after_the_blocks(self) -> None:
        found = blocks_of([mesh_cube(), brep_cube()], [mesh_cube()])
        self.assertEqual([block.support for block in found], [False, False, True])
        self.assertEqual(blocks_of(None, None), [])

    def test_what_is_no_solid(self) -> None:
        for item, hints in (
            (Circle(), ("block 1", "Circle", "closed mesh")),
            (None, ("block 1", "empty")),
            (Mesh([], []), ("block 1", "no faces")),
            (Brep([]), ("block 1", "no faces")),
            (Extrusion(None), ("block 1", "no faces")),
        ):
            with self.assertRaises(ClientError) as caught:
                blocks_of([mesh_cube(), item])
            for hint in hints:
                self.assertIn(hint, str(caught.exception))
        with self.assertRaises(ClientError) as caught:
            blocks_of([mesh_cube()], [Circle()])
        self.assertIn("support 0", str(caught.exception))


class Units(unittest.TestCase):
    def test_known(self) -> None:
        for system, unit in (("Millimeters", "mm"), ("Meters", "m"), ("Inches", "in")):
            self.assertEqual(unit_of(types.SimpleNamespace(ModelUnitSystem=system)), unit)

    def test_unknown(self) -> None:
        with self.assertRaises(ClientError) as caught:
            unit_of(types.SimpleNamespace(ModelUnitSystem="Yards"))
        self.assertIn("Yards", str(caught.exception))
        self.assertIn("Millimeters", str(caught.exception))
