"""Margins of states: how far friction, tilt, loads and pushes are from where a state stops standing."""
