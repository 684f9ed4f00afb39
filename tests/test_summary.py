"""The summary, the comparison that every result carries, bands and pictures."""

import math
import warnings

import numpy as np
import pytest
from scipy import stats
from support import THETA, arx_record, damaged, rows_of, same

from driftfit import ARX, RLS, AugmentedFLS, Kalman, Regression, track
from driftfit.judge.compare import compare, persistence
from driftfit.judge.statistics.paired import newey_west, paired
from driftfit.show.text import WIDTH, digits, printed, table_of, together

K = Kalman(q=1e-3, r=0.1)


def least_squares_predictions(phi, y):
    """For every sample the prediction of least squares (of least norm) on the complete rows before it."""
    expected, rows, seen = np.full(len(y), np.nan), [], []
    for t, row in enumerate(phi):
        if np.isfinite(row).all():
            expected[t] = row @ np.linalg.lstsq(np.array(rows), np.array(seen))[0] if rows else 0.0
            if np.isfinite(y[t]):
                rows.append(row)
                seen.append(y[t])
    return expected


def lagged(signal, lag):
    return np.concatenate([np.full(lag, np.nan), signal[: len(signal) - lag]])


def test_comparison_is_what_plain_numpy_gives():
    T = 300
    theta = THETA + 0.3 * np.sin(np.arange(T) / 40.0)[:, None] * [0.0, 0.0, 1.0, 1.0]
    y, u = arx_record(T, 1, theta=theta)
    run = track(ARX(2, 2), K, y, u)
    got = run.summary().comparison
    own = np.stack([lagged(y, 1), lagged(y, 2), lagged(u, 1), lagged(u, 2)], axis=1)
    simple = np.stack([lagged(y, 1), lagged(y, 2), lagged(u, 1), np.ones(T)], axis=1)
    scored = slice(50, None)  # max(50, 5 n), and everything is there

    def rms(prediction):
        return math.sqrt(np.mean((y - prediction)[scored] ** 2))

    assert got.samples == T - 50
    assert got.tracked == pytest.approx(rms(run.prediction), rel=1e-12)
    assert got.persistence == pytest.approx(rms(lagged(y, 1)), rel=1e-12)
    assert got.constant_ls == pytest.approx(rms(least_squares_predictions(own, y)), rel=1e-7)
    assert got.constant_arx == pytest.approx(rms(least_squares_predictions(simple, y)), rel=1e-7)
    assert got.tracked < got.constant_ls


def test_comparison_uses_the_samples_that_all_can_predict():
    """A regression with holes: the same samples for everyone, whatever each of them could do alone."""
    T = 200
    rng = np.random.default_rng(2)
    u = rng.standard_normal(T)
    y = 2.0 * u + 0.3 * rng.standard_normal(T)
    y[[100, 101, 150]], u[[60, 120]] = np.nan, np.nan
    run = track(Regression(1), K, y, u)
    got = compare(run)
    missing = {100, 101, 150} | {60, 61, 120, 121}  # outputs; inputs for the regression, and one later for ARX
    scored = np.array([t for t in range(50, T) if t not in missing])
    # after two outputs in a row are missing, ARX(2, 1) predicts on: two fills are allowed
    assert got.samples == len(scored)
    assert got.tracked == pytest.approx(np.sqrt(np.mean(run.innovation[scored] ** 2)), rel=1e-12)
    last = [y[np.flatnonzero(np.isfinite(y[:t]))[-1]] for t in scored]
    assert got.persistence == pytest.approx(np.sqrt(np.mean((y[scored] - last) ** 2)), rel=1e-12)
    expected = least_squares_predictions(u[:, None], y)
    assert got.constant_ls == pytest.approx(np.sqrt(np.mean((y - expected)[scored] ** 2)), rel=1e-7)


def test_persistence_is_the_last_observed_output():
    y = np.array([np.nan, 1.0, np.nan, np.nan, 4.0, 5.0])
    assert same(persistence(y), [np.nan, np.nan, 1.0, 1.0, 1.0, 4.0])


