"""What a user gets of a bank: probabilities, events, alarms, the mixture; live as in a record; bad data."""

import numpy as np
import pytest
from support import arx_record, same
from test_bank import N, R, changes, record, reported

from driftfit import ARX, Bank, Kalman, Live, Regression, track
from driftfit.bank.change import Change
from driftfit.bank.reduction import IMM, Beam, Decide, Hybrid, Resample
from driftfit.bank.sensor import Sensor

JUMPS = (40, 90)
KNOWN = [Sensor.nominal(R)]
BANK = Bank(changes(), KNOWN, reduce=Beam(9), p0=2.0)


@pytest.fixture(scope="module")
def run():
    return track(Regression(N), BANK, *record(150, 5, JUMPS))


def test_probabilities_are_probabilities(run):
    hypotheses = run.hypotheses
    there = ~np.isnan(hypotheses.lag_prob[..., 0])
    np.testing.assert_allclose(hypotheses.lag_prob[there].sum(axis=1), 1.0, atol=1e-12)
    assert hypotheses.lags == (0, 1, 2, 3, 4, 5, 6, 23)
    assert there.sum(axis=1).tolist() == [min(t + 1, 7) + (t >= 23) for t in range(150)]  # one more level a sample
    with pytest.raises(ValueError, match="one of 0, 1, 2, 3, 4, 5, 6, 23"):
        hypotheses.prob(7)
    assert same(hypotheses.prob(3)[40], hypotheses.lag_prob[43, 3])
    assert same(hypotheses.mode_prob, hypotheses.lag_prob[:, 0])
    assert ((hypotheses.window >= -1e-12) & (hypotheses.window <= 1.0)).all()
    assert hypotheses.log_evidence == pytest.approx(hypotheses.evidence.sum())
    assert hypotheses.kept.min() > 0.8


def test_jumps_are_found_and_dated(run):
    events = run.hypotheses.events()
    assert [event.kind for event in events] == ["change", "change"]
    for event, jump in zip(events, JUMPS, strict=True):
        assert abs(event.date - jump) <= 2
        assert event.first <= jump <= event.last
        assert event.level == 0.95
        assert event.prob > 0.9
        assert event.known <= jump + 5
    table = run.hypotheses.table()
    assert table.height == 2
    assert table["theta1"].to_list() == [event.shift["theta1"] for event in events]
    assert table["std_theta2"].is_between(0.01, 0.3).all()
    assert table["sample"].to_list() == [event.span.date for event in events]
    dates = np.datetime64("2026-01-01") + np.arange(150) * np.timedelta64(2, "D")
    dated = track(Regression(N), BANK, run.y, run.u, time=dates, dt=np.timedelta64(2, "D")).hypotheses.events()
    assert [event.span for event in dated] == [event.span for event in events]
    for event in dated:
        assert (event.date, event.first, event.last, event.known) == tuple(dates[list(event.span)])
    assert "2 changes; see" in str(run.summary())
    *panels, below = run.hypotheses.plot().axes
    assert len(panels) == N
    for i, panel in enumerate(panels):
        assert any(same(line.get_ydata(), run.theta[:, i]) for line in panel.get_lines()), i
        assert {event.date for event in events} <= {line.get_xdata()[0] for line in panel.get_lines()}
    assert len(below.collections) == len(BANK.event_names)


def test_alarms_keep_to_their_rate(run):
    alarm = run.hypotheses.alarm(threshold=0.5)
    assert {event.known for event in run.hypotheses.events()} <= set(alarm.at.tolist())
    quiet = track(Regression(N), BANK, *record(2000, 6, ()))
    strict = quiet.hypotheses.alarm(rate=0.002, reference=quiet)
    assert len(strict.at) <= 4
    with pytest.raises(ValueError, match="threshold= or rate="):
        run.hypotheses.alarm()


@pytest.mark.parametrize("bank", [BANK, Bank()], ids=["known", "unknown noise"])
def test_the_mixture_is_what_the_track_says(bank):
    run = track(Regression(N), bank, *record(60, 5, (40,)))
    for t in (0, 45, 59):
        mixture = run.hypotheses.mixture(t)
        assert mixture.weights.sum() == pytest.approx(1.0)
        np.testing.assert_allclose(mixture.mean, run.theta[t], atol=1e-12)
        np.testing.assert_allclose(mixture.cov, run.cov(t), atol=1e-12)
    assert mixture.weights[(mixture.ages > 18) & (mixture.ages < 21)].sum() > 0.5
    assert mixture.ages.min() >= 0.0


def test_a_stream_says_what_the_record_says(run, tmp_path):
    y, u = run.y, run.u
    live, found = Live(Regression(N), BANK), []
    for t in range(150):
        live.update(y[t], u[t])
        hypotheses = live.hypotheses
        assert same(hypotheses.lag_prob[0], np.nan_to_num(run.hypotheses.lag_prob[t, 0])), t
        found += [(t, event) for event in hypotheses.events()]
        if t == 70:
            live.save(tmp_path / "state")
            live = Live.load(tmp_path / "state")
    wanted = run.hypotheses.found()
    assert [(e.span, e.name) for _, e in found] == [(e.span, e.name) for e in wanted]
    assert all(event.date + 23 <= t < event.date + 40 for t, event in found)
    np.testing.assert_allclose(live.hypotheses.mixture().mean, run.theta[-1])


