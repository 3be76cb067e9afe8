"""Contents of COMPAS data."""
