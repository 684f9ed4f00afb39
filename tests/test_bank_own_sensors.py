"""Sensors with likelihoods of the user's own, against a twin that calls the same functions from Python."""

import math

import naive_bank
import numpy as np
import pytest
from support import same
from test_bank import N, Q, R, changes, reported

from driftfit import ARX, Bank, Live, Regression, track
from driftfit.bank.reduction import Beam, Decide
from driftfit.bank.sensor import Sensor

LIMIT, STEP = 2.0, 0.1
P_SENSORS = np.array([0.9, 0.06, 0.04])


def laplace(y, y_hat, h, r, last):
    """Heavy tails: far readings count less; the innovation drives the plant."""
    width, far = 2.0 * math.sqrt(h + r), abs(y - y_hat)
    return -math.log(2.0 * width) - far / width, r * max(1.0, far / math.sqrt(r)), y


def clipped(y, y_hat, h, r, last):
    """A gauge that shows its limit for all that is above it."""
    if y < LIMIT:
        return -math.inf, math.inf, y
    above = 0.5 * math.erfc((LIMIT - y_hat) / math.sqrt(2.0 * (h + r)))
    return math.log(above / STEP + 1e-300), math.inf, max(y_hat, LIMIT)


def nonsense(y, y_hat, h, r, last):
    return math.nan, -1.0, math.nan


class Twin(naive_bank.Bank):
    """``sensors`` [(r, offset, cleans)] or [(function, r, cleans)]."""

    def see(self, z, y):
        plain, last = self.sensors, getattr(self, "last", math.nan)
        parents, _ = naive_bank.normalised(self.reduce(self.grown))
        children = []
        for leaf in parents:
            zl = np.r_[leaf.lags, z[self.na :]]
            for i, q in enumerate(self.Q):
                C = leaf.C + q
                h, y_hat = zl @ C @ zl, zl @ leaf.m
                for j, (kind, r, cleans) in enumerate(plain):
                    e = i * len(plain) + j
                    log_p, a, clean = kind(y, y_hat, h, r, last)
                    K = C @ zl / (h + a)
                    lags = (clean if cleans else y, *leaf.lags)[: self.na]
                    p = self.P[leaf.history[-1], e] if leaf.history else self.initial[e]
                    if log_p > -math.inf:
                        children.append(
                            naive_bank.Leaf(leaf.m + K * (y - y_hat), C - np.outer(K, C @ zl),
                                            leaf.logw + math.log(p) + log_p, (*leaf.history, e), lags)
                        )  # fmt: skip
        self.grown, gone = naive_bank.normalised(children)
        self.evidence, self.last = self.evidence + gone, y
        return gone


def nominal(y, y_hat, h, r, last):
    return naive_bank.log_normal(y - y_hat, h + r), r, y


SENSORS = [Sensor.nominal(R), Sensor.own(laplace, prob=0.06), Sensor.own(clipped, prob=0.04, cleans=True)]
TABLE = [(nominal, R, False), (laplace, R, False), (clipped, R, True)]


def record(T=60):
    rng = np.random.default_rng(5)
    u, y = rng.standard_normal(T), np.zeros(T)
    for t in range(1, T):
        y[t] = 0.6 * y[t - 1] + (1.0 if t < 30 else 2.0) * u[t - 1] + 0.3 * rng.standard_normal()
    y[[12, 40]] += 4.0
    return np.minimum(y, LIMIT), u


def test_own_likelihoods_are_what_the_twin_says():
    y, u = record()
    bank = Bank(changes(), SENSORS, None, Beam(9), p0=2.0, lag_variance=False)
    P, initial = bank.event_probabilities
    twin = Twin(Q, TABLE, P, initial, np.zeros(N), 2.0 * np.eye(N), naive_bank.beam(9), na=1)
    run = track(ARX(1, 1, start="zero"), bank, y, u)
    total = 0.0
    for t in range(len(y)):
        total += twin.see(np.array([0.0, u[t - 1] if t else 0.0]), y[t])
        np.testing.assert_allclose(run.theta[t], twin.mean, atol=1e-9)
        np.testing.assert_allclose(reported(run, "lag_prob")[t, 0], twin.lag(0, 9), atol=1e-9)
    assert run.loglik == pytest.approx(total, abs=1e-7)
    clips = run.hypotheses.mode_prob.reshape(-1, 3, 3)[..., 2].sum(axis=1)
    assert clips[y == LIMIT].max() > 0.9
    assert clips[y < LIMIT].max() == 0.0


def test_unknown_noise_is_the_leaves_own():
    """A density that knows no scale of its own gives an evidence that knows none."""
    y, u = record()
    bank = Bank(sensors=[Sensor.nominal(), Sensor.own(laplace, prob=0.06)])
    one, other = (track(ARX(1, 1), bank, y * unit, u) for unit in (1.0, 1000.0))
    np.testing.assert_allclose(other.hypotheses.mode_prob, one.hypotheses.mode_prob, atol=1e-6)
    np.testing.assert_allclose(other.theta[:, 1], 1000.0 * one.theta[:, 1], rtol=1e-6)
    assert (
        one.hypotheses.mode_prob[40].reshape(-1, 2)[:, 1].sum() > 0.12
    )  # twice what it is beforehand; jumps explain the rest


def test_stream_fleet_and_file_say_the_same(tmp_path):
    y, u = record()
    bank = Bank(changes(), SENSORS, p0=2.0)
    run, live = track(ARX(1, 1), bank, y, u), Live(ARX(1, 1), bank)
    for t in range(60):
        live.update(y[t], u[t])
        assert same(live.theta, run.theta[t])
        if t == 30:
            live.save(tmp_path / "state")
            live = Live.load(tmp_path / "state", classes=[laplace, clipped])
    assert live.tracker == bank
    fleet = track(ARX(1, 1), bank, np.stack([y, y]), np.stack([u, u]), by="row")
    assert same(fleet[1].theta, run.theta)
    both = track(Regression(N, ny=2), Bank(sensors=SENSORS), np.stack([y, y], axis=1), np.column_stack([u, y]))
    assert np.isfinite(both.theta).all()
    assert np.isfinite(run.smooth().theta).all()


def test_nonsense_of_a_function_is_survived():
    y, u = record()
    z = np.column_stack([u, np.ones(60)])
    known = Sensor.nominal(R)
    plain = track(Regression(2), Bank(changes(), [known], reduce=Decide(2), p0=2.0), y, z)
    odd = Bank(changes(), [known, Sensor.own(nonsense, prob=0.5)], reduce=Decide(2), p0=2.0)
    run = track(Regression(2), odd, y, z)
    np.testing.assert_allclose(run.theta, plain.theta, atol=1e-9)
    np.testing.assert_allclose(run.loglik, plain.loglik + 60 * math.log(0.5), atol=1e-6)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: Sensor.own(lambda y, y_hat, h, r, last: (0.0, r, y)), "by name"),
        (lambda: Sensor.own(record), "takes 1 arguments"),
        (lambda: Sensor.own(3.0), "must be a function"),
        (lambda: Sensor("own"), r"Sensor\.own"),
        (lambda: Sensor.own(laplace, prob=2.0), "within"),
    ],
)
def test_what_is_no_likelihood_is_named(build, message):
    with pytest.raises(ValueError, match=message):
        build()
