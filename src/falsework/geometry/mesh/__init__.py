"""Triangle meshes: reading, repair, collision queries."""
