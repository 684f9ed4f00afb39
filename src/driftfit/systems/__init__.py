"""Simulated systems whose parameters are known at every sample, and the laws by which parameters drift.

The systems are in separate modules: ``from driftfit.systems import arc_furnace, hammerstein_wiener``.
"""

from driftfit.systems.drift import Constant, Free, Jump, Ramp, RandomWalk, SineIncrement, SineOffset, paths

__all__ = ["Constant", "Free", "Jump", "Ramp", "RandomWalk", "SineIncrement", "SineOffset", "paths"]
