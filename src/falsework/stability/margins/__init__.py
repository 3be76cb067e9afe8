"""Margins of states: how far friction, tilt, loads and pushes are from the limit of stability."""
