"""Keyframes: configurations of all robots in each state of a structure, and the motions between them."""
