"""Replanning under a deadline: a plan from any state to any target, by policy, search or both."""
