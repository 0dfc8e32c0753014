"""Judges against labels, and other rewards."""
