"""Tuning: the right numbers on simulated truths, units that do not matter, bounds that are reported, bad input."""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import pytest
from support import arx_record

from driftfit import ARX, FLS, RLS, AdaptiveKalman, AugmentedFLS, Kalman, Regression, Tracker, frontier, track, tune
from driftfit.models.base import Implicit
from driftfit.models.regression import Regression as Base
from driftfit.systems.drift import RandomWalk, paths
from driftfit.systems.time_varying import EXAMPLES, example
from driftfit.tune.parametrisation import Knobs
from driftfit.tune.search import Counted, Search


@dataclass(frozen=True)
class Own(Tracker):
    """A tracker of a user, which always has a prior."""

    q: Any = None
    r: float | None = None
    p0: float = 1.0

    required: ClassVar[tuple[str, ...]] = ("q", "r")

    def state(self, n):
        return Kalman(self.q, self.r, p0=1.0).state(n) | {"P": np.asarray(self.p0, float) * np.eye(n)}

    @property
    def steps(self):
        return Kalman(self.q, self.r, p0=1.0).steps


def walks(seed, std=(0.1, 0.1), noise=0.5, T=200):
    """Random walks observed through white regressors."""
    rng = np.random.default_rng(seed)
    theta = paths([RandomWalk(0.0, s) for s in std], T, rng)
    u = rng.normal(size=(T, len(std)))
    return np.sum(u * theta, axis=1) + noise * rng.normal(size=T), u


def test_ml_is_consistent_and_its_intervals_cover():
    """95 % intervals of 30 records: at least 24 cover with probability 0.999 if the level is right."""
    true = {"mu": 25.0, "r": 0.25, "q[theta1]": 0.01}
    found, covered = [], dict.fromkeys(true, 0)
    for seed in range(30):
        y, u = walks(seed)
        fls = tune(Regression(2), FLS(), y, u)
        kalman = tune(Regression(2), Kalman(), y, u)
        found.append(fls.tracker.mu)
        for name, value in true.items():
            low, high = (fls.interval | kalman.interval)[name]
            covered[name] += low <= value <= high
    assert 20.0 < np.median(found) < 32.0
    assert all(24 <= count <= 30 for count in covered.values()), covered
    long = tune(Regression(2), FLS(), *walks(1, T=20_000))
    assert long.tracker.mu == pytest.approx(25.0, rel=0.1)
    low, high = long.interval["mu"]
    assert low < 25.0 < high < 1.3 * low


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_a_tracker_of_ones_own_is_tuned_in_any_unit_of_y(unit):
    """Without a diffuse start the variance of reference was 1, whatever the unit."""
    y, u = walks(0)
    expected = tune(Regression(2), Kalman(p0=unit**2), y * unit, u)
    found = tune(Regression(2), Own(p0=unit**2), y * unit, u)
    np.testing.assert_allclose(found.tracker.q, expected.tracker.q, rtol=1e-3)
    assert found.tracker.r == pytest.approx(0.25 * unit**2, rel=0.3)
    assert found.loglik == pytest.approx(expected.loglik, abs=1e-6)


def test_drift_of_each_parameter_and_zero():
    y, u = walks(3, std=(0.1, 0.0), T=2000)
    tuned = tune(Regression(2), Kalman(), y, u, groups="each")
    q = tuned.tracker.q
    logs = [track(Regression(2), Kalman(q=[0.01 * np.exp(h), 0.0], r=0.25), y, u).loglik for h in (-0.1, 0.0, 0.1)]
    error = 0.1 / np.sqrt(2.0 * logs[1] - logs[0] - logs[2])  # of log q, from the curvature at the truth
    assert error < 0.15
    assert abs(np.log(q[0] / 0.01)) < 3.3 * error
    assert q[1] < 1e-5
    low, high = tuned.interval["q[theta2]/r"]
    assert low == 0.0
    assert high < 1e-3
    together = tune(Regression(2), Kalman(), y, u, groups=["a", "a"])
    assert together.loglik < tuned.loglik - 10.0
    records = (walks(seed, (0.0, 0.0)) for seed in range(20))  # about half of them look as if nothing drifted
    zero = next(found for found in (tune(Regression(2), Kalman(), *r) for r in records) if found.at_bound)
    assert zero.at_bound == ("q[theta1]/r", "q[theta2]/r")  # a result: no warning
    assert zero.tracker.q == (0.0, 0.0)
    assert zero.interval["q[theta1]/r"][0] == 0.0


