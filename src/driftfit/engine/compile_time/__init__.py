"""Replacements of parts of Numba, with which it compiles in less time."""
