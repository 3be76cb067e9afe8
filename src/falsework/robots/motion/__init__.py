"""Collision-free paths and their timing."""