def test_a_short_record_is_compared_after_a_tenth_of_it():
    """After the first 50 of 55 samples no four errors would be compared; one of 100 has 50 left as ever."""
    y, u = arx_record(100, 3)
    for T, burn in ((30, 4), (55, 5), (99, 9), (100, 50)):
        run = track(ARX(2, 2), K, y[:T], u[:T])
        summary = run.summary()
        assert summary.burn == run.verdict().burn == burn
        assert summary.comparison.samples == T - burn
        scored = np.where(np.arange(T) >= burn, y[:T] - run.prediction, np.nan)
        assert summary.comparison.tracked == pytest.approx(np.sqrt(np.nanmean(scored**2)))


def test_comparison_without_inputs_and_with_times_and_weights():
    y, u = arx_record(200, 4)
    time = np.cumsum(np.where(np.arange(200) == 100, 5.0, 1.0))
    plain, timed = track(ARX(2, 2), K, y, u), track(ARX(2, 2), K, y, u, time=time, weights=np.full(200, 2.0))
    assert compare(timed).samples == compare(plain).samples - 2  # the lags across the gap
    own = track(ARX(2, 0), RLS(1.0), y).summary().comparison
    assert own.tracked == pytest.approx(own.constant_ls, rel=1e-12)


def test_numbers_of_the_summary():
    y, u = damaged(*arx_record(400, 5))
    run = track(ARX(2, 2), K, y, u)
    summary = run.summary()
    assert (summary.samples, summary.used, summary.burn) == (400, int(run.ok.sum()), 50)
    assert summary.loglik == run.loglik
    low, high = run.band()
    for i, row in enumerate(summary.rows):
        assert (row.name, row.theta, row.std) == (run.names[i], run.theta[-1, i], run.std[-1, i])
        assert (row.low, row.high) == (low[-1, i], high[-1, i])
        assert (row.path_low, row.path_high) == (run.theta[50:, i].min(), run.theta[50:, i].max())
    printed = rows_of(summary)
    for row in summary.rows:
        cells = (row.theta, row.std, row.low, row.high, row.path_low, row.path_high)
        assert [row.name, *(f"{value:.4g}" for value in cells)] in printed
    c = summary.comparison
    assert [f"{value:.5g}" for value in (c.tracked, c.persistence, c.constant_ls, c.constant_arx)] in printed
    skipped = summary.samples - summary.used
    assert f"Samples {summary.samples}, {summary.used} used, {skipped} skipped".split() in printed
    assert f"Log-likelihood {run.loglik:.6g}, AIC {run.aic():.6g}, BIC {run.bic():.6g}".split() in printed
    assert [*["Tracker"], *repr(K).split()] in printed
    assert max(map(len, str(summary).splitlines())) <= 96


def test_bands_are_normal_quantiles_of_std():
    run = track(ARX(2, 2), K, *arx_record(100, 7))
    for level, half in ((0.95, 1.959963984540054), (0.6826894921370859, 1.0), (0.5, 0.6744897501960817)):
        low, high = run.band(level)
        np.testing.assert_allclose(high - run.theta, half * run.std, rtol=1e-9)
        assert same(low[5:] + high[5:], 2.0 * run.theta[5:]) or np.allclose(low[5:] + high[5:], 2.0 * run.theta[5:])
    assert np.isinf(low[0]).all()
    assert np.isnan(track(ARX(2, 2), AugmentedFLS(1.0), *arx_record(100, 7)).band()[0]).all()


