"""Every tracker is its textbook on any record: jumps of gains, outliers, codes, outages, rests, steps, other units.

The textbooks are in `twins` and `twins_nonlinear`. What differs is rounding: at most 100 eps kappa, kappa the largest
variance of a prediction beside that of the noise. Until regressors span theta, its part in the other directions is
compared only where all columns have one unit: it is a matter of rounding otherwise.
"""

import copy
from decimal import Decimal, localcontext
from typing import NamedTuple

import naive_smoother
import numpy as np
import pytest
import twins
import twins_nonlinear as nonlinear
from filterpy.kalman import KalmanFilter
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from statsmodels.tsa.statespace import kalman_filter as statsmodels
from support import BAD

from driftfit import (
    ARX,
    FLS,
    RLS,
    AugmentedFLS,
    DynamicGLM,
    ExtendedKalman,
    HammersteinWiener,
    InstrumentalVariables,
    JointKalman,
    Kalman,
    Law,
    OutputError,
    Regression,
    StateSpace,
    track,
)
from driftfit.models.hammerstein_wiener.basis import Polynomial

# that codes are used is the promise; `test_gate_surfaces` is about the warning of them
pytestmark = pytest.mark.filterwarnings("ignore:track. .*fault code:driftfit.DataWarning")

EIGHT = settings(max_examples=8, phases=[Phase.generate])  # a record of a seed is not made smaller
SIGMA = 0.1
OUTAGES = ("missing", "gap", "weight", "drift")
WILD = ("jump", "outlier", "code in y", "code in u", "rest", "steps", "louder")
UNITS = ((1.0, 1.0), (1e8, 1e8), (1e-8, 1e-8), (1e8, 1.0), (1.0, 1e8))


class Record(NamedTuple):
    """y (T,), u (T, m), intervals, factors of the noise variance (T,) and of the drift (T,) or (T, n)."""

    y: np.ndarray
    u: np.ndarray
    dt: np.ndarray
    noise: np.ndarray
    drift: np.ndarray
    r: float
    units: np.ndarray
    """Sizes of the parameters, (n,)."""
    story: str
    """What it was made of; hypothesis prints it."""

    def __repr__(self):
        return self.story

    def run(self, model, tracker):
        with np.errstate(divide="ignore"):
            known = {"time": np.cumsum(self.dt), "weights": 1.0 / self.noise, "drift": self.drift}
        return track(model, tracker, self.y, self.u, **known)


def simulated(rng, u, na, gains):
    """y of a stable ARX; ``gains`` (T, m nb) are the coefficients of the inputs."""
    T, m = u.shape
    nb, delay = gains.shape[1] // m, int(na > 0)
    y, a, v = np.zeros(T), ((), (0.7,), (1.2, -0.5))[na], SIGMA * rng.standard_normal(T)
    for t in range(T):
        ago = t - delay - np.tile(np.arange(nb), m)
        driven = np.where(ago >= 0, u[ago, np.repeat(np.arange(m), nb)], 0.0) @ gains[t]
        y[t] = v[t] + driven + sum(a[i] * y[t - i - 1] for i in range(min(na, t)))
    return y


