"""Imitation, policy gradients, expert iteration."""