DAYS = np.datetime64("2024-01-01") + np.arange(300) * np.timedelta64(1, "D")
KINDS = {
    "Kalman": lambda y, u: track(ARX(2, 2), K, y, u),
    "damaged": lambda y, u: track(ARX(2, 2), K, *damaged(y, u)),
    "dates": lambda y, u: track(ARX(2, 2), K, y, u, time=DAYS, dt=np.timedelta64(1, "D")),
    "no covariance": lambda y, u: track(ARX(2, 2), AugmentedFLS(1.0), y, u),
    "RLS": lambda y, u: track(ARX(2, 2), RLS(0.98), y, u),
    "all missing": lambda y, u: track(ARX(2, 2), K, np.full(300, np.nan), u),
    "one sample": lambda y, u: track(ARX(2, 2), K, y[:1], u[:1]),
    "constant": lambda y, u: track(ARX(2, 2), RLS(1.0), np.ones(300), np.ones(300)),
    "huge value": lambda y, u: track(ARX(2, 2), K, np.where(np.arange(300) == 200, 1e200, y), u),
}


@pytest.mark.parametrize("name", KINDS)
def test_pictures_are_drawn_without_warnings(name, tmp_path):
    run = KINDS[name](*arx_record(300, 9))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        figure = run.plot()
        figure.savefig(tmp_path / "run.png", dpi=40)
        printed = rows_of(run.summary())
    assert [f"{run.theta[-1, 0]:.4g}", f"{run.std[-1, 0]:.4g}"] in [row[1:3] for row in printed]
    lines = {axis.get_ylabel(): [line.get_ydata() for line in axis.get_lines()] for axis in figure.axes}
    assert lines.keys() == {*run.names, "y", "innovation"}
    low, high = run.band()
    for i, name in enumerate(run.names):
        assert same(lines[name][0], run.theta[:, i])
        band = next(axis for axis in figure.axes if axis.get_ylabel() == name).collections[0]
        edges = [set(path.vertices[:, 1]) for path in band.get_paths()]
        assert bool(edges) == bool(np.isfinite(low[:, i]).any())
        assert not edges or {low[-1, i], high[-1, i]} <= set.union(*edges)
    assert same(lines["y"][0], run.y)
    assert same(lines["y"][1], np.where(np.isinf(run.innovation_std), np.nan, run.prediction))
    assert same(lines["innovation"][0], run.innovation)
    assert (tmp_path / "run.png").stat().st_size > 2000


def test_a_track_says_what_it_is():
    run = track(ARX(2, 2), K, *arx_record(100, 10))
    assert repr(run).startswith("Track of 100 samples, 98 used: ARX(")
    assert len(run) == 100
    assert run.time.tolist() == list(range(100))


def test_numbers_have_the_digits_that_their_standard_deviation_determines():
    """Prices, and temperatures in kelvin: 29998.6 +- 0.8 read 3e+04, and so did both ends of its band."""
    for value, std, text in (
        (29998.62, 0.789, "29998.6"), (-295.1534, 0.002, "-295.153"), (1.0042, 0.02, "1.004"),
        (1.5e12, 1.0, "1500000000000"),
        (0.0, 1.0, "0"), (3e4, np.inf, "3e+04"), (3e4, np.nan, "3e+04"), (np.nan, 1.0, "nan"), (3e4, 0.0, "3e+04"),
    ):  # fmt: skip
        assert digits(value, std) == text
    assert digits(30.04, 0.8, 3) == "30"
    assert digits(29998.62, 0.8, 3) == "29998.6"


@pytest.mark.parametrize("group", [1, 2])
def test_a_table_of_more_columns_than_fit_continues_below(group):
    heads = [f"number{i}" for i in range(20)]
    table = table_of("Numbers", "", "samples", *heads, group=group)
    table.add_row("first", "50", *(f"{i}.{i:05d}" for i in range(20)))
    text = printed(table)
    lines = [line.split() for line in text.splitlines()]
    assert all(head in text and f"{i}.{i:05d}" in text for i, head in enumerate(heads))
    assert max(map(len, text.splitlines())) <= WIDTH
    tables = [line[1:] for line in lines if line[:1] == ["first"]]
    assert len(tables) > 2
    assert group == 1 or [len(row) % 2 for row in tables] == [1] + [0] * (len(tables) - 1)
    assert len(printed(table_of("Numbers", "", *heads[:8])).splitlines()) == 4


