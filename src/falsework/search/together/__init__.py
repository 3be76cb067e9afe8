"""Moves of a task, several parts in one step included, and states in which parts wait."""
