"""Outages and long intervals are levels of the tree; loglik is the log evidence; fault codes are survived."""

from itertools import product
from math import comb

import naive_bank
import numpy as np
import pytest
from scipy.special import logsumexp
from support import same
from test_bank import N, R, changes, record, reported

from driftfit import ARX, Bank, Kalman, Live, Regression, track, tune
from driftfit.bank.change import Change
from driftfit.bank.reduction import GPB, IMM, Beam, Decide, Hybrid
from driftfit.bank.sensor import Sensor

KNOWN = [Sensor.nominal(R)]
P, DRIFT, JUMP = 0.01, 1e-4, 1.0
TWO = [Change(DRIFT), Change(JUMP, prob=P)]
Z = np.array([1.0, -0.5])


def ended(gap, times, reduce, y=2.0):
    """One certain start, and then a single sample after a gap of so many nominal intervals."""
    bank = Bank(TWO, KNOWN, reduce=reduce, p0=0.1)
    if times:
        return track(Regression(N), bank, [0.0, y], [Z, Z], time=[0.0, float(gap)])
    missing = [np.nan] * (gap - 1)
    return track(Regression(N), bank, [0.0, *missing, y], np.tile(Z, (gap + 1, 1)))


def enumerated(gap, y=2.0):
    """(log p(y), p(a change | y)) after the gap, over the number of jumps in it, which is all that matters."""
    m, C = np.zeros(N), None
    leaves = []
    for p, q in ((1.0 - P, DRIFT), (P, JUMP)):
        C = (0.1 + q) * np.eye(N)
        s = R + Z @ C @ Z
        leaves.append((np.log(p) + naive_bank.log_normal(0.0, s), C - np.outer(C @ Z, C @ Z) / s))
    before = logsumexp([w for w, _ in leaves])
    logs = np.empty((2, gap + 1))
    for a, (w, C) in enumerate(leaves):
        for k in range(gap + 1):
            s = R + Z @ (C + (k * JUMP + (gap - k) * DRIFT) * np.eye(N)) @ Z
            prior = np.log(float(comb(gap, k))) + k * np.log(P) + (gap - k) * np.log1p(-P)
            logs[a, k] = w - before + prior + naive_bank.log_normal(y - Z @ m, s)
    return logsumexp(logs), 1.0 - np.exp(logsumexp(logs[:, 0]) - logsumexp(logs))


@pytest.mark.parametrize("times", [False, True])
@pytest.mark.parametrize("reduce", [Beam(6), Decide(2), GPB(2), IMM()], ids=str)
@pytest.mark.parametrize(("gap", "close"), [(1, 1e-12), (2, 5e-3), (20, 0.04), (100, 0.12)])
def test_a_gap_is_weighed_as_all_that_may_have_happened(reduce, times, gap, close):
    run = ended(gap, times, reduce)
    log_p, changed = enumerated(gap)
    if isinstance(reduce, IMM):
        close = max(close, 0.05)  # it merges the two leaves from before the gap
    assert reported(run, "evidence")[-1] == pytest.approx(log_p, abs=close)
    assert reported(run, "lag_prob")[-1, 0, 1] == pytest.approx(changed, abs=close / 5.0)
    assert changed > (0.3 if gap > 1 else 0.1)


def test_what_is_reported_in_a_gap_is_all_that_may_have_happened():
    run = ended(30, False, Beam(6))
    start, t = run.std[0] ** 2, np.arange(1, 30)
    np.testing.assert_allclose(
        run.std[1:-1] ** 2 - start, t[:, None] * ((1.0 - P) * DRIFT + P * JUMP) * np.ones(N), rtol=1e-3
    )
    assert same(run.theta[1:-1], np.repeat(run.theta[:1], 29, axis=0))
    np.testing.assert_allclose(reported(run, "lag_prob")[1:-1, 0, 1], P, rtol=1e-12)
    mixture = run.hypotheses.mixture(20)
    np.testing.assert_allclose(mixture.cov, run.cov(20), rtol=1e-12)
    np.testing.assert_allclose(run.prediction[1:], Z @ run.theta[0], rtol=1e-12)


@pytest.mark.parametrize("sensors", [None, "markov"])
def test_a_stream_in_a_gap_says_what_the_record_says(sensors, tmp_path):
    y, u = record(60, 5, (35,))
    y[30:40], u[42] = np.nan, np.nan
    bank = Bank(changes(), KNOWN, reduce=Beam(6), p0=2.0)
    if sensors:
        two = [*KNOWN, Sensor.outlier(10.0)]
        bank = Bank(changes(), two, (None, [[0.95, 0.05], [0.5, 0.5]]), Hybrid(6), p0=2.0)
    time = np.cumsum(np.where(np.arange(60) % 17 == 0, 6.0, 1.0))
    run, live, found = track(Regression(N), bank, y, u, time=time), Live(Regression(N), bank), []
    for t in range(60):
        live.update(y[t], u[t], time=time[t])
        found += live.hypotheses.events()
        assert same(live.theta, run.theta[t]), t
        assert same(live.std, run.std[t]), t
        if t == 36:
            live.save(tmp_path / "state")
            live = Live.load(tmp_path / "state")
    (event,) = (event for event in run.hypotheses.events() if event.kind == "change")
    assert event.span.first <= 35 <= event.span.last
    assert event.first == time[event.span.first] <= time[35] <= event.last
    assert event.level == 0.95
    for streamed in found:  # none yet if the stream is too short
        assert streamed.date == pytest.approx(time[streamed.span.date])


