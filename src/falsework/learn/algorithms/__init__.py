"""Imitation, proximal policy optimisation, search guided by a policy."""
