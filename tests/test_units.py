"""Units and offsets decide nothing: estimates of records in any units are those of the scaled record in other units."""

import numpy as np
import pytest
from nist import DATA, digits

from driftfit import (
    ARX,
    FLS,
    RLS,
    AdaptiveKalman,
    AugmentedFLS,
    Bank,
    ExtendedKalman,
    HammersteinWiener,
    Kalman,
    Regression,
    huber,
    track,
    tune,
)
from driftfit.models.hammerstein_wiener.basis import Polynomial
from driftfit.models.hammerstein_wiener.output_error import OutputError

MODEL = Regression(2, intercept=True)
TRACKERS = {
    "Kalman": lambda f, fy: Kalman(q=1e-4 * (fy / f) ** 2, r=0.01 * fy**2),
    "Kalman(sqrt)": lambda f, fy: Kalman(q=1e-4 * (fy / f) ** 2, r=0.01 * fy**2, form="sqrt"),
    "RLS": lambda f, fy: RLS(0.98),
    "RLS(directional)": lambda f, fy: RLS(0.98, kind="directional"),
    "FLS": lambda f, fy: FLS(100.0 * f**2),
    "FLS(differences=2)": lambda f, fy: FLS(100.0 * f**2, differences=2),
    "AdaptiveKalman": lambda f, fy: AdaptiveKalman(),
    "Bank": lambda f, fy: Bank(),
}
UNITS = [(1e-12, 1e12, 1.0), (1e12, 1e-12, 3e-12), (7e-5, 1.3e5, 1e12), (3e-9, 7e11, 5e-3)]


def record(offset, T=200):
    rng = np.random.default_rng(5)
    at = np.array([0.0, offset])
    x = rng.standard_normal((T, 2)) + at
    theta = np.array([2.0, -1.0]) + np.cumsum(0.01 * rng.standard_normal((T, 2)), axis=0)
    return 3.0 + np.sum(theta * (x - at), axis=1) + 0.1 * rng.standard_normal(T), x


@pytest.mark.parametrize("offset", [0.0, 1e3, 1e6])
@pytest.mark.parametrize("kind", TRACKERS)
def test_estimates_do_not_depend_on_units(kind, offset):
    """Factors 1e-12 to 1e12 on every column and on y, offsets up to 1e6 standard deviations."""
    y, x = record(offset)
    size = np.array([1.0, np.hypot(1.0, offset), 1.0])
    scaled = track(MODEL, TRACKERS[kind](size, 1.0), y, x)
    spanned = np.isfinite(scaled.std)
    assert spanned[10].all()
    # an offset of m standard deviations leaves m 2^-53 of a reading: 1e-10, times what depends on it
    most = max(2e-12 * offset, 1e-11)
    for a, b, c in UNITS:
        f = np.array([a, b, 1.0])
        run = track(MODEL, TRACKERS[kind](f * size, c), c * y, x * f[:2])
        np.testing.assert_array_equal(np.isfinite(run.std), spanned)
        error = np.abs(run.theta * f / c - scaled.theta)[spanned] / scaled.std[spanned]
        assert error.max() < most
        np.testing.assert_allclose((run.std * f / c)[spanned], scaled.std[spanned], rtol=most)


@pytest.mark.parametrize(("c", "d"), [(1e-3, 1e3), (3e-5, 7e5)])
def test_trackers_with_a_prior_or_a_model_of_their_own_know_no_units_either(c, d):
    """y in units of c, inputs of d, and settings in the same units. Columns of `AugmentedFLS` share one unit, since its
    mu does. With blocks of powers b scales by c / d, c_2 by 1 / d and d_2 by 1 / c.
    """
    y, x = record(0.0)
    near = track(Regression(2), AugmentedFLS(0.5), y, x)
    run = track(Regression(2), AugmentedFLS(0.5 * d * d, theta0=1e-6 * c / d), c * y, d * x)
    np.testing.assert_allclose(run.theta * d / c, near.theta, rtol=1e-10)
    model = HammersteinWiener(1, 2, input=Polynomial(2), output=Polynomial(2))
    rng = np.random.default_rng(2)
    u, w, v = rng.uniform(-1.0, 1.0, 200), np.zeros(200), np.zeros(3)
    for t in range(2, 200):
        v = np.array([u[t - 1], u[t - 2]])
        w[t] = 0.5 * w[t - 1] + [0.5, -0.3] @ (v + 0.3 * v * v)
    y = w - 0.1 * w * w + 0.01 * rng.standard_normal(200)
    u[[50, 51]], y[[2, 120, 121]] = np.nan, [0.1, np.nan, np.nan]
    f = np.array([1.0, c / d, c / d, 1.0 / d, 1.0 / c])

    def settings(f, c):
        start = np.array([-0.48, 0.52, -0.28, 0.32, 0.12])
        return {"q": 1e-5 * f**2, "r": 1e-4 * c * c, "p0": 0.01 * f**2, "theta0": start * f}

    for kind in (ExtendedKalman, OutputError):
        more = (lambda c: {"q_w": 1e-6 * c * c, "p_w": 0.5 * c * c}) if kind is OutputError else (lambda c: {})
        near = track(model, kind(**settings(1.0 + 0.0 * f, 1.0), **more(1.0)), y, u)
        with pytest.warns(UserWarning, match="raw powers of data far from unit size"):
            run = track(model, kind(**settings(f, c), **more(c)), c * y, d * u)
        assert (np.abs(run.theta / f - near.theta) < 1e-9 * near.std).all()
        np.testing.assert_allclose(run.std / f, near.std, rtol=1e-9)
        np.testing.assert_allclose(run.prediction / c, near.prediction, rtol=1e-6, atol=1e-9)


