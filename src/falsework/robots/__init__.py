"""Real arms: cells, collisions, motions, grasps and the plans that robots carry out."""
