"""Equilibrium verdicts on the CPU: ADMM, interior point method and certificates, compiled by numba."""
