"""driftfit follows the parameters of a system while they change."""

from driftfit.engine.settings import DataWarning
from driftfit.engine.version import __version__
from driftfit.fleets import Fleet
from driftfit.judge.segment import segment
from driftfit.judge.structures.select import grid, select
from driftfit.models.arx import ARX
from driftfit.models.hammerstein_wiener.model import HammersteinWiener
from driftfit.models.hammerstein_wiener.trackers.extended_kalman import ExtendedKalman
from driftfit.models.hammerstein_wiener.trackers.output_error import OutputError
from driftfit.models.regression import Regression
from driftfit.results import Track
from driftfit.streams import Live
from driftfit.trackers.adaptive_kalman import AdaptiveKalman
from driftfit.trackers.augmented_fls import AugmentedFLS
from driftfit.trackers.bank.bank import Bank
from driftfit.trackers.bank.change import Change
from driftfit.trackers.bank.reduction import GPB, IMM, Beam, Decide, FirstFloor, Hybrid
from driftfit.trackers.bank.sensor import Sensor
from driftfit.trackers.fls import FLS
from driftfit.trackers.kalman import Kalman
from driftfit.trackers.rls import RLS
from driftfit.tracking import track
from driftfit.tune.frontier import frontier
from driftfit.tune.tune import tune
from driftfit.use import prepare

__all__ = [
    "ARX",
    "FLS",
    "GPB",
    "IMM",
    "RLS",
    "AdaptiveKalman",
    "AugmentedFLS",
    "Bank",
    "Beam",
    "Change",
    "DataWarning",
    "Decide",
    "ExtendedKalman",
    "FirstFloor",
    "Fleet",
    "HammersteinWiener",
    "Hybrid",
    "Kalman",
    "Live",
    "OutputError",
    "Regression",
    "Sensor",
    "Track",
    "__version__",
    "frontier",
    "grid",
    "prepare",
    "segment",
    "select",
    "track",
    "tune",
]