def test_decisions_come_after_their_depth():
    run = track(Regression(N), Bank(changes(), KNOWN, reduce=Decide(3), p0=2.0), *record(100, 5, (40,)))
    decisions = run.hypotheses.decisions
    assert [d.sample for d in decisions] == list(range(98))
    assert {d.decided - d.sample for d in decisions} == {2}
    assert [d.sample for d in decisions if d.event] == [40]
    assert [d.sample for d in run.hypotheses.finish()] == [98, 99]
    held = track(Regression(N), Bank(changes(), KNOWN, reduce=Decide(5), p0=2.0), *record(44, 5, (40,)))
    assert [d.sample for d in held.hypotheses.finish()] == [40, 41, 42, 43]
    assert [d.event > 0 for d in held.hypotheses.finish()] == [True, False, False, False]
    brief = track(Regression(N), Bank(changes(), KNOWN, reduce=Decide(5), p0=2.0), *record(3, 5))
    assert brief.hypotheses.decisions == []
    assert [d.sample for d in brief.hypotheses.finish()] == [0, 1, 2]
    assert track(Regression(N), BANK, *record(3, 5)).hypotheses.finish() == []
    auto = track(
        Regression(N), Bank(changes(), KNOWN, reduce=Decide("auto", wait_cost=0.005), p0=2.0), *record(100, 5, (40,))
    )
    delays = [d.decided - d.sample for d in auto.hypotheses.decisions]
    assert min(delays) == 0
    assert max(delays) <= 5
    assert auto.hypotheses.leaves.mean() < run.hypotheses.leaves.mean()


def test_known_changes_are_found_at_once():
    y, u = record(100, 5, (40,))
    prob = np.full((100, 3), np.nan)
    prob[40] = 0.0, 1.0, 0.0
    run = track(Regression(N), BANK, y, u, prob=prob)
    assert run.hypotheses.prob()[40] == pytest.approx([0.0, 1.0, 0.0])
    live = Live(Regression(N), BANK)
    for t in range(100):
        live.update(y[t], u[t], **({"prob": prob[t]} if t == 40 else {}))
        assert same(live.theta, run.theta[t])
    scaled = track(Regression(N), BANK, y, u, drift=np.tile([0.0, 1.0, 1.0], (100, 1)))
    assert not same(scaled.theta, run.theta)
    one = track(Regression(N), BANK, y, u, drift=np.ones((100, 3)))
    assert same(one.theta, track(Regression(N), BANK, y, u).theta)


@pytest.mark.parametrize("reduce", [Beam(5), Resample(3), Decide(2), IMM(), Hybrid(5)], ids=str)
def test_what_is_not_used_moves_no_weight(reduce):
    """Also where it is missing for longer than the tree is deep."""
    y, u = record(60, 7, (30,))
    y[31:40] = np.nan
    P = [[0.97, 0.02, 0.01], [0.3, 0.6, 0.1], [0.2, 0.3, 0.5]]
    run = track(Regression(N), Bank(changes(), KNOWN, P, reduce, p0=2.0), y, u)
    assert same(run.theta[31:40], np.repeat(run.theta[30:31], 9, axis=0))
    assert (np.diff(run.std[30:40], axis=0) > 0.0).all()
    present = run.hypotheses.prob()
    np.testing.assert_allclose(present[32:40], present[31:39] @ np.array(P), atol=1e-12)


def test_an_impossible_sample_is_survived():
    """A prior that allows only a frozen sensor, before there was anything to freeze at."""
    y, u = record(30, 8, ())
    P = (None, [[0.9, 0.1], [0.1, 0.9]])
    bank = Bank(changes(), [Sensor.nominal(R), Sensor.frozen(0.01)], P, Beam(5), p0=2.0)
    prob = np.full((30, 6), np.nan)
    prob[0] = [0.0, 1.0, 0.0, 0.0, 0.0, 0.0]
    run = track(Regression(N), bank, y, u, prob=prob)
    with pytest.warns(UserWarning, match="1 samples were impossible"):
        hypotheses = run.hypotheses
    assert hypotheses.impossible == 1
    with pytest.warns(UserWarning, match="probability above 0"):
        assert "1 samples that every hypothesis ruled out" in str(run.summary())
    assert np.isfinite(run.theta).all()
    assert hypotheses.prob()[0, 0] == pytest.approx(0.0, abs=1e-12)


def test_a_frozen_sensor_is_named():
    y, u = record(120, 9, ())
    y[60:75] = y[59]
    P = (None, [[0.99, 0.01], [0.1, 0.9]])
    run = track(Regression(N), Bank(changes(), [Sensor.nominal(R), Sensor.frozen(0.01)], P, p0=2.0), y, u)
    (event,) = (event for event in run.hypotheses.events() if event.kind == "sensor")
    assert (event.name, event.first, event.last) == ("frozen", 60, 74)


