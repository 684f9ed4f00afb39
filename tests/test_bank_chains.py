"""Changes that follow a Markov chain: gaps, intervals and transitions that vary in time, against all courses."""

from collections import defaultdict

import numpy as np
import pytest
from support import same
from test_bank import N, R, reported

from driftfit import Bank, Live, Regression, track
from driftfit.bank.change import Change
from driftfit.bank.layout import ROW
from driftfit.bank.reduction import GPB, Beam, Decide, Hybrid
from driftfit.bank.sensor import Sensor

Z = np.array([1.0, -0.5])
CHAINS = {
    "a jump and a rest": (np.array([[0.97, 0.03], [1.0, 0.0]]), (1e-4, 1.0)),
    "modes that last": (np.array([[0.98, 0.02], [0.05, 0.95]]), (1e-5, 0.05)),
    "both": (np.array([[0.96, 0.02, 0.02], [0.9, 0.1, 0.0], [0.05, 0.0, 0.95]]), (1e-4, 1.0, 0.02)),
}


def bank_of(name, reduce, **more):
    P, q = CHAINS[name]
    changes = [Change(each, prob=None if i == 0 else 0.01) for i, each in enumerate(q)]
    return Bank(changes, [Sensor.nominal(R)], P, reduce, p0=0.1, **more)


def every_course(P, initial, q, z, y):
    """(log p(y_t | past), modes, means) of the used samples, over all courses of the modes; P (T, k, k) or (k, k).

    Between used samples courses that end alike and were in each mode as often are one; nothing is approximated.
    """
    P = np.broadcast_to(P, (len(y), len(q), len(q)))
    leaves, found = [(1.0, None, np.zeros(N), 0.1 * np.eye(N), (0,) * len(q), 0)], []
    for t in range(len(y)):
        courses = defaultdict(float)
        for w, mode, _, _, times, of in leaves:
            for to in range(len(q)):
                p = initial[to] if mode is None else P[t, mode, to]
                courses[of, to, tuple(np.add(times, np.eye(len(q), dtype=int)[to]))] += w * p
        start = {leaf[5]: leaf for leaf in leaves}
        leaves = [(w, to, *start[of][2:4], times, of) for (of, to, times), w in courses.items() if w > 0.0]
        if np.isnan(y[t]):
            continue
        seen = []
        for k, (w, mode, m, C, times, _) in enumerate(leaves):
            wide = C + np.dot(times, q) * np.eye(N)
            s, e = R + z[t] @ wide @ z[t], y[t] - z[t] @ m
            w *= np.exp(-0.5 * (np.log(2.0 * np.pi * s) + e * e / s))
            g = wide @ z[t]
            seen.append((w, mode, m + g / s * e, wide - np.outer(g, g) / s, (0,) * len(q), k))
        total = sum(leaf[0] for leaf in seen)
        leaves = [(leaf[0] / total, *leaf[1:]) for leaf in seen]
        modes = np.bincount([leaf[1] for leaf in leaves], [leaf[0] for leaf in leaves], len(q))
        found.append((np.log(total), modes, sum(leaf[0] * leaf[2] for leaf in leaves)))
    return found


@pytest.mark.parametrize("reduce", [Beam(200), Decide(4)], ids=str)
@pytest.mark.parametrize("name", list(CHAINS))
def test_a_gap_is_weighed_as_all_courses_of_the_chain(name, reduce):
    """Exact for two modes and one missing sample; of three, two are one course by its moments."""
    bank, (P, q) = bank_of(name, reduce), CHAINS[name]
    closely = (1e-9, 1e-9, 0.05, 0.3) if len(q) == 2 else (1e-9, 0.35, 0.7, 0.7)
    for gap, close in zip((1, 2, 5, 20), closely, strict=True):
        for off in (0.3, 2.0):
            y, z = np.r_[0.1, 0.0, np.full(gap - 1, np.nan), off, off], np.tile(Z, (gap + 3, 1))
            z[-1] = 0.3, 1.0
            run = track(Regression(N), bank, y, z)
            exact = every_course(P, bank.event_probabilities[1], q, z, y)
            for k in (-2, -1):
                log_p, modes, mean = exact[k]
                assert reported(run, "evidence")[k] == pytest.approx(log_p, abs=close)
                np.testing.assert_allclose(
                    reported(run, "lag_prob")[k, 0], modes, atol=close / (2.0 if len(q) == 2 else 1.0)
                )
                np.testing.assert_allclose(run.theta[k], mean, atol=close / 4.0)


def test_an_interval_is_a_gap_of_the_chain():
    bank = bank_of("a jump and a rest", Beam(20))
    y, z = np.array([0.1, 0.0, 2.0, 2.0]), np.tile(Z, (4, 1))
    interval = track(Regression(N), bank, y, z, time=[0.0, 1.0, 11.0, 12.0])
    gap = track(Regression(N), bank, np.r_[y[:2], np.full(9, np.nan), y[2:]], np.tile(Z, (13, 1)))
    np.testing.assert_allclose(interval.theta[-2:], gap.theta[-2:], atol=1e-12)
    np.testing.assert_allclose(reported(interval, "evidence")[-2:], reported(gap, "evidence")[-2:], atol=1e-12)
    assert reported(interval, "window")[-1] > 0.9
    assert reported(gap, "window")[-1] > 0.9


