"""Vectorised disassembly environment on tensors."""