def test_likelihood_is_that_of_the_run():
    y, u = walks(5)
    tuned = tune(Regression(2), Kalman(), y, u)
    assert tuned.loglik == pytest.approx(track(Regression(2), tuned.tracker, y, u).loglik, abs=1e-8)
    assert tuned.noise == pytest.approx(tuned.tracker.r)
    for factor in (0.9, 1.1):
        other = Kalman(q=np.multiply(tuned.tracker.q, factor), r=tuned.tracker.r)
        assert track(Regression(2), other, y, u).loglik < tuned.loglik
    quick = tune(Regression(2), Kalman(), y, u, intervals=False)
    assert quick.tracker == tuned.tracker
    assert np.isnan([*quick.interval.values()]).all()
    fls = tune(Regression(2), FLS(), y, u)
    smooth = track(Regression(2), fls.tracker, y, u).smooth()
    assert fls.noise == pytest.approx(smooth.cost / (len(y) - 2), rel=1e-9)
    one = tune(Regression(2), Kalman(q=tuned.tracker.q), y, u)
    assert one.tracker.r == pytest.approx(tuned.tracker.r, rel=0.02)
    both = tune(Regression(2), Kalman(p0=10.0), y, u)
    assert both.tracker.r == pytest.approx(tuned.tracker.r, rel=0.1)


def test_likelihood_of_fls_is_the_diffuse_one_of_the_stacked_system():
    """log|R| - sum log|D| and J of the normal equations, written out."""
    y, u = walks(8, T=25)
    tuned = tune(Regression(2), FLS(), y, u, bounds=(0.5, 2e3))
    mu, L, n = tuned.table["mu"][0], 25, 2
    R = np.kron(np.diff(np.eye(L), axis=0).T @ np.diff(np.eye(L), axis=0) * mu, np.eye(n))
    for k in range(L):
        R[k * n : k * n + n, k * n : k * n + n] += np.outer(u[k], u[k])
    b = (u * y[:, None]).ravel()
    sigma2 = (y @ y - b @ np.linalg.solve(R, b)) / (L - n)
    logs = np.linalg.slogdet(R)[1] - (L - 1) * n * np.log(mu)
    best = tuned.table["loglik"][0]
    assert best == pytest.approx(-0.5 * ((L - n) * (np.log(2 * np.pi * sigma2) + 1) + logs), abs=1e-9)


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_units_do_not_matter(scale):
    y, u = walks(2)
    inputs = scale ** np.array([1.0, 0.5])  # each regressor in a unit of its own
    for tracker, options in (
        (Kalman(), {}),
        (Kalman(), {"groups": "each"}),
        (RLS(), {}),
        (Kalman(), {"method": "h-step"}),
    ):
        a = tune(Regression(2), tracker, y, u, **options)
        b = tune(Regression(2), tracker, scale * y, u * inputs, **options)
        if isinstance(tracker, RLS):
            assert b.tracker.forgetting == pytest.approx(a.tracker.forgetting, rel=1e-6)
            continue
        q = np.array(a.tracker.q) * (scale / inputs) ** 2
        np.testing.assert_allclose(b.tracker.q, q, rtol=1e-3)
        assert b.tracker.r == pytest.approx(scale**2 * a.tracker.r, rel=1e-3)
    for method in ("ml", "loo", "gcv", "h-step"):
        a = tune(Regression(2), FLS(), y, u, method=method)
        b = tune(Regression(2), FLS(), scale * y, scale * u, method=method)
        assert b.tracker.mu == pytest.approx(scale**2 * a.tracker.mu, rel=1e-3)


