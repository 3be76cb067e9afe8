"""Training runs: budget, checkpoints, logs, evaluation."""
