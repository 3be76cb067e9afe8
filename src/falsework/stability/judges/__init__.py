"""Independent stability methods from other fields, which share no code with the solvers."""