REFERENCE = {
    ("sinusoids", "ml"): 0.116, ("sinusoids", "loo"): 0.116, ("rational", "ml"): 0.141, ("rational", "gcv"): 0.190,
    ("switching", "ml"): 0.062, ("switching", "loo"): 0.061, ("exp-ar", "ml"): 0.077, ("exp-ar", "loo"): 0.079,
}  # fmt: skip


@pytest.mark.filterwarnings("ignore:tune:UserWarning")
@pytest.mark.parametrize(("name", "method"), REFERENCE)
def test_selectors_on_the_examples(name, method):
    """Median parameter error of the smoothed path. The third to the fourteenth of sixteen errors contain the median of
    all records, which is the reference's, with probability 1 - 2 (1 + 16 + 120) / 2^16 = .996."""
    assert name in EXAMPLES
    errors = []
    for s in range(16):
        d = example(name, s)
        tuned = tune(d.model, FLS(), d.y, d.u, method=method)
        path = track(d.model, tuned.tracker, d.y, d.u).smooth()
        errors.append(np.sqrt(np.mean((path.theta - d.theta) ** 2)))
    low, high = np.sort(errors)[[2, -3]]
    assert low < REFERENCE[name, method] < high


def test_loo_and_gcv_of_the_choice():
    """Both criteria from their definitions, with every sample left out by hand."""
    y, u = walks(4, T=40)
    tuned = tune(Regression(2), FLS(), y, u, method="loo")
    run = track(Regression(2), tuned.tracker, y, u)
    left = []
    for k in range(40):
        hole = y.copy()
        hole[k] = np.nan
        left.append(y[k] - u[k] @ track(Regression(2), tuned.tracker, hole, u).smooth().theta[k])
    best = tuned.table["loo"][0]
    assert np.mean(np.square(left)) == pytest.approx(best, rel=1e-8)
    path = run.smooth()
    gcv = np.mean(path.residual**2) / (1.0 - path.leverage.mean()) ** 2
    table = tune(Regression(2), FLS(), *walks(4, T=40), method="gcv").table
    assert table["gcv"][0] <= gcv * (1.0 + 1e-12)


