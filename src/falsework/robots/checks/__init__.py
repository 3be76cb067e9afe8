"""Independent checks of robot plans: motions, grips, places, arms and schedules, by libraries of their own."""
