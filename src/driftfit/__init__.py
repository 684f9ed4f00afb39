"""driftfit follows the parameters of a system while they change."""

from importlib.metadata import version

from driftfit.fleet import Fleet
from driftfit.frontier import frontier
from driftfit.hypotheses.change import Change
from driftfit.hypotheses.reduction import GPB, IMM, Beam, Decide, FirstFloor, Hybrid
from driftfit.hypotheses.sensor import Sensor
from driftfit.live import Live
from driftfit.models.arx import ARX
from driftfit.models.hammerstein_wiener import HammersteinWiener
from driftfit.models.regression import Regression
from driftfit.result import Track
from driftfit.segment import segment
from driftfit.select import grid, select
from driftfit.settings import DataWarning
from driftfit.track import track
from driftfit.trackers.adaptive_kalman import AdaptiveKalman
from driftfit.trackers.augmented_fls import AugmentedFLS
from driftfit.trackers.bank import Bank
from driftfit.trackers.extended_kalman import ExtendedKalman
from driftfit.trackers.fls import FLS
from driftfit.trackers.kalman import Kalman
from driftfit.trackers.output_error import OutputError
from driftfit.trackers.rls import RLS
from driftfit.tune import tune

__version__ = version("driftfit")
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
    "frontier",
    "grid",
    "segment",
    "select",
    "track",
    "tune",
]