def plain_si():
    """A valve, a pressure in Pa; a flow in m3/s; seconds since 1970; a day's number; dollars."""
    rng = np.random.default_rng(1)
    T = 1000
    v, w = rng.standard_normal((2, T))
    pa = 101325.0 + 100.0 * w
    flow = 3e-4 + 1e-5 * v
    seconds = 1.7e9 + 60.0 * np.arange(T)
    day = 738000.0 + np.arange(T)
    dollars = 4e9 + 3e7 * w
    noise = 0.1 * rng.standard_normal(T)
    return {
        "valve and pressure": (10.0 + 2.0 * v + w + noise, np.column_stack([v, pa])),
        "flow and pressure": (10.0 + v + w + noise, np.column_stack([flow, pa])),
        "seconds": (10.0 + v + 1e-4 * np.arange(T) + noise, np.column_stack([v, seconds])),
        "days": (10.0 + v + 1e-2 * np.arange(T) + noise, np.column_stack([v, day])),
        "dollars": (1e9 * (10.0 + v + w + noise), np.column_stack([v, dollars])),
    }


@pytest.mark.parametrize("name", plain_si())
def test_records_as_they_come_are_followed_as_least_squares_and_the_smoother_say(name):
    y, x = plain_si()[name]
    spread = x.std(axis=0)
    centred = np.column_stack([(x - x.mean(axis=0)) / spread, np.ones(len(y))])
    found = np.linalg.lstsq(centred, y, rcond=None)[0]
    slopes = found[:2] / spread
    constant = np.append(slopes, found[2] - slopes @ x.mean(axis=0))
    r = float(np.var(y - x @ slopes))
    for tracker in (RLS(1.0), Kalman(q=0.0, r=r), Kalman(q=0.0, r=r, form="sqrt"), FLS(np.inf)):
        run = track(MODEL, tracker, y, x)
        assert np.isfinite(run.std[5]).all()
        assert (np.abs(run.theta[-1] - constant) < 1e-6 * run.std[-1]).all()
        if not isinstance(tracker, RLS):
            assert (np.abs(run.theta[-1] - run.smooth().theta[-1]) < 1e-6 * run.std[-1]).all()


@pytest.mark.parametrize("offset", [0.0, 1e4, 1e6])
def test_the_filter_ends_where_the_smoother_does(offset):
    y, x = record(offset)
    f, size = np.array([1e-6, 1e7, 1.0]), np.array([1.0, np.hypot(1.0, offset), 1.0])
    for kind in ("Kalman", "Kalman(sqrt)", "FLS", "FLS(differences=2)"):
        run = track(MODEL, TRACKERS[kind](f * size, 1.0), y, x * f[:2])
        smooth = run.smooth()
        assert (np.abs(run.theta[-1] - smooth.theta[-1]) < 1e-6 * run.std[-1]).all()
        np.testing.assert_allclose(run.std[-1], smooth.std[-1], rtol=1e-5)


def test_what_is_never_excited_stays_unknown_and_spoils_nothing():
    """An input at rest, and one that is a multiple of another in other units."""
    y, x = record(0.0)
    idle = track(MODEL, RLS(1.0), y, np.column_stack([1e-9 * x[:, 0], np.zeros(len(y))]))
    assert np.isinf(idle.std[-1]).tolist() == [False, True, False]
    found = np.linalg.lstsq(np.column_stack([x[:, 0], np.ones(len(y))]), y, rcond=None)[0]
    np.testing.assert_allclose(idle.theta[-1, [0, 2]] * [1e-9, 1.0], found, rtol=1e-9)
    twice = track(MODEL, RLS(1.0), y, np.column_stack([x[:, 0], 1.8e5 * x[:, 0] + 32.0]))
    assert np.isinf(twice.std[-1]).all()
    np.testing.assert_allclose(twice.prediction[-1], idle.prediction[-1], rtol=1e-9)


