"""Order of the work of several robots: a shorter one for robots that move at the same time."""
