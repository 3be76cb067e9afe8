"""Conic programs solved by Clarabel or Gurobi."""