def test_jumps_in_an_outage_are_found():
    """Gain 1 to 2 in noise 0.5, somewhere in an outage of twenty samples: 19 of 20, as many as without one."""
    found, false = {0: 0, 20: 0}, 0
    for outage in (0, 20):
        for seed in range(20):
            rng = np.random.default_rng(seed)
            u, jump = rng.standard_normal((200, N)), 100 + int(rng.integers(outage + 1))
            y = (u * np.where(np.arange(200)[:, None] < jump, 1.0, [2.0, 1.0])).sum(axis=1)
            y += 0.5 * rng.standard_normal(200)
            y[100 : 100 + outage] = np.nan
            events = track(Regression(N), Bank(), y, u).hypotheses.found()
            found[outage] += any(95 <= e.span.date <= 105 + outage for e in events)
            false += any(not 95 <= e.span.date <= 105 + outage for e in events)
    assert false <= 2
    assert found[0] >= 19
    assert found[20] >= 19


def test_small_jumps_are_found_and_dated_at_their_level():
    """Two jumps of 1.6 standard deviations of the noise; `Bank()` finds some nine tenths of them."""
    held = found = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        u = rng.standard_normal((400, N))
        theta = np.where((np.arange(400)[:, None] // 133) % 2 == 0, 1.0, [1.8, 1.0])
        y = (u * theta).sum(axis=1) + 0.5 * rng.standard_normal(400)
        events = track(Regression(N), Bank(), y, u).changes()
        for jump in (133, 266):
            near = [e for e in events if abs(e.span.date - jump) <= 30]
            found += bool(near)
            held += any(e.span.first <= jump <= e.span.last for e in near)
    assert found >= 68
    assert held >= 0.9 * found


def test_the_log_likelihood_is_the_log_evidence():
    """Against the sum over all sequences of events, and Gaussian where there is one."""
    y, u = record(4, 3, (2,))
    y[1] = np.nan
    run = track(Regression(N), Bank(changes(), KNOWN, reduce=Decide(4), p0=2.0), y, u)
    Q = [np.asarray(change.increments(N)[0]) for change in changes()]
    probs, logs, used = np.array([change.prob for change in changes()]), [], [0, 2, 3]
    for events in product(range(3), repeat=4):
        total, covs = 2.0 * np.eye(N), []
        for i in events:
            total = total + Q[i]
            covs.append(total)
        S = np.array([[u[a] @ covs[min(a, b)] @ u[b] for b in used] for a in used]) + R * np.eye(3)
        dense = -0.5 * (3 * np.log(2 * np.pi) + np.linalg.slogdet(S)[1] + y[used] @ np.linalg.solve(S, y[used]))
        logs.append(np.log(probs[list(events)]).sum() + dense)
    assert run.loglik == pytest.approx(logsumexp(logs), abs=2e-3)  # a gap of two samples has the moments only
    assert run.loglik == pytest.approx(run.hypotheses.log_evidence, abs=1e-12)
    assert run.summary().loglik == run.loglik
    for p0 in (2.0, None):
        one = track(Regression(N), Bank([Change(1e-3)], KNOWN, p0=p0), *record(80, 5))
        kalman = track(Regression(N), Kalman(1e-3, R, p0=p0), *record(80, 5))
        assert one.loglik == pytest.approx(kalman.loglik, abs=1e-9)


def test_the_right_hypotheses_have_the_higher_likelihood():
    """Records with jumps: the sum of Gaussians with the moments of the mixture put a Kalman filter first."""
    y, u = record(400, 5, (100, 200, 300))
    bank = track(Regression(N), Bank(changes(), KNOWN, p0=2.0), y, u)
    best = tune(Regression(N), Kalman(r=R), y, u)
    assert bank.loglik > best.loglik + 20.0


def test_a_bank_is_tuned_by_its_evidence():
    y, u = record(400, 5, (100, 200, 300))
    wrong = Bank([Change(1e-2), Change(1e-3, prob=0.2, name="jump")], KNOWN, p0=2.0)
    tuned = tune(Regression(N), wrong, y, u)
    assert tuned.loglik == pytest.approx(track(Regression(N), tuned.tracker, y, u).loglik, abs=1e-9)
    assert tuned.loglik > track(Regression(N), wrong, y, u).loglik + 50.0
    nominal, jump = tuned.tracker.changes
    for size, chance in ((1.0, 0.3), (1.0, 3.0), (0.2, 1.0), (5.0, 1.0)):
        near = Change(size * np.asarray(jump.q), prob=chance * jump.prob)
        other = Bank([nominal, near], KNOWN, p0=2.0)
        assert track(Regression(N), other, y, u).loglik < tuned.loglik - 0.3
    assert tuned.chosen["scale[change 0]" if "scale[change 0]" in tuned.chosen else "scale[none]"] < 0.1


def test_fault_codes_are_survived():
    rng = np.random.default_rng(0)
    u, y = rng.standard_normal(400), np.zeros(400)
    for t in range(1, 400):
        y[t] = 0.7 * y[t - 1] + 2.0 * u[t - 1] + 0.3 * rng.standard_normal()
    clean = track(ARX(1, 1), Bank(), y, u)
    bad = y.copy()
    bad[[100, 250, 251]] = 9999.0
    run = track(ARX(1, 1), Bank(), bad, u)
    assert not run.ok[[100, 250, 251]].any()
    assert np.abs(run.theta - clean.theta)[20:].max() < 0.05
    assert run.innovation_std[260:].max() < 1.2 * clean.innovation_std[260:].max()
    assert run.left_out.sample.tolist() == [100, 250, 251]
    assert "3 samples far outside the range" in str(run.summary())
    lasting = y + np.where(np.arange(400) >= 200, 1e5, 0.0)  # what keeps coming is believed
    assert track(ARX(1, 1, intercept=True), Bank(), lasting, u).ok[205:].all()
