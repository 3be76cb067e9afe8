"""Cell files, URDF and the built-in cells."""
