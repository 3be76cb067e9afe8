"""Stability under the criterion `contact`: compliant unilateral contacts with Coulomb friction and no prestress."""
