"""The laboratory: what shows that the library is right and fast, and is not part of it. Run as `python -m lab`."""
