"""Margins that plans must keep, and plans whose weakest step is strongest."""