LEAST = {"Longley": 10.5, "Filip": 5.0, "Wampler1": 9.0, "Wampler2": 12.0, "Wampler3": 7.0, "Wampler4": 5.0}
LEAST |= {"Wampler5": 3.0}


@pytest.mark.parametrize("name", DATA)
def test_certified_values(name):
    """NIST's data sets; the recursion may lose what `form="sqrt"` keeps, but not to more than a millionth of a std."""
    y, X, certified, sd = DATA[name]
    model, order = Regression(X.shape[1], intercept=True), [X.shape[1], *range(X.shape[1])]
    run = track(model, RLS(1.0), y, X)
    assert digits(run.theta[-1, order], certified) > LEAST[name]
    if sd > 0.0:
        assert (np.abs(run.theta[-1, order] - certified) < 1e-6 * run.std[-1, order]).all() or name == "Filip"
    if name != "Filip":
        root = track(model, Kalman(q=0.0, r=1.0, form="sqrt"), y, X)
        assert digits(root.theta[-1, order], certified) > {"Wampler4": 8.0, "Wampler5": 6.0}.get(name, 9.0)


@pytest.mark.parametrize("offset", [1e6, 1e9, 1e11])
def test_an_offset_of_millions_of_standard_deviations_is_not_taken_for_noise(offset):
    """The least noise that the default assumes is a share of y^2: it must stay below the noise itself."""
    rng = np.random.default_rng(0)
    u = rng.normal(size=(400, 2))
    gain = 2.0 + np.cumsum(0.05 * rng.normal(size=400))
    y = gain * u[:, 0] + 0.5 * u[:, 1] + 0.3 * rng.normal(size=400)
    plain, far = (track(Regression(2, intercept=True), AdaptiveKalman(), y + at, u) for at in (0.0, offset))
    rms = [np.sqrt(np.mean((run.theta[50:, 0] - gain[50:]) ** 2)) for run in (plain, far)]
    assert rms[1] < 1.05 * rms[0]
    np.testing.assert_allclose(far.innovation_std[50:], plain.innovation_std[50:], rtol=0.1)
    np.testing.assert_allclose(far.std[-1], plain.std[-1], rtol=0.1)


@pytest.mark.parametrize("unit", [2.0**-20, 2.0**20])
def test_weights_in_another_unit_alter_only_the_noise_variance(unit):
    """Weights are often 1 / variance. Scales of the drift and of jumps left them out: `Bank()` did not see a jump, and
    `tune` ended at a bound of its search.
    """
    rng = np.random.default_rng(0)
    u, y, w = rng.normal(size=240), np.zeros(240), 10.0 ** rng.uniform(-1.0, 1.0, 240)
    for t in range(1, 240):
        y[t] = 0.6 * y[t - 1] + (1.0 if t < 120 else 1.8) * u[t - 1] + 0.2 * rng.normal() / np.sqrt(w[t])
    spoilt = np.where(np.arange(240) == 60, y + 4.0, y)
    for tracker, z in ((AdaptiveKalman(), spoilt), (Bank(), y)):
        one, other = (track(ARX(1, 1), tracker, z, u, weights=w * k) for k in (1.0, unit))
        np.testing.assert_allclose(other.theta, one.theta, rtol=1e-6, atol=1e-8)
        np.testing.assert_allclose(other.std[3:], one.std[3:], rtol=1e-5)
        assert other.loglik == pytest.approx(one.loglik, rel=1e-6)
        assert abs(one.theta[-1, 1] - 1.8) < 0.1
        np.testing.assert_allclose(other.smooth().std[100], one.smooth().std[100], rtol=1e-4)
    one, other = (tune(ARX(1, 1), Kalman(), y, u, weights=w * k) for k in (1.0, unit))
    assert other.loglik == pytest.approx(one.loglik, rel=1e-6)
    assert other.tracker.r == pytest.approx(unit * one.tracker.r, rel=1e-3)
    one, other = (huber(track(ARX(1, 1), Kalman(q=1e-3, r=0.04 * k), y, u, weights=w * k)) for k in (1.0, unit))
    assert other.delta == pytest.approx(np.sqrt(unit) * one.delta, rel=1e-9)
    np.testing.assert_allclose(other.path.theta, one.path.theta, rtol=1e-6)
