"""The engine: compiled steps, the loops that run them, frozen settings, and compiled code kept on disk."""
