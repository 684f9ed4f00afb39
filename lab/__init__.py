"""The laboratory: checks of accuracy and speed that are not part of the library. Run as `python -m lab`."""