def test_nothing_else_has_hypotheses():
    with pytest.raises(ValueError, match="Kalman has no hypotheses"):
        track(Regression(N), Kalman(0.1, 0.1), *record(5)).hypotheses  # noqa: B018
    with pytest.raises(ValueError, match="Kalman has no hypotheses"):
        Live(Regression(N), Kalman(0.1, 0.1)).hypotheses  # noqa: B018


def test_the_bank_without_settings_has_no_scale():
    y, u = arx_record(300, 3)
    one = track(ARX(2, 2), Bank(), y, u)
    other = track(ARX(2, 2), Bank(), 1e3 * y, 1e-2 * u)
    np.testing.assert_allclose(other.theta[20:, :2], one.theta[20:, :2], rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(other.theta[20:, 2:], 1e5 * one.theta[20:, 2:], rtol=1e-6, atol=1e-4)


@pytest.mark.parametrize("bank", [BANK, Bank()], ids=["known", "unknown noise"])
def test_an_operator_is_believed(bank):
    y, u = record(60, 5, ())
    live = Live(Regression(N), bank)
    for t in range(50):
        live.update(y[t], u[t])
    before = live.cov
    live.reset(p=[0.5, 0.0], theta=[3.0, 4.0])
    np.testing.assert_allclose(live.hypotheses.mixture().mean, [3.0, 4.0])
    np.testing.assert_allclose(live.cov - before, np.diag([0.5, 0.0]), atol=1e-12)
    np.testing.assert_allclose(live.hypotheses.mixture().cov, live.cov, atol=1e-9)
    live.update(None, u[50])
    np.testing.assert_allclose(live.theta, [3.0, 4.0])


def test_several_outputs_have_a_bank_each():
    bank, (y, u) = Bank(), record(60, 5, (40,))
    both = np.stack([y, -2.0 * y[::-1]], axis=1)
    run = track(Regression(N, ny=2), bank, both, u)
    for k, name in enumerate(run.outputs):
        alone = track(Regression(N), bank, both[:, k], u)
        assert same(run.theta[:, k], alone.theta), name
        assert same(run.std[:, k], alone.std), name
    live = Live(Regression(N, ny=2), bank)
    for t in range(60):
        live.update(both[t], u[t])
    assert same(live.theta, run.theta[-1])


def expected(leaves, p, s, r):
    """The least risk that is expected after the mean of s more samples, by plain integration over a grid."""
    y = np.linspace(-120.0, 120.0, 40_001)
    f = np.zeros((2, len(y)))
    for e, (w, m, C) in enumerate(leaves):
        for p_next, q in zip(p, (1e-4, 9.0), strict=True):
            std = np.sqrt(r / s + SIGHT @ (C + q * np.eye(N)) @ SIGHT)
            f[e] += w * p_next * np.exp(-0.5 * ((y - SIGHT @ m) / std) ** 2) / (std * np.sqrt(2.0 * np.pi))
    return f.min(axis=0).sum() * (y[1] - y[0])


SIGHT = np.array([1.0, -0.5])


@pytest.mark.parametrize(("ahead", "decided"), [(1, 34), (4, 31)])
def test_waiting_pays_if_some_number_of_samples_does(ahead, decided):
    """The decision after one sample of variance 64, against the rule with risks by plain integration."""
    p, r, cost = np.array([0.8, 0.2]), 64.0, 0.01
    reduce = Decide("auto", max_depth=6, tau=1e-9, wait_cost=cost, ahead=ahead)
    bank = Bank([Change(1e-4), Change(9.0, prob=0.2)], [Sensor.nominal(r)], reduce=reduce, p0=0.1)
    ruled, rule, near = [], [], []
    for y in np.linspace(0.0, 30.0, 41):
        run, leaves = track(Regression(N), bank, [y], [SIGHT]), []
        for chance, q in zip(p, (1e-4, 9.0), strict=True):
            C = (0.1 + q) * np.eye(N)
            s = r + SIGHT @ C @ SIGHT
            density = np.exp(-0.5 * y * y / s) / np.sqrt(s)
            leaves.append((chance * density, C @ SIGHT / s * y, C - np.outer(C @ SIGHT, C @ SIGHT) / s))
        total = sum(leaf[0] for leaf in leaves)
        leaves = [(w / total, m, C) for w, m, C in leaves]
        risk = min(leaf[0] for leaf in leaves)
        gains = [risk - k * cost - expected(leaves, p, k, r) for k in range(1, ahead + 1)]
        ruled.append(bool(reported(run, "decided")[0, 0, 0] >= 0.0))
        rule.append(max(gains) <= 0.0)
        near.append(abs(max(gains)) < 1e-5)
    assert [a == b or c for a, b, c in zip(ruled, rule, near, strict=True)] == [True] * 41
    assert sum(ruled) == decided
