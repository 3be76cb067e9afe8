"""Beam search on the CPU."""
