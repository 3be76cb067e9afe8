"""Verdicts on CUDA GPUs: one thread block per state."""
