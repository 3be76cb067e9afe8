"""Tasks, states, guides and results of a search."""