def test_h_step_is_the_forecast_error():
    y, u = walks(6)
    tuned = tune(Regression(2), AugmentedFLS(), y, u, method="h-step", h=3)
    run = track(Regression(2), tuned.tracker, y, u)
    error = y[3:] - np.sum(u[3:] * run.theta[:-3], axis=1)
    start = min(max(50, 10), len(y) // 3)
    assert tuned.table["mean_square"][0] == pytest.approx(np.mean(error[start - 3 :] ** 2), rel=1e-12)
    assert np.isnan(tuned.loglik)
    assert all(np.isnan(tuned.interval["mu"]))


def test_a_bound_is_reported():
    y, u = walks(0)
    with pytest.warns(UserWarning, match="mu ended at a bound"):
        tuned = tune(Regression(2), FLS(), y, u, bounds=(1e2, 1e4))
    assert tuned.at_bound == ("mu",)
    assert tuned.interval["mu"][0] == 0.0
    assert tune(Regression(2), FLS(), y, u).at_bound == ()


@pytest.mark.parametrize(
    ("tracker", "bounds", "setting"),
    [
        (Kalman(q=1.0), (1e-2, 1.0), lambda t: [t.r]),
        (Kalman(r=2500.0), (0.1, 1.0), lambda t: t.q),
        (Kalman(), (1e-2, 1.0), lambda t: np.divide(t.q, t.r)),
        (Kalman(p0=100.0), (1e-2, 1.0), lambda t: np.divide(t.q, t.r)),
        (FLS(), (1e-2, 1.0), lambda t: [t.mu]),
        (RLS(), (0.01, 0.1), lambda t: [t.forgetting]),
    ],
    ids=["Kalman(q)", "Kalman(r)", "Kalman", "Kalman(p0)", "FLS", "RLS"],
)
def test_bounds_are_those_of_the_setting_itself(tracker, bounds, setting):
    """Whatever the units of y and of the inputs; the best is beyond one of the bounds, and zero is too."""
    y, u = walks(0)
    for unit in (1e2, 1e-2):
        with pytest.warns(UserWarning, match="ended at a bound"):
            found = setting(tune(Regression(2), tracker, 100.0 * y, unit * u, bounds=bounds).tracker)
        assert min(np.abs(np.array(found) / bound - 1.0).min() for bound in bounds) < 1e-6
        assert np.min(found) >= bounds[0] * (1.0 - 1e-9)
        assert np.max(found) <= bounds[1] * (1.0 + 1e-9)


@pytest.mark.filterwarnings("ignore:tune:UserWarning")
def test_intervals_of_q_and_r_cover_where_r_is_hardly_determined():
    """A random walk whose steps are five times the noise: in a third of the records the likelihood is flat down to
    r = 0, where the curvature at the best point says nothing. 40 intervals: at least 34 cover with probability .995."""
    covered = dict.fromkeys(("r", "q[theta1]", "q[theta1]/r"), 0)
    for seed in range(40):
        rng = np.random.default_rng(seed)
        y = np.cumsum(0.5 * rng.normal(size=100)) + 0.1 * rng.normal(size=100)
        tuned = tune(Regression(1), Kalman(), y, np.ones(100))
        for name, value in {"r": 0.01, "q[theta1]": 0.25, "q[theta1]/r": 25.0}.items():
            low, high = tuned.interval[name]
            covered[name] += low <= value <= high
    assert all(count >= 34 for count in covered.values()), covered


def test_memory_of_rls():
    slow, fast = (tune(Regression(2), RLS(), *walks(1, std=(s, s), T=2000)) for s in (0.01, 0.1))
    assert 0.7 < fast.tracker.forgetting < slow.tracker.forgetting < 1.0
    low, high = fast.interval["forgetting"]
    assert low < fast.tracker.forgetting < high


def test_missing_samples_weights_and_time():
    y, u = walks(7, T=400)
    y[::5] = np.nan
    y[3] = np.inf
    tuned = tune(Regression(2), FLS(), y, u)
    assert 10.0 < tuned.tracker.mu < 60.0
    weights = np.where(np.isfinite(y), 1.0, 0.0)
    filled = tune(Regression(2), FLS(), np.where(weights > 0.0, y, 1e3), u, weights=weights)
    assert filled.tracker.mu == pytest.approx(tuned.tracker.mu, rel=1e-3)
    keep = np.isfinite(y)
    gaps = tune(Regression(2), FLS(), y[keep], u[keep], time=np.flatnonzero(keep).astype(float))
    assert gaps.tracker.mu == pytest.approx(tuned.tracker.mu, rel=1e-3)


def test_order_by_needs_a_given_drift():
    """An estimated one is that of time, and was replaced by 1 in the units of theta."""
    run = track(Regression(1), AdaptiveKalman(), np.ones(20), np.arange(20.0))
    with pytest.raises(ValueError, match="estimates one in time"):
        run.smooth(order_by=np.arange(20))


def test_order_by_sorts_the_samples():
    y, u = walks(9)
    order = np.random.default_rng(0).permutation(200)
    a = tune(Regression(2), FLS(), y, u)
    b = tune(Regression(2), FLS(), y[order], u[order], order_by=np.arange(200)[order])
    assert b.tracker.mu == pytest.approx(a.tracker.mu, rel=1e-6)
    path = track(Regression(2), a.tracker, y, u).smooth()
    mixed = track(Regression(2), a.tracker, y[order], u[order]).smooth(order_by=np.arange(200.0)[order])
    np.testing.assert_allclose(mixed.theta, path.theta[order], rtol=1e-9)
    np.testing.assert_allclose(mixed.std, path.std[order], rtol=1e-9)
    assert mixed.cov(0) == pytest.approx(path.cov(int(order[0])), rel=1e-9)
    assert mixed.loo == pytest.approx(path.loo[order], rel=1e-9)
    hidden = np.arange(200.0)[order]
    hidden[0] = np.nan
    assert np.isnan(track(Regression(2), a.tracker, y[order], u[order]).smooth(order_by=hidden).theta[0]).all()


class Squared(Base, Implicit):
    """y is the square of what the regression explains: p(y) has a Jacobian that depends on y alone."""

    implicit = property(lambda self: self)

    def output_slope(self, theta, y):
        return np.where(np.isfinite(y), np.exp(-0.5), np.nan)


def test_a_model_may_add_a_jacobian():
    y, u = walks(5)
    y[10] = np.nan
    plain, squared = (tune(model, Kalman(), y, u) for model in (Regression(2), Squared(2)))
    assert squared.loglik == pytest.approx(plain.loglik - 0.5 * 197, abs=1e-6)


def test_table_and_plot():
    y, u = walks(5)
    tuned = tune(Regression(2), Kalman(), y, u, groups="each")
    table = tuned.table
    assert table.columns == ["q[theta1]/r", "q[theta2]/r", "loglik"]
    assert table["loglik"].is_sorted(descending=True)
    assert "Kalman" in repr(tuned)
    panels = tuned.plot().axes
    assert [panel.get_xlabel() for panel in panels] == ["q[theta1]/r", "q[theta2]/r"]
    for panel in panels:
        (values, criterion), chosen = panel.lines[0].get_data(), tuned.chosen[panel.get_xlabel()]
        assert criterion.max() <= tuned.loglik + 1e-6
        near = np.argmin(np.abs(np.log(values / chosen)))
        assert criterion[near] > criterion.max() - 1.0  # the curve has its top where the red line is
        assert panel.lines[1].get_xdata()[0] == chosen
    memory = tune(Regression(2), RLS(), y, u)
    (panel,) = memory.plot().axes
    assert panel.lines[1].get_xdata()[0] == pytest.approx(1.0 / (1.0 - memory.tracker.forgetting))


def test_frontier():
    """Convex and monotone on a grid, and a slope of -mu."""
    d = example("switching")
    grid = frontier(d.model, d.y, d.u)
    assert len(grid.mu) == 37
    assert (np.diff(grid.measurement) >= -1e-10).all()
    assert (np.diff(grid.dynamic) <= 1e-10).all()
    slopes = np.diff(grid.measurement) / np.diff(grid.dynamic)
    assert (np.diff(slopes) <= 1e-10 * np.abs(slopes[1:])).all()  # steeper with mu
    for mu in (1e-3, 1.0, 300.0):
        pair = frontier(d.model, d.y, d.u, mu=[mu * 1.001**0.5, mu / 1.001**0.5])
        assert np.diff(pair.measurement) / np.diff(pair.dynamic) == pytest.approx(-mu, rel=1e-3)
    assert str(grid).split()[-3:] == [f"{column[-1]:.4g}" for column in grid]
    left, right = grid.plot().axes
    np.testing.assert_array_equal(left.lines[0].get_data(), (grid.dynamic, grid.measurement))
    for line, cost in zip(right.lines, (grid.measurement, grid.dynamic), strict=True):
        np.testing.assert_array_equal(line.get_data(), (grid.mu, cost))


@pytest.mark.parametrize(
    ("tracker", "options", "message"),
    [
        (Kalman(q=1.0, r=1.0), {}, "settings left out of Kalman.*: none"),
        (AugmentedFLS(), {}, "use 'h-step'"),
        (FLS(), {"method": "aic"}, "must be one of"),
        (FLS(), {"bounds": (10.0, 1.0)}, "bounds must be"),
        (FLS(), {"bounds": (0.0, 1.0)}, "bounds must be"),
        (RLS(), {"bounds": (0.9, 1.0)}, "between 0 and 1"),
        (Kalman(), {"bounds": (1.0, 2.0), "u": walks(0)[1] * [1.0, 100.0]}, "no shared drift keeps"),
        (FLS(), {"level": 1.0}, "level must be"),
        (FLS(), {"groups": ["a"]}, "one label for each of the 2"),
        (RLS(), {"groups": "each"}, "groups belong to"),
        (AugmentedFLS(), {"groups": "each", "method": "h-step"}, "one mu for all"),
        (FLS(), {"h": 0}, "h must be"),
        (FLS(), {"order_by": np.zeros(3)}, "order_by has shape"),
        (FLS(), {"u": np.zeros((200, 2))}, "no usable sample"),
        (FLS(), {"y": np.full(200, np.nan)}, "no usable sample, because all of 200 outputs are missing"),
        (FLS(), {"u": np.full((200, 2), np.nan)}, "no usable sample, because all inputs are missing"),
    ],
)
def test_bad_input(tracker, options, message):
    y, u = walks(0)
    with pytest.raises(ValueError, match=message):
        tune(Regression(2), tracker, options.pop("y", y), options.pop("u", u), **options)


def test_frontier_refuses_a_weight_that_is_not_positive():
    y, u = walks(0)
    with pytest.raises(ValueError, match="mu must be positive"):
        frontier(Regression(2), y, u, mu=[1.0, -1.0])


def test_an_arx_model_with_lags_that_are_filled():
    rng = np.random.default_rng(0)
    u = rng.normal(size=500)
    y = np.zeros(500)
    for t in range(1, 500):
        y[t] = 0.5 * y[t - 1] + u[t - 1] + 0.1 * rng.normal()
    y[100:103] = np.nan
    tuned = tune(ARX(1, 1), Kalman(), y, u)
    assert tuned.noise == pytest.approx(0.01, rel=3.3 * np.sqrt(2.0 / 490))  # the variance of a mean of squares


def test_a_profile_stays_within_the_range_of_the_others():
    """A flat ridge leads far outside: 300 decades of q are infinite."""
    low, high = np.array([-5.0, -5.0]), np.array([5.0, 5.0])

    def valley(points):
        assert (points >= low).all()
        assert (points <= high).all()
        return 5e3 * (points[:, 1] - 300.0 * points[:, 0]) ** 2 + 0.5 * points[:, 0] ** 2

    knobs = Knobs(low, high, np.zeros(2, bool), False, None, None, ("a", "b"), np.arange(2), lambda x: x)
    f = Counted(valley)
    f(np.zeros((1, 2)))
    found = Search(f, knobs, np.zeros(2))
    assert found.ridge(0)[1] == pytest.approx(300.0, rel=1e-3)
    assert found.profile(0, 0.95)[0] < 0.0 < found.profile(0, 0.95)[1]


@pytest.mark.parametrize("T", [2, 60])
def test_a_record_without_noise_says_so(T):
    u = np.random.default_rng(0).normal(size=(T, 2))
    why = "2 outputs are known, which 2 parameters" if T == 2 else "y is 0 in all of 60 samples. Is it the right column"
    with pytest.raises(ValueError, match=f"there is no noise to tune on: {why}"):
        tune(Regression(2), Kalman(), np.zeros(T), u)


@pytest.mark.parametrize("method", ["ml", "loo"])
@pytest.mark.parametrize(("gain", "offset"), [(2.0, 1.0), (2e6, 1e6), (1.0 / 3.0, 0.1), (0.0, 7.0)])
def test_rounding_is_no_noise(method, gain, offset):
    """Of a record that is exact, only its rounding errors remain: no r is estimated from them, in any unit."""
    u = np.random.default_rng(0).normal(size=(60, 2))
    y = offset + gain * u[:, 0]
    with pytest.raises(ValueError, match="y is 7 in all of 60" if gain == 0.0 else "up to rounding, as if y had been"):
        tune(Regression(2, intercept=True), Kalman(), y, u, method=method)


def test_signals_that_are_equal_within_their_range_hold_no_code():
    y, u = arx_record(400, 1)
    y[100:120], u[100:120] = 0.0, 0.0
    y[200:220], u[200:220] = u.max(), u.max()
    track(ARX(1, 1), Kalman(q=1e-4, r=0.1), y, u)
