"""Collision-free paths and their time parameterisation."""
