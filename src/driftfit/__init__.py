"""driftfit tracks the parameters of a system while they change."""

from driftfit.bank.bank import Bank
from driftfit.bank.change import Change
from driftfit.bank.reduction import GPB, IMM, Beam, Decide, FirstFloor, Hybrid, Resample
from driftfit.bank.results.pictures import plot_tree
from driftfit.bank.sensor import Sensor
from driftfit.checks import check_tracker
from driftfit.engine import __version__
from driftfit.engine.settings import DataWarning
from driftfit.fleets import Fleet, Outputs
from driftfit.identify.answer import identify
from driftfit.judge.segment import segment
from driftfit.judge.structures.live_selection import LiveSelection
from driftfit.judge.structures.select import grid, select
from driftfit.models.arx import ARX
from driftfit.models.base import Model
from driftfit.models.continuous.process import process_model
from driftfit.models.continuous.transfer import ContinuousTransfer
from driftfit.models.equation import Equation
from driftfit.models.hammerstein_wiener.basis import (
    BSpline,
    Chebyshev,
    Functions,
    Legendre,
    PiecewiseLinear,
    Polynomial,
    Sigmoid,
)
from driftfit.models.hammerstein_wiener.extended_kalman import ExtendedKalman
from driftfit.models.hammerstein_wiener.model import HammersteinWiener
from driftfit.models.hammerstein_wiener.output_error import OutputError
from driftfit.models.hammerstein_wiener.thresholds import DeadZone, Saturation
from driftfit.models.polynomial import ARMAX, OE, BoxJenkins, PolynomialModel
from driftfit.models.regression import Regression
from driftfit.models.state_space import StateSpace
from driftfit.readings.gate import Gate
from driftfit.results import Track
from driftfit.run.live.conformal import ConformalFactor
from driftfit.smooth.augmented import augmented
from driftfit.smooth.huber import huber
from driftfit.smooth.local_shrinkage import local_shrinkage
from driftfit.smooth.piecewise import piecewise
from driftfit.smooth.total_variation import total_variation
from driftfit.streams import Live
from driftfit.trackers.adaptive_kalman import AdaptiveKalman
from driftfit.trackers.augmented_fls import AugmentedFLS
from driftfit.trackers.base import Tracker
from driftfit.trackers.dynamic_glm import DynamicGLM
from driftfit.trackers.fls import FLS
from driftfit.trackers.instrumental import InstrumentalVariables
from driftfit.trackers.joint_kalman import JointKalman
from driftfit.trackers.kalman import Kalman
from driftfit.trackers.laws.law import Law
from driftfit.trackers.particle_filter import ParticleFilter
from driftfit.trackers.rls import RLS
from driftfit.tracking import track
from driftfit.tune.frontier import frontier
from driftfit.tune.inference import likelihood_ratio
from driftfit.tune.pool import pool
from driftfit.tune.tune import tune
from driftfit.use import prepare
from driftfit.use.blocks import diagnose_blocks, free_run
from driftfit.use.output_error import output_error
from driftfit.use.system_from_path import rational_model, static_curve

__all__ = [
    "ARMAX",
    "ARX",
    "FLS",
    "GPB",
    "IMM",
    "OE",
    "RLS",
    "AdaptiveKalman",
    "AugmentedFLS",
    "BSpline",
    "Bank",
    "Beam",
    "BoxJenkins",
    "Change",
    "Chebyshev",
    "ConformalFactor",
    "ContinuousTransfer",
    "DataWarning",
    "DeadZone",
    "Decide",
    "DynamicGLM",
    "Equation",
    "ExtendedKalman",
    "FirstFloor",
    "Fleet",
    "Functions",
    "Gate",
    "HammersteinWiener",
    "Hybrid",
    "InstrumentalVariables",
    "JointKalman",
    "Kalman",
    "Law",
    "Legendre",
    "Live",
    "LiveSelection",
    "Model",
    "OutputError",
    "Outputs",
    "ParticleFilter",
    "PiecewiseLinear",
    "Polynomial",
    "PolynomialModel",
    "Regression",
    "Resample",
    "Saturation",
    "Sensor",
    "Sigmoid",
    "StateSpace",
    "Track",
    "Tracker",
    "__version__",
    "augmented",
    "check_tracker",
    "diagnose_blocks",
    "free_run",
    "frontier",
    "grid",
    "huber",
    "identify",
    "likelihood_ratio",
    "local_shrinkage",
    "output_error",
    "piecewise",
    "plot_tree",
    "pool",
    "prepare",
    "process_model",
    "rational_model",
    "segment",
    "select",
    "static_curve",
    "total_variation",
    "track",
    "tune",
]
