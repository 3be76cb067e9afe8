"""Policies that propose the next action from any state: data, networks, training, evaluation, replanning."""
