"""Columns that come alive late, against filters of sixty digits that begin with a prior of 1e30."""

import math
from decimal import Decimal, localcontext

import numpy as np
import pytest

from driftfit import ARX, FLS, RLS, Bank, Change, Kalman, Regression, Sensor, track

T, N, ALIVE = 45, 2, 25
LARGE = Decimal(10) ** 20


def twin(y, u, q, r, lam, first=True):
    """theta, std and log density of every sample; variances that are next to infinite are. r=None: estimated."""
    exact = np.vectorize(Decimal, otypes=[object])
    theta, P, unit = exact(np.zeros(N)), exact(np.eye(N)) * Decimal(10) ** 30, exact(np.eye(N))
    squares, count, paths = Decimal(0), 0, []
    for t, (reading, phi) in enumerate(zip(exact(y), exact(u), strict=True)):
        P = P / Decimal(lam) + (unit * Decimal(q) if t or first else 0)
        g, log_p = P @ phi, math.nan
        s, e = phi @ g + Decimal(r or 1), reading - phi @ theta
        if s < LARGE:
            far = float(e * e / s)
            if r is not None:
                log_p = -0.5 * (math.log(2.0 * math.pi * float(s)) + far)
            elif count:
                wide = math.log(math.pi * float(squares * s)) + (count + 1) * math.log1p(far / float(squares))
                log_p = math.lgamma((count + 1) / 2) - math.lgamma(count / 2) - 0.5 * wide
            squares, count = squares + e * e / s, count + 1
        theta, P = theta + g * (e / s), P - np.outer(g, g) / s
        scale = Decimal(1) if r is not None else squares / max(count, 1)
        std = [math.sqrt(x * scale) if x < LARGE else math.inf for x in P.diagonal()]
        paths.append((theta.astype(float), std, log_p))
    return (np.array(part) for part in zip(*paths, strict=True))


TRACKERS = {
    "Kalman": (Kalman(q=0.01, r=0.5), (0.01, 0.5, 1.0)), "RLS": (RLS(0.95), (0.0, None, 0.95)),
    "Kalman, sqrt": (Kalman(q=0.01, r=0.5, form="sqrt"), (0.01, 0.5, 1.0)),
    "FLS": (FLS(20.0), (0.05, None, 1.0, False)),
}  # fmt: skip


