"""Compiled collision, path search and numeric inverse kinematics on flat arrays."""