@st.composite
def records(draw, na=0, nb=1, m=1, constant=0, events=OUTAGES + WILD, units=UNITS, each=False):
    """A record of ``na`` lags of y and ``nb`` of each of m inputs, with one to four events; ``each``: of the drift."""
    seed = draw(st.integers(0, 10_000))
    rng = np.random.default_rng(seed)
    of_y, of_u = draw(st.sampled_from(units))
    chosen = draw(st.lists(st.sampled_from(events), min_size=1, max_size=4, unique=True))
    T, n = 80, na + nb * m + constant
    u, gains = rng.standard_normal((T, m)), np.tile(rng.uniform(0.5, 1.5, nb * m), (T, 1))
    at = {name: int(rng.integers(3, T - 20)) for name in OUTAGES + WILD}
    if "steps" in chosen:
        u = np.repeat(rng.standard_normal((T // 10, m)), 10, axis=0)
    if "rest" in chosen:
        u[at["rest"] : at["rest"] + 40] = rng.choice([0.0, 1.0])
    if "louder" in chosen:
        u[at["louder"] :] *= 10.0 ** rng.uniform(-3, 3)
    if "jump" in chosen:
        gains[at["jump"] :] *= 10.0 ** rng.uniform(1, 3)
    y = simulated(rng, u, na, gains)
    if "outlier" in chosen:
        y[rng.integers(0, T, 3)] += rng.choice([-SIGMA, SIGMA], 3) * 10.0 ** rng.uniform(1.5, 6, 3)
    if "code in y" in chosen:
        y[at["code in y"] : at["code in y"] + rng.integers(1, 4)] = 9999.0
    if "code in u" in chosen:
        u[at["code in u"] : at["code in u"] + rng.integers(1, 4), 0] = 9999.0
    y, u = of_y * y, of_u * u
    dt, noise, drift = np.ones(T), np.ones(T), np.ones((T, n) if each else T)
    if "missing" in chosen:
        y[at["missing"] : at["missing"] + rng.integers(1, 8)] = np.nan
        y[rng.integers(0, T, 3)], u[rng.integers(3, T, 2), 0] = rng.choice(BAD, 3), rng.choice(BAD, 2)
    if "gap" in chosen:
        dt[rng.integers(1, T, 3)] = rng.choice([0.5, 1.25, 2.0, 3.0], 3)  # the first interval is 1 by definition
    if "weight" in chosen:
        noise[rng.integers(0, T, 4)] = rng.choice([np.inf, 2.0, 0.25], 4)
    if "drift" in chosen:
        drift[rng.integers(0, T, 4)] = rng.choice([0.0, 10.0], drift[:4].shape)
    sizes = np.r_[np.ones(na), np.full(nb * m, of_y / of_u), np.full(constant, of_y)]
    story = f"seed {seed}, units {of_y, of_u}: {chosen}"
    return Record(y, u, dt, noise, drift, (of_y * SIGMA) ** 2, sizes, story)


def assert_textbook(record, run, expected, kappa, everywhere=True, first=0, curved=False):
    """A run from sample ``first`` on beside its twin; everywhere, or where theta is determined.

    A run of a curved model has a prediction of y where the twin has one of the equation, and s is that of used samples.
    """
    tolerance = max(1e-9, 100.0 * np.finfo(float).eps * float(kappa))
    theta, var, y_hat, e, s, ok = (column[first:] for column in expected)
    np.testing.assert_array_equal(run.ok[first:], ok > 0.0)
    determined = everywhere | ~np.isinf(var).any(axis=1)
    foreseen = determined & (everywhere | ~np.isinf(s))
    weighed = np.isfinite(record.noise[first:]) & ((ok > 0.0) | (not curved))
    signal = max(abs(column[np.isfinite(column)]).max(initial=0.0) for column in (y_hat, e))
    pairs = [
        ("theta", theta, determined, abs(theta).max(axis=0)),
        ("var", var, slice(None), abs(var)),
        ("e", e, foreseen, signal),
        ("s", s, weighed, abs(s[weighed])),
    ]
    for name, slow, where, size in pairs if curved else [*pairs, ("y_hat", y_hat, foreseen, signal)]:
        slow, fast = slow[where], run.written(name)[first:][where]
        both = np.isfinite(fast) & np.isfinite(slow)
        np.testing.assert_array_equal(np.where(both, 0.0, fast), np.where(both, 0.0, slow), err_msg=name)
        beyond = abs(np.where(both, fast, 0.0) - np.where(both, slow, 0.0)) > tolerance * np.where(both, size, np.inf)
        assert not beyond.any(), f"{name}: first at {np.argwhere(beyond)[0]}, tolerance {tolerance:.1e}"


DELAYED = "ARX(1, [1, 1], nk=[0, 2], intercept=True)"
MODELS = {"Regression(3)": (0, 1, 3), "ARX(2, 2)": (2, 2, 1), DELAYED: (1, 1, 2, 1)}


def model_of(name, start):
    """The model and its twin."""
    na, nb, m, *_ = MODELS[name]
    if name == DELAYED:
        model = ARX(1, [1, 1], nk=[0, 2], intercept=True, start=start)
        return model, twins.ARX(1, [(1, 0), (1, 2)], intercept=True, start=start)
    if na == 0:
        return Regression(m), twins.ARX(0, [(1, 0)] * m, start="zero")
    return ARX(na, nb, start=start), twins.ARX(na, [(nb, 1)], start=start)


def prior(draw, record, noise=1.0):
    """p0 and theta0; p0 in units of ``noise``."""
    units, n = record.units, len(record.units)
    p0 = draw(st.sampled_from([None, 2.0 * units**2, (np.eye(n) + 0.3) * np.outer(units, units)]))
    theta0 = draw(st.sampled_from([0.0, 0.5 * units]))
    return {"p0": None if p0 is None else p0 / noise, "theta0": theta0}


def kalman(draw, record):
    q = np.array(draw(st.sampled_from([(0.0,) * 4, (0.01,) * 4, (0.1, 0.0, 0.02, 0.3)]))[: len(record.units)])
    given = {"q": q * record.units**2, "r": record.r, **prior(draw, record)}
    return Kalman(**given), twins.Kalman(len(record.units), **given)


def kalman_matrix(draw, record):
    given = {"q": 0.01 * (np.eye(len(record.units)) + 0.3) * np.outer(record.units, record.units), "r": record.r}
    return Kalman(**given), twins.Kalman(len(record.units), **given)


def kalman_root(draw, record):
    given = {"q": 0.01 * record.units**2, "r": record.r, **prior(draw, record)}
    return Kalman(form="sqrt", **given), twins.Kalman(len(record.units), **given)


def kalman_laws(draw, record):
    unit = record.units[0]
    laws = (("returns", 20.0, 0.5 * unit), ("trend", 1e-4 * unit**2), ("season", 12.0, 2, 1e-4 * unit**2))
    own = {f"theta{i + 1}": getattr(Law, kind)(*given) for i, (kind, *given) in enumerate(laws)}
    given = {"q": 0.01 * record.units**2, "r": record.r}
    return Kalman(laws=own, **given), twins.Laws(3, laws=laws, **given)


def rls(draw, record):
    given = {"forgetting": draw(st.sampled_from([0.9, 0.98, 1.0])), **prior(draw, record, record.r)}
    given["c_max"] = 10.0 if given["p0"] is not None else 1e8
    return RLS(**given), twins.RLS(len(record.units), **given)


def rls_directional(draw, record):
    given = {"forgetting": draw(st.sampled_from([0.9, 0.98])), "kind": "directional", **prior(draw, record, record.r)}
    return RLS(**given), twins.RLS(len(record.units), **given)


def fls(draw, record):
    mu = np.array(draw(st.sampled_from([(10.0,) * 4, (1.0, 100.0, np.inf, 3.0)]))[: len(record.units)])
    given = {"mu": mu * record.r / record.units**2, **prior(draw, record, record.r)}
    return FLS(**given), twins.FLS(len(record.units), **given)


def fls_slopes(draw, record):
    given = {"mu": 10.0 * record.r / record.units**2, "differences": 2}
    return FLS(**given), twins.FLS(len(record.units), **given)


def augmented(draw, record):
    given = {"mu": draw(st.sampled_from([0.1, 10.0])) * record.r / record.units[-1] ** 2, "alpha": 0.8}
    return AugmentedFLS(**given), twins.AugmentedFLS(len(record.units), **given)


def instrumental(draw, record):
    given = {"forgetting": draw(st.sampled_from([0.97, 1.0])), **prior(draw, record, record.r)}
    return InstrumentalVariables(**given), twins.InstrumentalVariables(4, na=2, **given)


CASES = [
    *((kalman, name) for name in MODELS),
    (kalman_laws, "Regression(3)"),
    *((one, "ARX(2, 2)") for one in (
        kalman_matrix, kalman_root, rls, rls_directional, fls, fls_slopes, augmented, instrumental,
    )),
]  # fmt: skip


@pytest.mark.parametrize(("tracker", "model"), CASES, ids=lambda x: getattr(x, "__name__", x))
@EIGHT
@given(data=st.data())
def test_any_record(tracker, model, data):
    each = tracker in (kalman, kalman_matrix, kalman_root, fls)
    record = data.draw(records(*MODELS[model], each=each))
    compiled, signals = model_of(model, data.draw(st.sampled_from(["drop", "zero"])))
    fast, slow = tracker(data.draw, record)
    run = record.run(compiled, fast)
    expected = signals.run(slow, record.y, record.u, record.dt, record.noise, record.drift)
    # what has laws is determined together, and shown until then as if it were 0
    first = np.isfinite(run.written("var")).all(axis=1).argmax() + 1 if tracker is kalman_laws else 0
    assert_textbook(record, run, expected, slow.kappa, len(set(record.units)) == 1, first)
    if tracker in (kalman, kalman_matrix):
        assert run.loglik == pytest.approx(slow.loglik, rel=1e-6, abs=1e-6)
        if np.isfinite(run.std[-1]).all():
            std, rounding = run.std[-1], max(1e-9, 2e-14 * float(slow.kappa))
            np.testing.assert_allclose(
                run.cov(-1) / np.outer(std, std), slow.P.astype(float) / np.outer(std, std), rtol=0.0, atol=rounding
            )


def states(draw, method):
    """Parameters a and b, and a state x that is driven through a saturation and read through a bend."""
    record = draw(records(1, 1, 1, units=UNITS[:1]))
    equations = "x = x[-1] + dt * (theta.a * tanh(u) - theta.b * x[-1]) \n y = sqrt(1 + x * x) + 0.1 * u[-1]"
    model = StateSpace(equations, start={"a": 0.5, "b": 0.3, "x": 0.2})
    given = {"q": [1e-4, 0.0, 1e-3], "r": 0.01, "p0": [0.04, 0.01, 1.0]}

    def f(z, now):
        twice, dt = (2 * Decimal(now[0])).exp(), Decimal(now[2])
        return np.array([z[0], z[1], z[2] + dt * (z[0] * (twice - 1) / (twice + 1) - z[1] * z[2])])

    def h(z, now):
        return (1 + z[2] ** 2).sqrt() + Decimal("0.1") * Decimal(now[1] or 0.0)

    twin = {"extended": nonlinear.Extended, "unscented": nonlinear.Unscented}[method]
    slow = twin(3, f, h, theta0=[0.5, 0.3, 0.2], **given)
    return record, model, JointKalman(method=method, **given), slow, nonlinear.states(record)


def extended_kalman(draw):
    record = draw(records(1, 1, 1, units=UNITS[:1]))
    given = {"q": 1e-5, "r": 0.01, "p0": 1.0, "theta0": 0.01, "inflation": draw(st.sampled_from([0.0, 1.0]))}
    slow = nonlinear.Extended(4, lambda z, row: z, lambda z, row: row @ nonlinear.products(z), **given)
    return record, CURVED, ExtendedKalman(**given), slow, nonlinear.hammerstein_wiener(record)


def stage_one(draw):
    record = draw(records(1, 1, 1, units=UNITS[:1]))
    given = {"q": 1e-5, "r": 0.01, "p0": 100.0, "theta0": 0.01}
    return record, CURVED, Kalman(**given), twins.Kalman(5, **given), nonlinear.hammerstein_wiener(record)


def output_error(draw):
    record = draw(records(1, 2, 1, events=("weight", "drift", *WILD), units=UNITS[:1]))
    record.y[:3], record.y[40:45] = (8.0, -8.0, 8.0), np.nan
    given = {"q": 1e-5, "r": 0.01, "p0": 0.5, "theta0": [-0.5, 0.8, 0.8, 0.01], "q_w": 1e-4, "p_w": 0.5}
    model = HammersteinWiener(1, 2, input=Polynomial(2))
    return record, model, OutputError(**given), nonlinear.OutputError(**given), nonlinear.output_error(record)


CURVED = HammersteinWiener(1, 1, input=Polynomial(2), output=Polynomial(2))
NONLINEAR = {
    "extended states": lambda draw: states(draw, "extended"),
    "unscented states": lambda draw: states(draw, "unscented"),
    "extended Kalman": extended_kalman,
    "stage one": stage_one,
    "output error": output_error,
}


@pytest.mark.filterwarnings("ignore:.*root mean square")  # of gains that jump
@pytest.mark.parametrize("name", NONLINEAR)
@EIGHT
@given(data=st.data())
def test_any_record_of_a_curved_model(name, data):
    record, model, fast, slow, samples = NONLINEAR[name](data.draw)
    samples, again = list(samples), copy.deepcopy(slow)
    expected, kappa = nonlinear.played(slow, samples, record), slow.kappa
    if name == "unscented states":  # differences of points cancel: what the textbook itself loses in 16 digits
        rounded = nonlinear.played(again, samples, record, digits=16)[0]
        lost = np.max(abs(rounded - expected[0]) / abs(expected[0]).max(axis=0))
        kappa = max(kappa, 0.1 * lost / np.finfo(float).eps)
    assert_textbook(record, record.run(model, fast), expected, kappa, curved=True)


@pytest.mark.parametrize("family", ["poisson", "negative binomial", "logistic"])
@EIGHT
@given(data=st.data())
def test_any_counts(family, data):
    """With counts of 500 and 9999 among a few."""
    record = data.draw(records(events=OUTAGES, units=UNITS[:1]))
    rng = np.random.default_rng(0)
    mean = np.exp(0.3 + 0.5 * np.where(abs(record.u[:, 0]) < 10.0, record.u[:, 0], 0.0))
    y = rng.poisson(mean).astype(float)
    y = (
        np.minimum(y, 1.0)
        if family == "logistic"
        else np.where(np.isin(np.arange(80), [30, 31]), [500.0, 9999.0] * 40, y)
    )
    record = record._replace(y=np.where(abs(record.y) < 1e38, y, np.nan))
    given = {"family": family, "q": 0.01, "p0": 2.0, "alpha": 0.5}
    expected = twins.ARX(0, [(1, 0)], start="zero").run(
        nonlinear.DynamicGLM(1, **given), record.y, record.u, record.dt, record.noise, record.drift
    )
    assert_textbook(record, record.run(Regression(1), DynamicGLM(**given)), expected, 0.0)


@EIGHT
@given(data=st.data())
def test_the_smoother_of_flexible_least_squares_has_the_least_cost(data):
    """The path in eighty digits; J of the path is what is said of it, and no other is less."""
    record = data.draw(records(m=3, events=WILD))
    mu = 10.0 * record.r / record.units[0] ** 2
    smoothed = track(Regression(3), FLS(mu), record.y, record.u).smooth()
    path, _ = naive_smoother.precise(record.u, record.y, mu)

    def cost(theta):
        return np.sum((record.y - (record.u * theta).sum(axis=1)) ** 2) + mu * np.sum(np.diff(theta, axis=0) ** 2)

    np.testing.assert_allclose(smoothed.theta, path, rtol=0.0, atol=1e-8 * abs(path).max())
    assert smoothed.cost == pytest.approx(cost(path), rel=1e-6)
    assert cost(smoothed.theta) == pytest.approx(cost(path), rel=1e-6)


@EIGHT
@given(data=st.data())
def test_recursive_least_squares_without_forgetting_is_least_squares(data):
    """Of all samples so far, in exact normal equations."""
    record = data.draw(records(m=3, events=WILD))
    run = track(Regression(3), RLS(1.0), record.y, record.u)
    with localcontext() as context:
        context.prec = 100
        phi, y = twins.exact(record.u), twins.exact(record.y)
        for k in (4, 20, 50, 80):
            if np.isfinite(run.std[k - 1]).all():
                theta = twins.solve(phi[:k].T @ phi[:k], phi[:k].T @ y[:k]).astype(float)
                np.testing.assert_allclose(run.theta[k - 1], theta, rtol=0.0, atol=1e-7 * abs(theta).max())


def test_other_libraries_have_the_numbers_of_a_record_with_jumps_and_outliers():
    """filterpy from a prior, statsmodels from a prior and from the exact diffuse start."""
    rng = np.random.default_rng(0)
    u, gains = rng.standard_normal((100, 3)), np.ones((100, 3))
    gains[40:] = 100.0, 1.0, -30.0
    y = (u * gains).sum(axis=1) + SIGMA * rng.standard_normal(100)
    y[[20, 60, 61, 80]] += 3.0, 1e4, -50.0, 9999.0
    given = {"q": 0.01, "r": SIGMA**2}
    run, diffuse = track(Regression(3), Kalman(p0=2.0, **given), y, u), track(Regression(3), Kalman(**given), y, u)
    theirs = KalmanFilter(3, 1)
    theirs.P, theirs.Q, theirs.R, theirs.F = 2.0 * np.eye(3), 0.01 * np.eye(3), SIGMA**2, np.eye(3)
    loglik = 0.0
    for t in range(100):
        theirs.predict()
        theirs.update(y[t], H=u[t : t + 1])
        loglik += theirs.log_likelihood
        np.testing.assert_allclose(run.theta[t], theirs.x.ravel(), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(run.cov(-1), theirs.P, rtol=1e-9)
    assert run.loglik == pytest.approx(loglik, rel=1e-10)
    for mine, start in (
        (run, lambda f: f.initialize_known(np.zeros(3), 2.01 * np.eye(3))),
        (diffuse, lambda f: f.initialize_diffuse()),
    ):
        peer = statsmodels.KalmanFilter(1, 3)
        peer.bind(y)
        peer["design"], peer["obs_cov"], peer["state_cov"] = u.T[None], [[SIGMA**2]], 0.01 * np.eye(3)
        peer["transition"] = peer["selection"] = np.eye(3)
        start(peer)
        result = peer.filter()
        np.testing.assert_allclose(mine.theta[3:], result.filtered_state.T[3:], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(mine.cov(-1), result.filtered_state_cov[..., -1], rtol=1e-9)
        counted = result.llf + 1.5 * np.log(2.0 * np.pi) * (mine is diffuse)  # theirs has 2 pi of each diffuse sample
        assert mine.loglik == pytest.approx(counted, rel=1e-10)
