"""Display of objects and progress outside the command line."""
