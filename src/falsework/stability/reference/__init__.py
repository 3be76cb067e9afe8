"""Reference solvers: conic programs solved by Clarabel."""
