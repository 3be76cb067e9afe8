"""Robot plans: files, schedules, loads, export."""
