"""Hammerstein-Wiener models: the model, its curves, the trackers that only it needs, separation, and results."""