def test_a_gap_is_reported_as_it_widens():
    """The mean over all courses, which Monte Carlo would find."""
    name = "modes that last"
    (P, q), bank = CHAINS[name], bank_of(name, GPB(2))
    y, z = np.r_[0.1, np.full(8, np.nan)], np.tile(Z, (9, 1))
    run = track(Regression(N), bank, y, z)
    p = reported(run, "lag_prob")[0, 0]
    C = run.cov(0)[0, 0]
    for t in range(1, 9):
        p = p @ P
        C += p @ q
        np.testing.assert_allclose(reported(run, "lag_prob")[t, 0], p, atol=1e-12)
        assert run.cov(t)[0, 0] == pytest.approx(C, rel=1e-9)
        assert run.innovation_std[t] ** 2 == pytest.approx(R + Z @ run.cov(t) @ Z, rel=1e-9)
        np.testing.assert_allclose(run.hypotheses.mixture(t).cov, run.cov(t), rtol=1e-9)


@pytest.mark.parametrize("reduce", [Beam(6), Hybrid(6), Decide(3), GPB(3)], ids=str)
def test_a_stream_with_gaps_says_what_the_record_says(reduce):
    """Gaps one after the other, so that leaves of `Decide` with a twin go on as one."""
    rng = np.random.default_rng(4)
    y, z = rng.standard_normal(80), rng.standard_normal((80, N))
    y[rng.random(80) < 0.4] = np.nan
    y[40] = 500.0  # refused by the gate, in an interval of its own
    time = np.cumsum(rng.choice([1.0, 2.0, 7.0, 0.5], 80))
    P, q = CHAINS["both"]
    bank = Bank([Change(each, prob=None if i == 0 else 0.01) for i, each in enumerate(q)],
                [Sensor.nominal(R), Sensor.outlier(prob=0.05)], (P, None), reduce, p0=0.1)  # fmt: skip
    run, live = track(Regression(N), bank, y, z, time=time, gate=True), Live(Regression(N), bank, gate=True)
    assert not run.ok[40]
    assert np.isfinite(run.theta).all()
    np.testing.assert_allclose(reported(run, "lag_prob")[:, 0].sum(axis=1), 1.0, atol=1e-9)
    assert (reported(run, "window") > -1e-9).all()
    for t in range(80):
        live.update(y[t], z[t], time=time[t])
        assert same(live.theta, run.theta[t]), t


@pytest.mark.parametrize("reduce", [Decide(3), Decide("auto", max_depth=3), GPB(2), Beam(5)], ids=str)
def test_gaps_one_after_the_other_stay_within_the_table(reduce):
    """Leaves that are all in one branch lose none by a decision: parted at every gap, they would outgrow the table."""
    rng = np.random.default_rng(0)
    y, z = rng.standard_normal(200), rng.standard_normal((200, N))
    y[100:] += 20.0 * z[100:, 0]
    y[rng.random(200) < 0.4] = np.nan
    run, room = track(Regression(N), bank_of("both", reduce), y, z), 2 * reduce.shape(3, 1).parents
    lane, leaves = run.state, reported(run, "leaves")
    assert lane["table"][ROW["parents"], 2] >= room
    assert leaves.max() == 3 * room  # as many as there may be, and no more
    p = reported(run, "lag_prob")
    assert p.min() >= 0.0
    np.testing.assert_allclose(p[30:].sum(axis=2), 1.0, atol=1e-9)


def test_jumps_in_an_outage_are_found_under_a_chain():
    """Never two jumps in a row: gain 1 to 2 in noise 0.5, somewhere in an outage of twenty samples."""
    P = np.array([[0.99, 0.01], [1.0, 0.0]])
    bank, found, false = Bank([Change(1e-6), Change(1.0, prob=0.01)], [Sensor.nominal(0.25)], P, Beam(9)), 0, 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        u, jump = rng.standard_normal((200, N)), 100 + int(rng.integers(21))
        y = (u * np.where(np.arange(200)[:, None] < jump, 1.0, [2.0, 1.0])).sum(axis=1)
        y += 0.5 * rng.standard_normal(200)
        y[100:120] = np.nan
        events = track(Regression(N), bank, y, u).hypotheses.found()
        found += any(95 <= e.span.date <= 125 for e in events)
        false += any(not 95 <= e.span.date <= 125 for e in events)
    assert found >= 16  # 19 without a chain: a gap keeps two courses of each leaf
    assert false <= 2


def test_transitions_that_vary_in_time_are_summed_over():
    """A rate of jumps that hangs on a known covariate, with outputs missing; all courses, exactly enumerated."""
    P, q = CHAINS["both"]
    rng = np.random.default_rng(3)
    y, z = rng.standard_normal(9), rng.standard_normal((9, N))
    y[[3, 4, 7]] = np.nan
    rate = 1.0 / (1.0 + np.exp(3.0 - 2.0 * rng.standard_normal(9)))
    Pt = np.stack([np.array([[1.0 - r, r / 2, r / 2], *P[1:]]) for r in rate])
    bank = bank_of("both", Beam(1200))
    run = track(Regression(N), bank, y, z, prob=Pt)
    exact = every_course(Pt, bank.event_probabilities[1], q, z, y)
    assert reported(run, "evidence").sum() == pytest.approx(sum(one[0] for one in exact), abs=0.02)
    np.testing.assert_allclose(reported(run, "lag_prob")[-1, 0], exact[-1][1], atol=0.01)
    live = Live(Regression(N), bank)
    for t in range(9):
        live.update(y[t], z[t], prob=Pt[t])
        assert same(live.theta, run.theta[t]), t
    with pytest.raises(ValueError, match="rows of a chain"):
        track(Regression(N), bank, y, z, prob=Pt * 0.5)
    constant = track(Regression(N), bank, y, z)
    assert abs(reported(constant, "evidence").sum() - sum(one[0] for one in exact)) > 0.1
