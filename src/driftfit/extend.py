"""The building blocks of your own trackers, models and curves; see docs/own_tracker.md and `driftfit.check_tracker`."""

from driftfit.engine.drivers import ModelSteps, TrackerSteps, diagonal, no_variance, unknown
from driftfit.engine.kernel import Array, State, Step, exp, kernel, log, nothing
from driftfit.engine.settings import Settings, numbers, one_of, vector, whole
from driftfit.models.base import Implicit, Model
from driftfit.models.hammerstein_wiener.basis import Basis
from driftfit.trackers.base import RandomWalk, Tracker
from driftfit.trackers.forms.covariance import prediction, read_drift

__all__ = [
    "Array",
    "Basis",
    "Implicit",
    "Model",
    "ModelSteps",
    "RandomWalk",
    "Settings",
    "State",
    "Step",
    "Tracker",
    "TrackerSteps",
    "diagonal",
    "exp",
    "kernel",
    "log",
    "no_variance",
    "nothing",
    "numbers",
    "one_of",
    "prediction",
    "read_drift",
    "unknown",
    "vector",
    "whole",
]
