"""Exports of robot plans: programs for controllers, ROS 2 messages and bags, tables."""
