"""Grasps and reachability."""
