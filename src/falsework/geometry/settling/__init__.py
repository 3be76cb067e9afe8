"""Settling of parts into their clearance."""
