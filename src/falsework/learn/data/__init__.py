"""Training states, goals and held-out sets."""
