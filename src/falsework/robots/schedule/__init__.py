"""Schedules of robot plans: motions of several arms at the same time."""