def test_numbers_beside_each_other_have_the_digits_that_differ():
    """Prices of 31,234 as 3.123e+04 would all be the same; without a standard deviation their difference decides."""
    assert together(31234.4, 31240.1, std=300.0) == ("31234", "31240")
    assert together(31234.41, 31234.93, 31240.0, std=0.4) == ("31234.4", "31234.9", "31240")
    assert together(31234.41, 31234.93) == ("31234.4", "31234.9")
    assert together(4.0227, 3.485, 3.4858, std=0.05) == ("4.023", "3.485", "3.486")
    assert together(0.1, 0.1 + 1e-15, float("nan")) == ("0.1", "0.1", "nan")


@pytest.mark.parametrize("unit", [1.0, 1e6])
def test_a_level_that_nothing_explains_calls_for_a_constant(unit):
    y, u = arx_record(200, 4)
    high = unit * (y + 20.0 * y.std())
    high[[3, 50, 120]] = np.nan, -999.0, 1e9

    def notes(model, y, u):
        return [
            text for name, text in track(model, RLS(1.0), y, u, gate=True).summary().remarks if name.startswith("No ")
        ]

    (note,) = notes(ARX(1, 1), high, u)
    assert note.endswith("the inputs about 0: intercept=True is missing")
    for model, output, inputs in (
        (ARX(1, 1, intercept=True), high, u),
        (ARX(1, 1), y, u),
        (ARX(1, 1), high, u + 5.0),
        (Regression(2), high, np.column_stack([u, np.ones(200)])),
    ):
        assert not notes(model, output, inputs)


def test_a_cell_shows_the_band_of_few_residuals():
    """Student's, as `Track.band`: with two residuals it is twice as wide."""
    run = track(Regression(1), RLS(1.0), [1.0, 2.5, 2.0], [1.0, 2.0, 3.0])
    for end in run.band():
        assert digits(float(end[-1, 0]), float(run.std[-1, 0])) in run._repr_html_()


def test_comparison_is_that_of_the_summary():
    y, u = damaged(*arx_record(400, 5))
    run = track(ARX(2, 2), Kalman(q=1e-3, r=0.1), y, u)
    result, comparison = run.verdict(), run.summary().comparison
    rms = {rival.name: rival.rms for rival in result.rivals}
    assert (result.rms, rms["persistence"], rms["constant LS"], rms["constant ARX"]) == comparison[:4]
    assert result.scored == comparison.samples
    assert result.samples == int(run.ok.sum())


def test_paired_is_the_textbook_formula():
    rng = np.random.default_rng(3)
    own, rival = rng.normal(size=(2, 300))
    d = rival**2 - own**2
    centred, lags = d - d.mean(), int(4 * 3 ** (2 / 9))
    v = np.mean(centred**2) + 2 * sum(
        (1 - k / (lags + 1)) * np.sum(centred[k:] * centred[:-k]) / 300 for k in range(1, lags + 1)
    )
    got = paired("rival", rival, own)
    assert newey_west(d) == pytest.approx(v, rel=1e-12)
    assert got.t == pytest.approx(d.mean() / np.sqrt(v / 300), rel=1e-12)
    assert got.p == pytest.approx(stats.norm.sf(got.t), rel=1e-9)
    assert got.rms == pytest.approx(np.sqrt(np.mean(rival**2)))


def test_paired_where_every_difference_is_the_same_and_in_any_unit():
    """Persistence on a ramp is wrong by one step at every sample."""
    better, worse = (
        paired("persistence", *pair) for pair in ((np.ones(50), np.zeros(50)), (np.zeros(50), np.ones(50)))
    )
    assert (better.t, better.p, worse.t, worse.p) == (np.inf, 0.0, -np.inf, 1.0)
    assert paired("itself", np.ones(50), np.ones(50))[2:] == (0.0, 0.5)
    own, rival = np.random.default_rng(3).normal(size=(2, 300))
    assert paired("rival", 1e-90 * rival, 1e-90 * own)[2:] == pytest.approx(paired("rival", rival, own)[2:], rel=1e-9)
