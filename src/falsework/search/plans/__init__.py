"""Plans: validation, replay, files and alternatives."""
