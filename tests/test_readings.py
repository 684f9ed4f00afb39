"""Readings of every size, from what underflows to what overflows: finite or marked, and recovered afterwards."""

import pytest
from contract_table import model_of, ready
from readings import failures

from driftfit import (
    ARMAX,
    ARX,
    RLS,
    AdaptiveKalman,
    AugmentedFLS,
    Bank,
    Change,
    ExtendedKalman,
    HammersteinWiener,
    Kalman,
    OutputError,
    ParticleFilter,
    PolynomialModel,
    Sensor,
)
from driftfit.models.hammerstein_wiener.basis import Polynomial
from driftfit.run.parallel_lanes import FEWEST_LANES

SENSORS = [Sensor.nominal(0.1), Sensor.outlier(kind="additive"), Sensor.frozen(0.01)]
"""Leaves that put their own predictions into their lags: an unstable one would run away."""
LASTING = [[0.97, 0.02, 0.01], [0.5, 0.5, 0.0], [0.1, 0.0, 0.9]]
TRACKERS = {
    "Kalman": ready(Kalman), "Kalman, sqrt": ready(Kalman, form="sqrt"), "RLS": RLS(0.98),
    "AdaptiveKalman": AdaptiveKalman(), "AugmentedFLS": ready(AugmentedFLS), "Bank": Bank(),
    "ParticleFilter": ready(ParticleFilter),
    "Bank, sensors": Bank([Change(1e-4), Change(1.0, prob=0.01)], SENSORS, (None, LASTING)),
}  # fmt: skip
EVERY = PolynomialModel(na=1, nb=1, nc=1, nd=1, nf=1)
CUBIC = HammersteinWiener(1, 1, 1, input=Polynomial(3), output=Polynomial(2)).bind(1)


@pytest.mark.filterwarnings("ignore:.*fault code")
@pytest.mark.parametrize("tracker", TRACKERS.values(), ids=TRACKERS)
def test_no_reading_leaves_a_trace_that_is_not_a_number(tracker):
    model = model_of(tracker, ARX(2, 2).bind(1))
    found, count = failures(model, tracker, [0, 1, 2, 3, 4, 5, 7, 20], 130)
    assert count == 464
    assert not found


@pytest.mark.filterwarnings("ignore:.*root mean square:UserWarning")
@pytest.mark.filterwarnings("ignore:.*fault code")
@pytest.mark.parametrize(
    "tracker", [ready(Kalman), RLS(0.98), AdaptiveKalman(), ready(ExtendedKalman), ready(OutputError)], ids=repr
)
def test_no_power_of_a_reading_leaves_one_either(tracker):
    """Powers: regressors hold the reading 1e8 and its cube 1e24. At 5 the adaptive filter has not started yet."""
    values = (-1e-320, 1e-100, 1e-20, 3e4, -3e6, 1e7, 1e8, -1e10, 1e13, 1e37, -1e80, 1e308, float("nan"), float("inf"))
    found, count = failures(CUBIC, tracker, [0, 1, 2, 3, 4, 5, 7, 11, 20], 130, values)
    assert count == 252
    assert not found


PLACES = [0, 1, 3, 8, 9, 10, 11, 13, 15, 20, 27, 33, 45, 57]
STARTS = pytest.mark.xfail(reason="an input that is wild as the filters start is believed", strict=True)


@pytest.mark.parametrize(
    ("model", "tracker", "places"),
    [
        pytest.param(EVERY, RLS(0.98), PLACES, id="RLS"),
        pytest.param(EVERY, AdaptiveKalman(), [t for t in PLACES if t != 11], id="AdaptiveKalman"),
        pytest.param(EVERY, AdaptiveKalman(), [11], id="AdaptiveKalman, at its start", marks=STARTS),
        pytest.param(ARMAX(1, 1, 1, offset=True), Bank(), PLACES, id="Bank"),
    ],
)
def test_no_computed_signal_leaves_one_either(model, tracker, places):
    """A model with a memory of its own: theta that one reading spoiled computes signals, which are later regressors, so
    that without a gate a direction may be lost.
    At 8 filters have not started, and at 8 to 11 the noise is the last direction that the start of a bank waits for.
    """
    values = (1e-37, 1e-20, -3e4, -1e5, 1e7, 1e10, 1e20, -1e30, 1e37, 1e101, float("nan"))
    found, count = failures(model.bind(1), tracker, places, 170, values, at_once=FEWEST_LANES - 1, gate=True)
    assert count == 22 * len(places)
    assert not found
