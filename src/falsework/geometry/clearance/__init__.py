"""Collision-free translations of a part out of a structure."""
