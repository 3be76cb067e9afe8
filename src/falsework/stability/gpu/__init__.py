"""Verdicts on CUDA GPUs: one thread block a state."""
