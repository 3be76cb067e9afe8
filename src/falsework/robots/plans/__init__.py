"""Robot plans: files, independent checks, export."""
