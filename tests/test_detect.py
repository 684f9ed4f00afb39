"""Alarms: rates of false alarms by simulation, what they find, and how they are scored."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from driftfit.judge.alarms.calibration import _least, begun_over, innovations, limits_of, null_records, residuals
from driftfit.judge.alarms.onsets import (
    chance,
    held,
    mean_limit,
    mean_rate,
    normal_limit,
    onsets,
    power_limit,
    power_rate,
)
from scipy import signal, stats
from support import Doubtful, arx_record, rows_of

from driftfit import ARX, AugmentedFLS, HammersteinWiener, Kalman, Regression, track
from driftfit.engine.kernel import kernel
from driftfit.judge.alarms.detect import Alarms
from driftfit.judge.statistics.robust import core
from driftfit.run.live.rule import AlarmRule, normal_scores
from driftfit.trackers.kalman import INDEPENDENT

K = Kalman(q=1e-3, r=0.01)


def moving(values, window):
    total = np.concatenate([[0.0], np.cumsum(values)])
    return total[window:] - total[:-window]


@pytest.mark.parametrize("window", [4, 20, 100])
@pytest.mark.parametrize("every", [100.0, 1000.0])
def test_onset_limits_have_the_rate_that_they_promise(window, every):
    """A million normal numbers: the count of onsets is within four standard errors of the promise."""
    g = np.random.default_rng(window).normal(size=1_000_000)
    for limit, series in (
        (power_limit(window, every), moving(g**2, window)),
        (mean_limit(window, every), np.abs(moving(g, window))),
    ):
        found, expected = len(onsets(series > limit)), 1e6 / every
        assert abs(found - expected) < 4.0 * np.sqrt(2.0 * expected)


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


@pytest.mark.parametrize(("reference", "error"), [(None, 0.04), (2000, 0.07)])
def test_innovation_alarm_rate(reference, error):
    """A constant system: onsets at the rate that was set."""
    begun, expected = [], []
    for seed in range(20):
        u, v = np.random.default_rng(seed).normal(size=(2, 20_000))
        y = signal.lfilter([0.0, 1.0, 0.4], [1.0, -1.2, 0.5], u) + signal.lfilter([0.1], [1.0, -1.2, 0.5], v)
        raised = track(ARX(2, 2), Kalman(q=0.0, r=0.01), y, u).detect(
            "innovation", every=300.0, window=20, reference=reference
        )
        begun.append(len(raised.onsets))
        expected.append((20_000 - raised.start) / 300.0)
    check_rate(begun, expected, error)


def test_innovation_alarm_finds_louder_noise_and_a_bias():
    y, u = arx_record(3000, 4)
    noise = 0.2 * np.random.default_rng(1).normal(size=3000)
    louder = track(ARX(2, 2), Kalman(q=0.0, r=0.01), y + np.where(np.arange(3000) > 2000, noise, 0.0), u)
    raised = louder.detect("innovation", every=1e5)
    assert 2000 <= raised.onsets[0] < 2060
    assert raised.cause(int(raised.onsets[0])) == "power"
    offset = track(ARX(2, 2), Kalman(q=0.0, r=0.01), y + 0.3 * (np.arange(3000) > 2000), u).detect(
        "innovation", every=1e5
    )
    assert 2000 <= offset.onsets[0] < 2060
    assert "mean" in {offset.cause(t) for t in range(2000, 2200)}


def test_normal_scores_bound_outliers():
    known = np.sort(np.abs(np.random.default_rng(0).standard_t(2, size=2000)))
    g = np.random.default_rng(1).standard_t(2, size=100_000)
    scores = normal_scores(g, known)
    assert np.mean(scores**2) == pytest.approx(1.0, abs=0.06)
    assert np.abs(scores).max() < 4.0
    assert np.isnan(normal_scores(np.array([np.nan]), known)[0])


def test_probability_alarm_is_calibrated_by_simulation():
    u, v = np.random.default_rng(2).normal(size=(2, 5000))
    run = track(Regression(1), Doubtful(q=0.0, r=1.0), u + v, u)
    raised = run.detect("probability", every=250.0)
    # onsets of independent exceedances: p (1 - p) = 1 / 250, known from 50 simulated alarms; limit = 1 - exp(-z^2 / 2)
    p = 2.0 * stats.norm.sf(np.sqrt(-2.0 * np.log(1.0 - raised.limits[0])))
    assert 250.0 * p * (1.0 - p) == pytest.approx(1.0, abs=2.0 / np.sqrt(50.0))
    assert abs(len(raised.onsets) - 4950 * p * (1.0 - p)) < 3.0 * np.sqrt(20.0)
    with pytest.raises(ValueError, match="Bank"):
        track(ARX(2, 2), K, *arx_record(100, 1)).detect("probability")


@pytest.mark.parametrize("allowed", [0.0, 3.0, 40.0])
def test_simulated_limit_is_the_least_above_which_onsets_are_few(allowed):
    series = [np.round(np.cumsum(x), 1) for x in np.random.default_rng(5).normal(size=(3, 200))]
    joined = np.concatenate([part for values in series for part in ([-np.inf], values)])
    limit = _least(*begun_over(joined, allowed), allowed)
    limits = np.unique(np.concatenate(series))
    begun = np.array([sum(len(onsets(values > c)) for values in series) for c in limits])
    assert (begun[limits >= limit] <= allowed).all()
    below = np.flatnonzero(limits < limit)
    assert not len(below) or begun[below[-1]] > allowed


def test_limits_of_several_rates_are_those_of_each():
    rng = np.random.default_rng(6)
    made = [(np.abs(np.cumsum(rng.normal(size=(300, 2)), axis=0)), 20) for _ in range(3)]
    together = limits_of(made, 200.0, 25.0, 4.0)
    assert np.array_equal(together, [limits_of(made, every)[0] for every in (200.0, 25.0, 4.0)])


@dataclass(frozen=True)
class Mistaken(Kalman):
    """A Kalman filter whose gain is 1 where the innovation is beyond 2.8 deviations: it takes it for a jump."""

    @property
    def steps(self):
        return INDEPENDENT._replace(correct=leap)


ordinary = INDEPENDENT.correct


@kernel
def leap(s, l):
    ordinary(s, l)
    far = s.e[l] * s.e[l] > 8.0 * s.s[l]
    for i in range(s.theta.shape[0]):
        s.theta[i, l] += s.ok[l] * s.e[l] / s.phi[i, l] if far else 0.0


def test_mistakes_of_the_tracker_do_not_pass_for_noise():
    """Innovations after a false jump are large; the simulated noise has neither their tails nor their size."""
    for seed in (2, 3):
        u, v = np.random.default_rng(seed).normal(size=(2, 6000))
        u = np.sign(u) * (0.5 + np.abs(u))
        run = track(Regression(1), Mistaken(q=1e-3, r=1.0), u + v, u)
        drawn = residuals(run, 0, run.u)
        assert np.sqrt(np.mean(drawn**2)) == pytest.approx(1.0, abs=0.06)
        assert np.std(innovations(run)) > 1.05
        made = next(null_records(run, 100.0, -1, 0))
        assert core(innovations(made)) == pytest.approx(core(innovations(run)), rel=0.05)


def test_calibration_agrees_with_theory_where_theory_holds():
    y, u = arx_record(5000, 8)
    run = track(ARX(2, 2), Kalman(q=0.0, r=0.01), y, u)
    theory = run.detect("innovation", every=500.0, window=20)
    simulated = run.detect("innovation", every=500.0, window=20, calibrate=True)
    # both columns ring about as often, and together once in 500 samples, known from 50 alarms
    rates = [500.0 * rate(20)[0](c) for rate, c in zip((power_rate, mean_rate), simulated.limits, strict=True)]
    assert sum(rates) == pytest.approx(1.0, abs=2.0 / np.sqrt(50.0))
    assert min(rates) > 0.3
    assert simulated.limits == pytest.approx(theory.limits, rel=0.05)


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


def test_held_alarms():
    active = np.array([False, True, False, False, True, False, False, False])
    assert held(active, 0).tolist() == active.tolist()
    assert held(active, 2).tolist() == [False, True, True, True, True, True, True, False]
    assert onsets(held(active, 2)).tolist() == [1]


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
        assert row == [*raised.span(t), "b1", f"{raised.statistic[t, j]:.4g}", f"{raised.limits[j]:.4g}"]
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


def test_probabilities_show_their_limit():
    run = track(ARX(2, 2), K, *arx_record(200, 1))
    p = np.full((200, 1), 0.1)
    p[150:160] = 0.99995
    raised = Alarms(
        AlarmRule("probability", 50.0, ("probability",), (0.99987,)), p[:, 0] > 0.5, np.array([150]), p, 50, 0.1, run
    )
    text = " ".join(str(raised).split())
    assert "Limits probability 1 - 0.00013" in text
    assert "probability 1 - 5e-05 1 - 0.00013" in text
    assert drawn(raised.plot()) == [("probability", [0.99987], ["limit 1 - 0.00013"], [True])]
    half = replace(raised, rule=replace(raised.rule, limits=(0.5,), simulated=True))
    assert "Limits probability 0.5 (by simulation)" in " ".join(str(half).split())


@pytest.mark.parametrize(
    ("kind", "settings", "match"),
    [
        ("bands", {}, "kind"),
        ("band", {}, "the normal range of the parameters"),
        ("band", {"reference": {"b9": (0, 1)}}, "no parameter"),
        ("band", {"reference": {"b1": (1, 0)}}, "low <= high"),
        ("band", {"reference": 60}, "10 remain"),
        ("innovation", {"reference": {"b1": (0, 1)}}, "number of samples"),
        ("innovation", {"window": 2}, "window"),
        ("innovation", {"every": 1.0}, "every"),
    ],
)
def test_wrong_settings(kind, settings, match):
    run = track(ARX(2, 2), K, *arx_record(400, 1))
    with pytest.raises(ValueError, match=match):
        run.detect(kind, **settings)


def test_a_tracker_without_covariance_has_no_band():
    run = track(ARX(2, 2), AugmentedFLS(mu=10.0), *arx_record(400, 1))
    with pytest.raises(ValueError, match="no covariance"):
        run.detect("band", reference={run.names[0]: (0.0, 1.0)})


def test_a_calibration_needs_a_model_that_it_can_simulate():
    y, u = arx_record(200, 1)
    run = track(HammersteinWiener(1, 1), K, y, u)
    with pytest.raises(ValueError, match="calibration simulates"):
        run.detect("innovation", every=100.0, calibrate=True)


def test_chance_of_an_extreme():
    """Tiny where a fault is, not without one; from the rate of onsets, or simulated."""
    y, u = arx_record(3000, 4)
    run = track(ARX(2, 2), Kalman(q=0.0, r=0.01), y, u)
    quiet = run.detect("innovation")
    loud = track(ARX(2, 2), Kalman(q=0.0, r=0.01), y + 0.3 * (np.arange(3000) > 2000), u).detect("innovation")
    assert quiet.p > 0.01
    assert loud.p < 1e-6
    assert "p-value < 0.0001 is the probability that a record without a fault is this extreme" in map(
        " ".join, rows_of(loud)
    )
    # a record that just reaches the limit of one alarm in its own length does so in 1 - exp(-1/2) of cases, twice
    J, window = 2000, 20
    limit = power_limit(window, 2.0 * J)
    beyond = stats.chi2.sf(limit, window)
    assert chance(power_rate(window), limit, beyond, J) == pytest.approx(1.0 - np.exp(-0.5), abs=0.01)
    simulated = run.detect("innovation", every=500.0, calibrate=True)
    assert 0.0 < simulated.p <= 1.0
    assert np.isnan(track(ARX(2, 2), Kalman(q=0.0, r=0.01), y[:60], u[:60]).detect("innovation", window=50).p)


@pytest.mark.parametrize("rate", [(power_rate(20), moving, 2), (mean_rate(20), moving, 1)])
def test_chance_is_that_of_the_largest_of_many(rate):
    """The share of a thousand records of 300 sums whose largest is beyond a limit; onsets come in clusters."""
    (begins, start, top), sums, power = rate
    g = np.random.default_rng(7).normal(size=(1000, 319)) ** power
    largest = np.array([np.abs(sums(row, 20)).max() for row in g])
    for share, most in ((0.5, 0.65), (0.1, 0.16), (0.01, 0.025)):
        limit = float(np.quantile(largest, 1.0 - share))
        one = stats.chi2.sf(limit, 20) if power == 2 else 2.0 * stats.norm.sf(limit / np.sqrt(20.0))
        assert share < chance((begins, start, top), limit, one, 300) < most


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
    for alarms in (run.detect("innovation"), run.detect("band", reference={run.names[0]: (0.0, 1.0)})):
        assert f"none is judged: the run has {T}, and the first 50 do not count" in str(alarms)


def test_a_reference_within_the_start_of_a_run_says_what_remains():
    run = track(Regression(1), Kalman(q=0.0, r=1.0), np.ones(300), np.arange(1.0, 301.0))
    with pytest.raises(ValueError, match=r"samples 0 to 60 of a run of 300, whose first 50 .* 10 remain"):
        run.detect("innovation", reference=60)
    with pytest.raises(ValueError, match="ends at sample 400, and the run has 300"):
        run.detect("innovation", reference=400)


@pytest.mark.parametrize("reference", [200, (1.9, 2.1)])
@pytest.mark.parametrize("r", [1.0, 1e12])
def test_a_band_has_a_limit_where_the_estimate_hardly_moves(reference, r):
    """With a limit of 0 its rounding errors were alarms, beside p = 1."""
    u = np.random.default_rng(0).normal(size=600)
    run = track(Regression(1), Kalman(q=0.0, r=r), 2.0 * u, u)
    alarms = run.detect("band", reference=reference if reference == 200 else {run.names[0]: reference})
    assert alarms.limits == pytest.approx([1.645], abs=0.01)
    assert len(alarms.onsets) == 0


def test_a_cause_without_a_size_has_no_numbers_in_the_table():
    """Regressors that move together: the sum is that of one, and the largest likelihood ratio that of the other."""
    rng = np.random.default_rng(0)
    u = rng.normal(size=(600, 2)) @ [[1.0, 1.0], [0.0, 0.3]]
    drift = np.linspace(0.0, 0.12, 300)
    y = 2.0 * u[:, 0] + u[:, 1] + np.r_[np.zeros(300), drift] * u[:, 0] + 0.1 * rng.normal(size=600)
    alarms = track(Regression(2), Kalman(q=1e-4, r=0.01), y, u).detect("cusum", every=300, reference=250)
    assert [bool(np.isnan(alarms.change(int(t)).size)) for t in alarms.onsets] == [True]
    assert "nan" not in repr(alarms)
