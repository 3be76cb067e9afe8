"""Settings of networks and training, read without torch."""
