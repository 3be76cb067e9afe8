"""Robots, cells and the shapes of their links and parts."""