@pytest.mark.parametrize(("tracker", "numbers"), TRACKERS.values(), ids=TRACKERS)
@pytest.mark.parametrize("unit", [1.0, 1e-6])
def test_a_column_that_comes_alive_late_is_that_of_a_wide_prior(tracker, numbers, unit):
    rng = np.random.default_rng(1)
    u = rng.standard_normal((T, N))
    u[:ALIVE, 1] = 0.0
    y = u @ [1.0, -2.0] + 0.7 * rng.standard_normal(T)
    run = track(Regression(N), tracker, y, u * [1.0, unit])
    if unit != 1.0 and isinstance(tracker, Kalman | FLS):
        tracker = type(tracker)(**{**tracker.settings(), **drift(tracker, unit)})
        run = track(Regression(N), tracker, y, u * [1.0, unit])
    with localcontext() as context:
        context.prec = 60
        theta, std, log_p = twin(y, u, *numbers)
    scales = np.array([1.0, unit])
    assert np.isinf(run.std[:ALIVE, 1]).all()
    later = slice(2, None)  # the scale is known from the second sample on
    np.testing.assert_allclose(run.theta * scales, theta, rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(run.std[later] * scales, std[later], rtol=1e-9)
    np.testing.assert_allclose(run.log_density[later], log_p[later], rtol=1e-9, atol=1e-11)
    assert np.isnan(run.log_density[ALIVE])


def drift(tracker, unit):
    """The setting of the same drift where the second column is in another unit."""
    factors = np.array([1.0, unit])
    return {"q": tuple(0.01 / factors**2)} if isinstance(tracker, Kalman) else {"mu": tuple(20.0 * factors**2)}


def alive_late(unit):
    """Three columns, of which the last is 0 for 120 samples; the first gain doubles before and after that."""
    rng = np.random.default_rng(1)
    u, gain = rng.standard_normal((240, 3)), np.repeat([1.0, 2.0, 4.0], 80)
    u[:120, 2] = 0.0
    return gain * u[:, 0] + u[:, 1:] @ [0.5, -1.5] + 0.1 * rng.standard_normal(240), u * [1.0, 1.0, unit]


@pytest.mark.parametrize("unit", [1.0, 1e6])
def test_a_bank_that_forgets_takes_late_columns_as_least_squares_does(unit):
    y, u = alive_late(unit)
    bank = Bank(changes=[Change(forget=0.97)], sensors=[Sensor.nominal()])
    run, twin = track(Regression(3), bank, y, u), track(Regression(3), RLS(0.97), y, u)
    np.testing.assert_allclose(run.theta[20:], twin.theta[20:], rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(np.isinf(run.std), np.isinf(twin.std))


@pytest.mark.parametrize(("kind", "forget", "near"), [("exponential", 0.001, 0.1), ("directional", 0.1, 0.4)])
def test_a_bank_whose_jumps_forget_runs_while_a_column_is_idle(kind, forget, near):
    y, u = alive_late(1.0)
    changes = [Change(q=0.0), Change(forget=forget, kind=kind, prob=0.02)]
    run = track(Regression(3), Bank(changes=changes, sensors=[Sensor.nominal()]), y, u)
    np.testing.assert_allclose(run.theta[118, :2], [2.0, 0.5], atol=near)  # found while the last column is idle
    np.testing.assert_allclose(run.theta[-1], [4.0, 0.5, -1.5], atol=near)
    assert np.isinf(run.std[:120, 2]).all()
    assert np.isfinite(run.std[121:]).all()


@pytest.mark.parametrize("unit", [1.0, 1e-6])
@pytest.mark.parametrize("lags", ["of the record", "separate"])
def test_a_bank_of_one_change_is_that_filter_when_a_column_is_late(lags, unit):
    rng = np.random.default_rng(3)
    u, y = rng.standard_normal(90), np.zeros(90)
    u[:40] = 0.0
    for t in range(1, 90):
        y[t] = 0.7 * y[t - 1] + 2.0 * u[t - 1] + 0.5 * rng.standard_normal()
    changes = [Change(q=(0.01, 0.01 / unit**2))]
    sensors = [Sensor.nominal(r=0.5), *([Sensor.outlier(kind="additive", prob=0.0)] if lags == "separate" else [])]
    run = track(ARX(1, 1), Bank(changes=changes, sensors=sensors), y, unit * u)
    twin = track(ARX(1, 1), Kalman(q=(0.01, 0.01 / unit**2), r=0.5), y, unit * u)
    np.testing.assert_allclose(run.theta, twin.theta, rtol=1e-9)
    np.testing.assert_allclose(run.std, twin.std, rtol=1e-9)
    np.testing.assert_allclose(run.log_density, twin.log_density, rtol=1e-9)


RARE = [Change(size=0.003), Change(size=5.0, prob=0.01)]
BANKS = {
    "relative": Bank(changes=RARE),
    "exponential": Bank([Change(q=0.0), Change(forget=0.001, prob=0.02)], [Sensor.nominal()]),
    "reset": Bank([RARE[0], Change(q=4.0, prob=0.01, reset=True)], [Sensor.nominal(r=0.01)]),
    "partial": Bank([RARE[0], Change(q=4.0, prob=0.01, reset=True, which=[0])], [Sensor.nominal(r=0.01)]),
    "stabilised": Bank(
        [RARE[0], Change(forget=0.01, kind="stabilised", anchor=4.0, prob=0.01)], [Sensor.nominal(r=0.01)]
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", BANKS)
def test_banks_find_jumps_while_a_column_is_idle_or_repeats_another(kind):
    y, u = alive_late(1.0)
    run = track(Regression(3), BANKS[kind], y, u)
    np.testing.assert_allclose(run.theta[118, :2], [2.0, 0.5], atol=0.12)
    np.testing.assert_allclose(run.theta[-1], [4.0, 0.5, -1.5], atol=0.12)
    assert np.isinf(run.std[:120, 2]).all()
    assert np.isfinite(run.std[121:]).all()
    u[:, 2] = u[:, 0]
    with pytest.warns(UserWarning, match="theta1, theta3 could not be learned"):
        run = track(Regression(3), BANKS[kind], y[:120], u[:120])
    np.testing.assert_allclose(run.theta[-1], [1.0, 0.5, 1.0], atol=0.12)  # nearest to theta0 of all with sum 2
    assert np.isinf(run.std[-1]).tolist() == [True, False, True]


def test_a_cap_of_forgetting_is_that_of_each_variance_in_its_own_unit():
    """An exponential change: units of a column that comes late decide nothing."""
    y, u = alive_late(1.0)
    near, far = (
        track(Regression(3), Bank([Change(forget=0.9)], [Sensor.nominal()]), y, u * [1.0, 1.0, unit])
        for unit in (1.0, 1e-9)
    )
    np.testing.assert_allclose(far.theta * [1.0, 1.0, 1e-9], near.theta, rtol=1e-7, atol=1e-12)
