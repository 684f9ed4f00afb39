"""More parameters than loops are unrolled for: the same filter, the same bits in blocks, in rows and in every mode."""

from typing import NamedTuple

import numpy as np
import pytest

from driftfit import HammersteinWiener, Kalman, Live, Regression, track
from driftfit.engine.kernel import Driver
from driftfit.models.hammerstein_wiener.basis import Polynomial
from driftfit.run.parallel_lanes import FEWEST_LANES, width_of
from driftfit.run.program import WIDEST_LANES, Program
from driftfit.trackers.forms.covariance import reduce_covariance, symmetric_product

N = 27
"""Three blocks of eight, and a rest."""


@pytest.fixture(scope="module")
def record():
    rng = np.random.default_rng(2)
    u = rng.normal(size=(90, N))
    return u @ rng.normal(size=N) + 0.1 * rng.normal(size=90), u


def test_a_wide_filter_is_the_textbook_filter(record):
    y, u = record
    run = track(Regression(N), Kalman(q=1e-3, r=0.01, p0=4.0), y, u)
    theta, P = np.zeros(N), 4.0 * np.eye(N)
    for t, phi in enumerate(u):
        P += 1e-3 * np.eye(N)
        g = P @ phi
        s = phi @ g + 0.01
        theta, P = theta + g * (y[t] - phi @ theta) / s, P - np.outer(g, g) / s
        assert run.theta[t] == pytest.approx(theta, rel=1e-8, abs=1e-8)
        assert run.std[t] == pytest.approx(np.sqrt(np.diag(P)), rel=1e-8)


def test_a_stream_of_a_wide_model_has_the_bits_of_the_record(record):
    y, u = record
    tracker = Kalman(q=1e-3, r=0.01)
    run, live = track(Regression(N), tracker, y, u), Live(Regression(N), tracker)
    for t in range(len(y)):
        live.update(y[t], u[t])
        assert np.array_equal(live.theta, run.theta[t])


@Driver
def correct(work):
    s = work[0]
    for l in range(s.theta.shape[1]):
        s.total[l] = symmetric_product(s, l)
        reduce_covariance(s, 0.3, l)


@pytest.mark.parametrize("n", [11, 27])
def test_blocks_have_the_bits_of_rows(n):
    """One lane is computed in blocks; two are computed in rows, entry after entry."""
    rng = np.random.default_rng(n)
    root, found = rng.normal(size=(n, n)), []
    for L in (1, 2):
        shapes = {"theta": (n, L), "g": (n, L), "phi": (n, L), "P": (n, n, L), "total": (L,)}
        work = np.zeros(1, np.dtype([(name, np.float64, shape) for name, shape in shapes.items()]))
        work["P"] = np.where(np.tri(n, dtype=bool), root @ root.T, np.nan)[..., None]
        work["phi"] = root[0][:, None] / 3.0
        correct(work)
        found.append([work[name][0, ..., 0] for name in ("g", "P", "total")])
    for one, other in zip(*found, strict=True):
        assert np.array_equal(one, other, equal_nan=True)
    assert found[0][0] == pytest.approx(root @ root.T @ root[0] / 3.0)


K = Kalman(q=1e-3, r=0.01)


@pytest.mark.parametrize(
    ("tracker", "n", "lanes"),
    [(K, WIDEST_LANES, 32), (K, WIDEST_LANES + 1, 1), (Kalman(q=1e-3, r=0.01, form="sqrt"), 2, 1)],
)
def test_lanes_of_a_fleet_have_the_bits_of_single_runs(tracker, n, lanes):
    rng = np.random.default_rng(3)
    u, y = rng.normal(size=(FEWEST_LANES, 40, n)), rng.normal(size=(FEWEST_LANES, 40))
    y[2, 5:9], u[3, 30] = np.nan, np.nan
    assert width_of(Program(Regression(n), tracker), FEWEST_LANES) == lanes
    if lanes > 1:
        fleet = track(Regression(n), tracker, y, u, by="row")
        for k in range(FEWEST_LANES):
            run = track(Regression(n), tracker, y[k], u[k])
            for name in ("theta", "std", "innovation_std"):
                assert np.array_equal(getattr(fleet[k], name), getattr(run, name), equal_nan=True)


def test_series_of_a_model_that_takes_one_lane_at_a_time_run_one_by_one():
    model = HammersteinWiener(1, 1, input=Polynomial(2), output=Polynomial(2)).bind(1)
    assert width_of(Program(model, Kalman(q=1e-3, r=0.01)), 1000) == 1


class Held(NamedTuple):
    values: np.ndarray


@Driver
def corner(held, row):
    return held.values[row, 1]


def test_a_driver_reads_arrays_within_tuples_in_their_own_order():
    rows = np.arange(6.0).reshape(2, 3)
    assert [corner(Held(values), 1) for values in (rows, np.asfortranarray(rows), rows[::-1], rows.T)] == [4, 4, 1, 4]
