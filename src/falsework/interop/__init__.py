"""Structures and plans for other programs: glTF, COMPAS, USD, and a table for the site."""
