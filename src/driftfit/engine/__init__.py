"""The engine: compiled steps, the loops that run them, frozen settings, and compiled code kept on disk."""

from importlib.metadata import version

__version__ = version("driftfit")
"""The installed version of this library."""
