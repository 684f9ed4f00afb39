"""The log-likelihood that `tune` claims is that of a run with its settings, for every tracker that can be tuned."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from contract_table import model_of, ready
from support import arx_record

from driftfit import (
    ARX,
    FLS,
    RLS,
    ExtendedKalman,
    HammersteinWiener,
    Kalman,
    OutputError,
    Polynomial,
    Regression,
    track,
    tune,
)
from driftfit.systems.drift import RandomWalk
from driftfit.systems.hammerstein_wiener import simulate
from driftfit.trackers import found

TUNABLE = {"q", "r", "mu", "forgetting"}
BENT = HammersteinWiener(1, 2, input=Polynomial(2), output=Polynomial(2))
OPEN = [
    pytest.param(ready(kind), settings, id=f"{name}-{'-'.join(settings)}")
    for name, kind in found().items()
    if kind.covariance and not kind.follows_states
    for missing in [sorted(TUNABLE & set(kind.required))]
    for settings in dict.fromkeys([*((one,) for one in missing), tuple(missing)])
    if settings
]
WITH_BLOCKS = [one for one in OPEN if isinstance(one.values[0], (ExtendedKalman, FLS, Kalman, OutputError, RLS))]


def bent_record():
    rng = np.random.default_rng(0)
    laws = [[RandomWalk(x, 1e-3) for x in group] for group in ((-0.5,), (0.5, -0.3), (0.3,), (0.1,))]
    system = simulate(BENT, *laws, T=200, rng=rng, u=rng.uniform(-1.0, 1.0, 200))
    return system.y0 + 0.03 * rng.normal(size=200), system.u


def claims_what_the_run_has(model, tracker, y, u):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of settings at a bound, with a prior that does not fit
        tuned = tune(model, tracker, y, u)
        run = track(model, tuned.tracker, y, u)
    assert tuned.loglik == pytest.approx(run.loglik, rel=0.0, abs=1e-9)
    assert tuned.used == np.isfinite(run.log_density).sum()
    assert f"of {tuned.used} samples" in repr(tuned)
    if not tracker.learns_noise:  # and it is what was maximised
        assert -tuned._search.best == pytest.approx(run.loglik, rel=1e-12, abs=1e-9)


@pytest.mark.parametrize(("given", "missing"), OPEN)
def test_the_likelihood_that_is_claimed_is_that_of_the_run(given, missing):
    tracker = replace(given, **dict.fromkeys(missing))
    claims_what_the_run_has(model_of(tracker, ARX(1, 1).bind(1)), tracker, *arx_record(200, 1))


@pytest.mark.parametrize(("given", "missing"), WITH_BLOCKS)
def test_it_is_so_whatever_the_innovation_is_of(given, missing):
    """With an output block the innovation is that of the equation, or, of an output error, that of y."""
    claims_what_the_run_has(BENT, replace(given, **dict.fromkeys(missing)), *bent_record())


def test_records_are_added():
    """Whether each run learns its noise variance, or all have the same."""
    rng = np.random.default_rng(0)
    u = rng.normal(size=(3, 60, 1))
    y = np.cumsum(0.1 * rng.normal(size=(3, 60)), axis=1) * u[..., 0] + rng.normal(size=(3, 60))
    for tracker in (FLS(), Kalman()):
        tuned = tune(Regression(1), tracker, y, u, by="row")
        runs = track(Regression(1), tuned.tracker, y, u, by="row")
        assert tuned.loglik == pytest.approx(sum(run.loglik for run in runs.values()), abs=1e-9)
