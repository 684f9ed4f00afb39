"""Structures that share a driver with larger ones give the bits that they give alone."""

import numpy as np
import pytest

from driftfit import FLS, RLS, AdaptiveKalman, AugmentedFLS, Bank, Kalman, Law, Regression, track
from driftfit.run.program import Program

TRACKERS = [
    Kalman(q=1e-3, r=0.1),
    Kalman(q=1e-3, r=0.1, p0=1.0, theta0=0.5),
    Kalman(q=1e-3, r=0.1, form="sqrt"),
    FLS(100.0),
    AdaptiveKalman(),
]


@pytest.fixture(scope="module", params=[0.0, 0.5], ids=["", "coarse"])
def record(request):
    """Regressors with an offset, one that is 0 at first, missing and wrong readings; y drifts; meters may be coarse."""
    rng = np.random.default_rng(0)
    phi = rng.standard_normal((300, 1)) + 3.0
    phi[:7] = 0.0
    y = phi[:, 0] * (1.0 + np.cumsum(0.05 * rng.standard_normal(300))) + 0.3 * rng.standard_normal(300)
    y[50:60], phi[200], y[100], y[150:] = np.nan, np.nan, 60.0, y[150:] + 5.0
    return (np.round(y / request.param) * request.param if request.param else y), phi


@pytest.mark.parametrize("tracker", TRACKERS, ids=repr)
def test_a_parameter_that_is_known_and_never_excited_changes_no_bit(tracker, record):
    y, phi = record
    alone = track(Regression(1), tracker, y, phi, gate=False)  # candidates take the decisions of one reference
    program = Program(Regression(2), tracker)
    wide = track(Regression(2), Kalman(q=0.0, r=1.0), y, np.column_stack([phi, 0.0 * phi])).record
    wide.u[:, 1] = 0.0
    found = program.run(program.tile(tracker.partly_known(1, 2)), wide)
    for name in ("y_hat", "e", "s", "ok", *tracker.outputs):
        np.testing.assert_array_equal(found[name][..., 0], alone._complete.out[name][..., 0], err_msg=name)
    for name in ("theta", "var"):
        np.testing.assert_array_equal(found[name][:, 0], alone._complete.out[name][:, 0], err_msg=name)
    assert (found["theta"][:, 1] == 0.0).all() or tracker.theta0 != 0.0


def test_trackers_whose_parameters_are_weighed_together_and_sizes_without_room_have_no_such_state():
    """A cap on the trace, or leaves of a tree, would see the parameter that is not there; of more than eight parameters
    `AdaptiveKalman` follows none alone.
    """
    together = (
        RLS(0.98),
        AugmentedFLS(1.0),
        Bank(),
        FLS(1.0, differences=2),
        Kalman(q=0.1, r=1.0, laws={"b1": Law.trend(0.1)}),
    )
    assert all(one.partly_known(1, 2) is None for one in together)
    assert AdaptiveKalman().partly_known(8, 9) is None
    assert AdaptiveKalman().partly_known(9, 10) is not None
