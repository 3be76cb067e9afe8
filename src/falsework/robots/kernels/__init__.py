"""Compiled collision checking, motion planning and numeric inverse kinematics on flat arrays."""
