"""Beam search on tensors, on one or several GPUs."""
