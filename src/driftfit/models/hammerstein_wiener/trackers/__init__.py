"""Trackers of the minimal parameters of a Hammerstein-Wiener model."""
