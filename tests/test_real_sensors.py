"""Sensors of a plant: inputs that stand still, fault codes, arcs; and the adaptive smoother."""

import warnings

import numpy as np
import pytest
from naive import density

from driftfit import (
    ARX,
    IMM,
    RLS,
    AdaptiveKalman,
    Bank,
    Beam,
    Change,
    Decide,
    Kalman,
    Live,
    Regression,
    Sensor,
    select,
    track,
)
from driftfit.systems.arc_furnace import switching
from driftfit.trackers.mixture.filters import UNSURE
from lab import scenarios

T = 1500
MODEL, PLANT = Regression(3), ARX(2, 2)


def jumping(second, third, jump=750, seed=0):
    """y, u: the response to the first column jumps from 1 to 2, that to the second is 0.5."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=T)
    u = np.column_stack([x, second(rng, x), third(rng, x)])
    return np.where(np.arange(T) < jump, 1.0, 2.0) * x + 0.5 * u[:, 1] + 0.1 * rng.normal(size=T), u


def noise(rng, x):
    return rng.normal(size=T)


def level(value):
    return lambda rng, x: np.full(T, value)


def first(rng, x):
    return x


IDLE = {
    "an idle input": (noise, level(0.0), [2]),
    "the same tag twice": (noise, first, [0, 2]),
    "a constant next to an intercept": (level(50.0), level(1.0), [1, 2]),
}


@pytest.mark.parametrize("tracker", [AdaptiveKalman(), Bank()], ids=lambda one: type(one).__name__)
@pytest.mark.parametrize("case", IDLE)
def test_a_direction_without_excitation_does_not_weigh_on_the_others(case, tracker):
    second, third, unknown = IDLE[case]
    y, u = jumping(second, third)
    names = ", ".join(f"theta{i + 1}" for i in unknown)
    with pytest.warns(UserWarning, match=f"{names} could not be learned"):
        run = track(MODEL, tracker, y, u)
    assert np.isinf(run.std[-1]).nonzero()[0].tolist() == unknown
    response = run.theta[:, 0] + (run.theta[:, 2] if unknown == [0, 2] else 0.0)
    assert abs(response[770] - 2.0) < 0.2
    assert abs(response[-1] - 2.0) < 0.05
    assert 0.09 < np.median(run.innovation_std[-500:]) < 0.14
    for found in (run, track(run.model, RLS(1.0), run.y, run.u)):
        assert f"{names}: never varied separately from the others" in str(found.summary())
    path = run.smooth()
    assert np.isinf(path.std[-1]).nonzero()[0].tolist() == unknown


def test_an_idle_column_changes_nothing_and_is_taken_in_when_it_wakes_up():
    y, u = jumping(noise, level(0.0))
    u[1200:, 2] = np.random.default_rng(1).normal(size=300)
    y[1200:] += -0.7 * u[1200:, 2]
    run = track(MODEL, AdaptiveKalman(), y, u)
    moving = u.copy()
    moving[:, 2] = np.random.default_rng(2).normal(size=T)
    without = track(MODEL, AdaptiveKalman(), y, moving)
    np.testing.assert_allclose(run.theta[1190, :2], without.theta[1190, :2], atol=0.02)
    assert np.isfinite(run.std[1201:]).all()
    np.testing.assert_allclose(run.theta[1260:, 2], -0.7, atol=0.15)
    live = Live(MODEL, AdaptiveKalman())
    for t in range(T):
        live.update(y[t], u[t])
        if t == 1100:
            assert live.learning.tolist() == [True, True, False]
    assert live.learning.all()
    assert (live.theta == run.theta[-1]).all()


def test_a_conductance_that_switches_is_followed():
    arc = switching()
    u = np.column_stack([arc.u, np.random.default_rng(9).normal(size=(len(arc.u), 2))])
    errors = {}
    for tracker in (AdaptiveKalman(), RLS(0.99)):
        run = track(MODEL, tracker, arc.i, u)
        errors[type(tracker).__name__] = np.sqrt(np.mean(((run.theta[:, 0] - arc.g) * arc.u)[200:] ** 2))
    assert errors["AdaptiveKalman"] < 0.3 < errors["RLS"]


@pytest.mark.parametrize("constant", [False, True])
def test_a_regressor_at_zero_is_no_evidence_of_a_jump(constant):
    rng, t = np.random.default_rng(4), np.arange(2000)
    u, g = np.sin(np.pi * t / 25.0), np.full(2000, 0.02)  # 1e-14 where it passes zero
    for k in range(1, 2000):
        g[k] = 4.0 if abs(u[k]) > 0.7 or (g[k - 1] > 1.0 and u[k] * u[k - 1] > 0.0) else 0.02
    y = g * u + 0.05 * rng.normal(size=2000)
    run = track(Regression(1, intercept=constant), AdaptiveKalman(), y, u[:, None])
    assert np.abs(run.theta[50:]).max() < 20.0  # 1e12 if the jump may be of any size
    assert np.nanmax(np.abs(run.innovation[50:])) < 5.0


@pytest.mark.parametrize("kind", ["regression", "arx"])
def test_smoothed_bands_hold_where_the_truth_walks(kind):
    model, inside, better = {"regression": MODEL, "arx": PLANT}[kind], [], []
    for seed in range(10):
        for name in ("slow_walk", "fast_walk"):
            simulated = scenarios.simulate(name, kind, seed)
            run = track(model, AdaptiveKalman(), simulated.y, simulated.u)
            path = run.smooth()
            inside.append(np.mean(np.abs(path.theta - simulated.theta)[20:-20] < 1.96 * path.std[20:-20]))
            better.append(
                np.mean((path.theta - simulated.theta)[200:] ** 2) / np.mean((run.theta - simulated.theta)[200:] ** 2)
            )
    assert 0.92 < np.mean(inside) < 0.97
    assert np.mean(better) < 0.75


def test_a_smoothed_path_is_about_as_good_as_with_the_true_drift():
    lost, inside = [], []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        u, theta = rng.normal(size=(2000, 3)), 1.0 + np.cumsum(0.003 * rng.normal(size=(2000, 3)), axis=0)
        y = np.sum(u * theta, axis=1) + 0.3 * rng.normal(size=2000)
        path = track(MODEL, AdaptiveKalman(), y, u).smooth()
        best = track(MODEL, Kalman(q=0.003**2, r=0.09), y, u).smooth()
        lost.append(np.mean((path.theta - theta) ** 2) / np.mean((best.theta - theta) ** 2))
        inside.append(np.mean(np.abs(path.theta - theta) < 1.96 * path.std))
    assert np.mean(lost) < 1.15  # with the drift as estimated sample by sample: 1.19
    assert np.mean(inside) > 0.91


def test_bands_hold_where_the_walk_is_too_slow_to_be_observed():
    inside = []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        u, theta = rng.normal(size=(500, 3)), 1.0 + np.cumsum(0.003 * rng.normal(size=(500, 3)), axis=0)
        run = track(MODEL, AdaptiveKalman(), np.sum(u * theta, axis=1) + 0.3 * rng.normal(size=500), u)
        path = run.smooth()
        inside.append(np.mean(np.abs(path.theta - theta)[100:] < 1.96 * path.std[100:]))
    assert 0.92 < np.mean(inside) < 0.97  # with the variances of the average drift alone: 0.91
    whole = run.smooth(keep="cov")
    np.testing.assert_allclose(whole.theta, path.theta, rtol=1e-6)
    spread = np.sqrt([np.diag(whole.cov(t)) for t in range(0, 500, 50)])
    np.testing.assert_allclose(spread, path.std[::50], rtol=1e-6)


def test_a_fleet_warns_once_of_what_its_series_could_not_learn():
    y, u = jumping(noise, level(0.0))
    every = np.stack([u, u, u])
    every[1, :, 2] = np.random.default_rng(3).normal(size=T)
    with pytest.warns(UserWarning, match=r"in 2 of 3 series theta3 \(2\) could not be learned") as result:
        fleet = track(MODEL, AdaptiveKalman(), np.stack([y, y, y]), every, by="row")
    assert len(result) == 1
    assert np.isinf(fleet[0].std[-1, 2])


@pytest.mark.parametrize("unit", [1.0, 1e-9, 1e9])
def test_a_direction_enters_as_the_limit_of_wide_priors_however_weakly(unit):
    """A set-point next to an intercept moves by the smallest possible step, and much later by more."""
    x, y, u = np.random.default_rng(6).normal(size=(3, T)) * [[1.0], [0.1], [1.0]]
    set_point = np.full(T, 50.0)
    set_point[700:] += 1e-9
    set_point[1000:] += u[1000:]
    y = y + x + 0.5 * set_point + 3.0
    columns = np.column_stack([x, set_point * unit])
    run = track(Regression(2, intercept=True), AdaptiveKalman(), y, columns)
    assert np.isinf(run.std[699, 1:]).all()
    assert np.isfinite(run.std[700]).all()
    assert run.std[700, 1] * unit > 1e7  # 0.1 / 1e-9, and not what rounding leaves
    assert (np.abs(run.theta[700:1000, 0] - 1.0) < 0.1).all()
    truth = np.array([1.0, 0.5 / unit, 3.0])
    assert (np.abs(run.theta[1010:] - truth) < 5.0 * run.std[1010:]).all()
    assert np.abs(run.theta[-1] / truth - 1.0)[:2].max() < 0.05
    live = Live(Regression(2, intercept=True), AdaptiveKalman())
    for t in range(701):
        live.update(y[t], columns[t])
    exact = track(Regression(2, intercept=True), Kalman(q=0.0, r=float(live.lane()["r"]), form="sqrt"), y, columns)
    assert float(live.lane()["r"]) == pytest.approx(0.01, rel=0.15)
    wide = np.sqrt(1.0 + UNSURE / np.sqrt(float(live.lane()["count"])))  # it allows for estimated settings
    assert 0.9 < run.std[700, 1] / (wide * exact.std[700, 1]) < 1.6  # a jump may begin at that sample


LATE = Bank(changes=[Change(q=1e-4)], sensors=[Sensor.nominal(r=0.01)])


@pytest.mark.parametrize("reduce", [Beam(9), Decide(2), IMM()], ids=lambda one: type(one).__name__)
def test_a_late_direction_enters_all_hypotheses_as_it_enters_the_kalman_filter(reduce):
    """Columns that wake one after the other, the last one together with a fourth that repeats it; gaps before and
    after.
    """
    y, u = jumping(noise, noise, jump=T)
    u[:300, 1], u[:700, 2] = 0.0, 3.0 * u[:700, 0]
    u = np.column_stack([u, 2.0 * u[:, 2]])
    y = np.where(np.isin(np.arange(T), [298, 299, 301, 699]), np.nan, y)
    one, two = [Change(q=1e-4)], [Change(q=1e-4), Change(q=1e-4, prob=0.3)]
    exact = track(Regression(4), Kalman(q=1e-4, r=0.01), y, u)
    far = np.ones(T, bool)
    for changes in (one, two):
        bank = Bank(changes=changes, sensors=LATE.sensors, reduce=reduce)
        with pytest.warns(UserWarning, match="theta3, theta4 could not be learned"):
            run = track(Regression(4), bank, y, u)
        np.testing.assert_array_equal(np.isinf(run.std), np.isinf(exact.std))
        if changes is two:  # in a gap a change is added to the nominal course and does not replace it
            far = np.isin(np.arange(T) // 50, [5, 6, 7, 13, 14, 15], invert=True)
        known = np.isfinite(run.std) & far[:, None]
        np.testing.assert_allclose(run.std[known], exact.std[known], rtol=1e-6)
        assert (np.abs(run.theta - exact.theta)[known] < 1e-6).all()
        assert abs(run.loglik - exact.loglik) < (1e-6 if changes is one else 1.0)
    live = Live(Regression(4), bank)
    for t in range(800):
        live.update(y[t], u[t])
    assert (live.theta == run.theta[799]).all()
    assert live.learning.tolist() == [True, True, False, False]
    leaves = live.hypotheses.mixture()
    np.testing.assert_allclose(leaves.mean, live.theta, rtol=1e-9)
    live.reset(["theta1"], p=1.0)
    np.testing.assert_allclose(live.hypotheses.mixture().cov[0, 0], leaves.cov[0, 0] + 1.0, rtol=1e-9)


@pytest.mark.parametrize("step", [0.0, 0.5])
def test_the_density_of_a_sample_is_that_of_the_mixture(step):
    """Against sums over modes and levels in numpy, and it integrates to 1 over what the next reading may be."""
    rng = np.random.default_rng(7)
    x = rng.normal(size=(400, 3))
    y = x @ [1.0, 0.5, -0.2] + 0.1 * rng.normal(size=400)
    y[200:] += x[200:, 0]
    y[300] += 5.0
    y, first = (np.round(y / step) * step, 100) if step else (y, 20)  # the quantum is known from the 100th on
    live = Live(Regression(3), AdaptiveKalman())
    run = track(Regression(3), AdaptiveKalman(), y, x)
    for t in range(320):
        lane = {name: np.array(value) for name, value in live.lane().items()}
        live.update(y[t], x[t])
        if t < first:
            continue
        log_density = np.log(density(lane, x[t], y[t]))
        np.testing.assert_allclose(run.log_density[t], log_density, rtol=1e-4, atol=1e-4)
        if t in (110, 201, 301):
            grid = y[t] + np.sinh(np.linspace(-16.0, 16.0, 200001)) * 1e-3
            assert abs(np.trapezoid(density(lane, x[t], grid), grid) - 1.0) < 1e-3
    assert run.loglik == pytest.approx(np.nansum(run.log_density) - 0.5 * np.log(lane["F"]).sum())


@pytest.mark.parametrize("tracker", [AdaptiveKalman(), Bank()], ids=lambda one: type(one).__name__)
def test_resumed_runs_and_structures_are_judged_by_the_density_of_the_mixture(tracker):
    y, u = jumping(noise, noise)
    u[:900, 2] = 0.0
    whole = track(MODEL, tracker, y, u)
    for cut in (400, 1000):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # what the first part could not learn
            before = track(MODEL, tracker, y[:cut], u[:cut])
            rest = track(MODEL, tracker, y[cut:], u[cut:], warm_start=before)
        np.testing.assert_array_equal(rest.theta, whole.theta[cut:])
        np.testing.assert_array_equal(rest.log_density, whole.log_density[cut:])
    models = [Regression(2), Regression(2, intercept=True)]
    result = select(models, y, u[:, :2], tracker=tracker)
    runs = [track(model, tracker, y, u[:, :2]) for model in models]
    sums = [run.log_density[result.judged].sum() for run in runs]
    first = np.flatnonzero(result.judged)[0] if np.asarray(result.judged).dtype == bool else np.min(result.judged)
    learned = [total - 0.5 * run.model.n * np.log(first) for run, total in zip(runs, sums, strict=True)]
    np.testing.assert_allclose(sorted(row.loglik for row in result.rows), sorted(learned), rtol=1e-9)
    for run in runs:
        square = (run.innovation / run.innovation_std) ** 2
        gaussian = -0.5 * (np.log(2.0 * np.pi * run.innovation_std**2) + square)
        assert np.abs(gaussian - run.log_density)[result.judged].sum() > 10.0
