"""Alarms: rates of false alarms by simulation, what they find, and how they are scored."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import signal, stats
from support import arx_record, rows_of

from driftfit import ARX, JointKalman, Kalman, Live, Regression, StateSpace, track
from driftfit.judge.alarms.band import normal_limit
from driftfit.judge.alarms.detect import Alarms, onsets
from driftfit.run.live.rule import AlarmRule

K = Kalman(q=1e-3, r=0.01)


def moving(values, window):
    total = np.concatenate([[0.0], np.cumsum(values)])
    return total[window:] - total[:-window]


def jump_record(T=3000, at=2000, size=1.0, seed=3):
    path = np.tile([1.2, -0.5, 1.0, 0.4], (T, 1))
    path[at:, 2] += size
    return arx_record(T, seed, theta=path)


def test_band_alarm_finds_a_jump_and_names_it():
    run = track(ARX(2, 2), K, *jump_record())
    raised = run.detect("band", every=1e5, reference={"b1": (0.7, 1.3), "b2": (0.1, 0.7)})
    assert len(raised.onsets) >= 1
    assert 2000 <= raised.onsets[0] < 2040
    assert raised.cause(int(raised.onsets[0])) == "b1"
    assert (raised.limits < stats.norm.isf(1.0 / 2e5)).all()  # what begins is rarer than what exceeds
    assert (raised.limits > stats.norm.isf(1.0 / 2e3)).all()
    outside = np.maximum(run.theta[:, 2] - 1.3, 0.7 - run.theta[:, 2]) / run.std[:, 2]
    assert raised.statistic[100:, 0] == pytest.approx(outside[100:])
    learned = run.detect("band", every=1e5, reference=1500)
    assert learned.start == 1500
    assert learned.onsets[0] >= 2000


@pytest.mark.parametrize("rho", [0.0, 0.6, 0.95])
def test_limit_of_a_correlated_sequence(rho):
    """The count of onsets in a million samples of an autoregression is within four standard errors of the promise."""
    w = np.random.default_rng(3).normal(size=1_000_000)
    z = signal.lfilter([np.sqrt(1.0 - rho * rho)], [1.0, -rho], w)
    found = len(onsets(z > normal_limit(rho, 500.0)))
    assert abs(found - 2000.0) < 4.0 * np.sqrt(2.0 * 2000.0)


def check_rate(begun, expected, error):
    """As many alarms as promised, within four standard errors of records (n,), which must themselves be small."""
    rates = np.array(begun) / np.array(expected)
    spread = rates.std() / np.sqrt(len(rates))
    assert spread < error
    assert abs(rates.mean() - 1.0) < 4.0 * spread


def test_band_alarm_rate_at_the_edge_of_the_band():
    """Parameters that walk and stand at the edge: alarms begin as often as promised."""
    begun, limit = [], None
    for seed in range(24):
        rng = np.random.default_rng(seed)
        u, theta = rng.normal(size=10_000), 1.0 + np.cumsum(0.03 * rng.normal(size=10_000))
        run = track(Regression(1), Kalman(q=9e-4, r=0.25), theta * u + 0.5 * rng.normal(size=10_000), u)
        z = (run.theta[:, 0] - theta) / run.std[:, 0]  # how far outside a band that ends at the truth
        limit = limit or run.detect("band", every=200.0, reference={"theta1": (0.0, 1.0)}).limits[0]
        begun.append(len(onsets(z[50:] > limit)))
    check_rate(begun, 9950 / 200.0, 0.04)


def test_the_innovations_are_judged_where_there_is_no_regression():
    model = StateSpace("x = 0.9 * x[-1] + theta.b * u \n y = x + theta.c")
    begun, named = 0, []
    for seed in range(3):
        rng, at = np.random.default_rng(seed), np.arange(2000)
        u, v = rng.normal(size=2000), 0.1 * rng.normal(size=2000)
        y = signal.lfilter([1.0], [1.0, -0.9], u) + 1.0 + v
        for moved in (np.where(at >= 1500, 0.3, 0.0), np.where(at >= 1500, 2.0 * v, 0.0)):
            run = track(model, JointKalman(q={}, r=0.01, p0=1.0), y + moved, u)
            alarms = run.detect(every=1000.0, reference=1000, records=32)
            begun += int(np.sum(alarms.onsets < 1500))
            found = alarms.onsets[alarms.onsets >= 1500]
            named.append((alarms.cause(min(int(found[0]) + 30, 1999)), int(found[0]) < 1530))
    assert begun <= 6
    assert named == 3 * [("offset", True), ("noise", True)]
    live = Live(model, run.tracker)
    alarm = live.detect(alarms.rule, wait=0)
    for t in range(2000):
        live.update((y + moved)[t], u[t])
    assert alarm.statistic.tolist() == run.detect(alarms.rule, start=0).statistic[-1].tolist()


def test_score_by_hand():
    active = np.zeros(20, bool)
    active[[3, 8, 9, 15]] = True
    labels = np.zeros(20, int)
    labels[6:12] = 1
    labels[17:] = 1
    rule = AlarmRule("band", 10.0, ("b1",), (1.0,))
    raised = Alarms(rule, active, onsets(active), np.zeros((20, 1)), 2, 0.5, None)
    assert raised.score(labels) == (2, 1, 2.0, 2, 9)
    unmarked = np.where(labels == 1, 1.0, np.nan)  # a missing label marks nothing
    assert raised.score(unmarked) == raised.score(labels)
    for wrong in (labels + 0.5, np.where(labels, "fault", "ok"), labels[1:]):
        with pytest.raises(ValueError, match="labels"):
            raised.score(wrong)
    # an alarm that was on before the label is false, and finds nothing however long it stays
    early = np.zeros(20, bool)
    early[5:10] = True
    got = replace(raised, active=early, onsets=onsets(early)).score(labels)
    assert (got.found, got.false, np.isnan(got.delay)) == (0, 1, True)
    again = early.copy()
    again[8] = False
    assert replace(raised, active=again, onsets=onsets(again)).score(labels) == (2, 1, 3.0, 1, 9)
    with pytest.raises(ValueError, match="20 samples"):
        raised.score(labels[:5])


def test_table_says_what_was_found():
    run = track(ARX(2, 2), K, *jump_record())
    raised = run.detect("band", every=1e4, reference=1500)
    lines = rows_of(raised)
    found = {line[0]: line for line in lines}
    limits = " ".join(f"{name} {limit:.4g}," for name, limit in zip(run.names, raised.limits, strict=True))
    assert " ".join(found["Limits"][1:]) == limits.rstrip(",")
    assert " ".join(found["Alarm"]) == "Alarm band, one false alarm in 10000 samples"
    assert " ".join(found["Samples"]) == "Samples 1500 judged from sample 1500 on; 0.15 false alarms expected"
    rows = lines[next(i for i, line in enumerate(lines) if line[:2] == ["from", "to"]) + 2 :]
    for t, row in zip(raised.onsets, rows, strict=False):
        j = raised.names.index(raised.cause(t))
        assert row == [
            *raised.span(t),
            "b1",
            f"{raised.statistic[raised.clearest(t), j]:.4g}",
            f"{raised.limits[j]:.4g}",
        ]
    assert len(rows) == len(raised.onsets)


def drawn(figure):
    """(label of the axis, heights of dashed lines, legend, what is shaded) of every picture but the first."""
    return [
        (
            axis.get_ylabel(),
            [line.get_ydata()[0] for line in axis.get_lines() if line.get_linestyle() == "--"],
            [text.get_text() for text in axis.get_legend().get_texts()],
            [len(part.get_paths()) > 0 for part in axis.collections],
        )
        for axis in figure.axes[1:]
    ]


def test_picture_shows_statistics_over_limits_alarms_and_labels():
    run = track(ARX(2, 2), K, *jump_record())
    raised = run.detect("band", every=1e4, reference=1500)
    figure = raised.plot(np.arange(3000) > 2000)
    limits = [f"limit {limit:.4g}" for limit in raised.limits]
    shaded = [True, True]  # alarms, labels
    assert drawn(figure) == [(name, [1.0], [text], shaded) for name, text in zip(raised.names, limits, strict=True)]
    for j, axis in enumerate(figure.axes[1:]):
        assert axis.get_lines()[0].get_ydata() == pytest.approx(raised.statistic[:, j] / raised.limits[j], nan_ok=True)
    assert figure.axes[0].get_lines()[0].get_ydata() == pytest.approx(run.y)


@pytest.mark.parametrize(
    ("kind", "settings", "match"),
    [
        ("bands", {}, "kind"),
        ("band", {}, "the normal range of the parameters"),
        ("band", {"reference": {"b9": (0, 1)}}, "no parameter"),
        ("band", {"reference": {"b1": (1, 0)}}, "low <= high"),
        ("band", {"reference": 60}, "10 remain"),
        ("glr", {"reference": {"b1": (0, 1)}}, "number of samples"),
        ("glr", {"records": 2}, "records"),
        ("glr", {"every": 1.0}, "every"),
        ("innovation", {}, "'glr', 'band'"),
    ],
)
def test_wrong_settings(kind, settings, match):
    run = track(ARX(2, 2), K, *arx_record(400, 1))
    with pytest.raises(ValueError, match=match):
        run.detect(kind, **settings)


def test_the_cause_of_an_alarm_whose_limit_is_zero():
    rule = AlarmRule("band", 1000.0, ("a", "b"), (0.0, 0.0))
    assert rule.cause(np.array([0.0, 0.1])) == 1


@pytest.mark.parametrize("T", [1, 2, 5, 30])
def test_a_run_that_is_too_short_says_so(T):
    """No sentence speaks of samples 50 to 1, of a reference of 0, or of alarms among no sample."""
    run = track(Regression(1), Kalman(q=0.0, r=1.0), np.ones(T), np.arange(1.0, T + 1.0))
    for given in ({}, {"reference": 20}, {"kind": "band", "reference": T}):
        with pytest.raises(ValueError, match=rf"a run of {T} samples is too short for a reference: its first 50"):
            run.detect(**given)
    alarms = run.detect("band", reference={run.names[0]: (0.0, 1.0)})
    assert f"none is judged: the run has {T}, and the first 50 do not count" in str(alarms)


def test_a_reference_within_the_start_of_a_run_says_what_remains():
    run = track(Regression(1), Kalman(q=0.0, r=1.0), np.ones(300), np.arange(1.0, 301.0))
    with pytest.raises(ValueError, match=r"samples 0 to 60 of a run of 300, whose first 50 .* 10 remain"):
        run.detect(reference=60)
    with pytest.raises(ValueError, match="ends at sample 400, and the run has 300"):
        run.detect(reference=400)


@pytest.mark.parametrize("reference", [200, (1.9, 2.1)])
@pytest.mark.parametrize("r", [1.0, 1e12])
def test_a_band_has_a_limit_where_the_estimate_hardly_moves(reference, r):
    """With a limit of 0 its rounding errors were alarms, beside p = 1."""
    u = np.random.default_rng(0).normal(size=600)
    run = track(Regression(1), Kalman(q=0.0, r=r), 2.0 * u, u)
    alarms = run.detect("band", reference=reference if reference == 200 else {run.names[0]: reference})
    assert alarms.limits == pytest.approx([1.645], abs=0.01)
    assert len(alarms.onsets) == 0


def test_what_changed_is_not_known_at_once():
    """A large step is noticed at its first sample; the third after it shows what it is."""
    rng = np.random.default_rng(0)
    u, v = rng.normal(size=(2, 800))
    y = u + 0.1 * v + 5.0 * (np.arange(800) >= 600)
    alarms = track(Regression(1), Kalman(q=0.0, r=0.01), y, u).detect(every=1000.0, reference=500)
    (t,) = alarms.onsets[alarms.onsets >= 600]
    assert [alarms.cause(s) for s in range(t, 604)] == ["not known yet"] * (603 - t) + ["offset"]
    assert alarms.change(603).since == 600
    assert np.isnan(alarms.change(t).size)
    assert alarms.change(500) is None
    assert "nan" not in repr(alarms)
    assert alarms.table["cause"][-1] == "offset"
    assert alarms.table["since"][-1] == "600"
