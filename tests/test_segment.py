"""Segmentation: exact against brute force, breaks found, intervals that hold, outliers and correlation withstood."""

import numpy as np
import pytest
from scipy import signal

from driftfit import ARX, RLS, DataWarning, Regression, segment, track
from driftfit.smooth.piecewise import piecewise

AT = (133, 266)


def two_jumps(seed, size=0.8, kind="", rho=0.0, T=400):
    """A mean with two jumps in noise of 0.5."""
    rng, t = np.random.default_rng(seed), np.arange(T)
    e = signal.lfilter([np.sqrt(1.0 - rho * rho)], [1.0, -rho], rng.normal(size=T + 200))[200:]
    if kind == "outliers":
        e *= np.where(rng.random(T) < 0.05, 10.0, 1.0)
    return 5.0 + size * ((t >= AT[0]) & (t < AT[1])) + 0.5 * e


def test_two_jumps_are_found_every_time_and_as_well_as_by_ruptures():
    ruptures = pytest.importorskip("ruptures", reason="ruptures, to compare with, is not installed")
    ours = theirs = 0
    for seed in range(10):
        y = two_jumps(seed)
        found = [one.at for one in segment(y).breaks]
        assert len(found) <= 3
        ours += sum(any(abs(f - at) <= 20 for f in found) for at in AT)
        other = ruptures.Pelt("linear", min_size=10, jump=1).fit(np.column_stack([y, np.ones(400)]))
        theirs += sum(any(abs(f - at) <= 20 for f in other.predict(pen=0.25 * 2.0 * np.log(400))) for at in AT)
    assert ours == 20
    assert ours >= theirs


@pytest.mark.parametrize(("kind", "rho", "size"), [("", 0.0, 0.8), ("outliers", 0.0, 0.8), ("", 0.5, 1.2)])
def test_intervals_hold_their_level(kind, rho, size):
    """95 % of 32 dates, less three standard errors; and they are not the whole record."""
    inside, width = [], []
    for seed in range(16):
        segmentation = segment(two_jumps(seed, size, kind, rho))
        if len(segmentation.breaks) == 2:
            inside += [one.first <= at <= one.last for one, at in zip(segmentation.breaks, AT, strict=True)]
            width += [one.last - one.first for one in segmentation.breaks]
    assert len(inside) > 22
    assert np.mean(inside) > 0.95 - 3.0 * np.sqrt(0.05 * 0.95 / len(inside))
    assert np.median(width) < 25


@pytest.mark.parametrize(("shortest", "pulse"), [(None, 6), (None, 10), (20, 14), (20, 20), (7, 7)])
def test_no_segment_is_shorter_than_the_shortest(shortest, pulse):
    """Also where the parameters were moved for a shorter time; intervals then contain the true dates too."""
    inside = []
    for seed in range(16):
        rng = np.random.default_rng(seed)
        ends = np.array([0, pulse]) + 60 + rng.integers(0, 40)
        y = 3.0 * ((np.arange(200) >= ends[0]) & (np.arange(200) < ends[1])) + rng.normal(size=200)
        found = segment(y, shortest=shortest)
        assert min(part.stop - part.start for part in found.segments) >= (shortest or 10)
        assert all(one.first <= one.date <= one.last for one in found.breaks)
        inside += [one.first <= end <= one.last for one, end in zip(found.breaks, ends, strict=False)]
    assert np.mean(inside) > 0.95 - 3.0 * np.sqrt(0.05 * 0.95 / len(inside))


@pytest.mark.parametrize(("kind", "rho", "most"), [("", 0.0, 5), ("outliers", 0.0, 5), ("", 0.7, 5)])
def test_a_record_without_breaks_is_seldom_divided(kind, rho, most):
    """At 5 % of thirty, with three standard errors."""
    assert sum(bool(segment(two_jumps(seed, 0.0, kind, rho)).breaks) for seed in range(30)) <= most


def test_parameters_and_standard_errors_of_segments():
    """A gain that changes, of a regression with times; y of a thousand times the size gives the same dates."""
    rng = np.random.default_rng(2)
    u, t = rng.normal(size=(500, 2)), np.arange(500)
    y = np.where(t < 300, 1.0, 2.0) * u[:, 0] - u[:, 1] + 0.3 * rng.normal(size=500)
    y[100] = 1e4
    y[[50, 400]] = np.nan
    time = np.datetime64("2024-01-01") + t * np.timedelta64(1, "h")
    with pytest.warns(DataWarning, match=r"1 value looks like a fault code \(10000\)"):  # RLS suffers; segments do not
        run = track(Regression(2), RLS(1.0), y, u, time=time, dt=np.timedelta64(1, "h"))
    segmentation = run.segment()
    (only,) = segmentation.breaks
    assert only.at == pytest.approx(300, abs=3)
    assert only.date == time[only.at]
    assert only.first <= time[300] <= only.last
    for part, gain, count in zip(segmentation.segments, (1.0, 2.0), (298, 199), strict=True):
        assert np.abs((part.theta - [gain, -1.0]) / part.std).max() < 4.0
        assert part.std == pytest.approx(0.3 / np.sqrt(count), rel=3.5 / np.sqrt(count))  # of two standard deviations
    assert segmentation.theta.shape == (500, 2)
    assert str(only.date)[:13].replace("T", " ") in segmentation.summary()
    top, *panels = segmentation.plot().axes
    np.testing.assert_array_equal(top.lines[0].get_ydata(), run.y)
    for i, panel in enumerate(panels):
        drawn = [line.get_ydata()[0] for line in panel.lines[: len(segmentation.segments)]]
        assert drawn == [part.theta[i] for part in segmentation.segments]
        assert panel.lines[-1].get_xdata()[0] == only.date
    assert i == 1
    large = segment(1000.0 * y, u, Regression(2))
    assert [one.at for one in large.breaks] == [only.at]
    assert large.segments[0].theta == pytest.approx(1000.0 * segmentation.segments[0].theta)


def test_lags_of_the_output_and_records_that_cannot_be_divided():
    rng = np.random.default_rng(3)
    u, y = rng.normal(size=600), np.zeros(600)
    for t in range(1, 600):
        y[t] = 0.7 * y[t - 1] + (1.0 if t < 350 else 1.4) * u[t - 1] + 0.2 * rng.normal()
    segmentation = segment(y, u, ARX(1, 1))
    assert [one.at for one in segmentation.breaks] == pytest.approx([350], abs=3)
    assert segment(y[:15]).breaks == ()
    assert segment(np.full(100, 3.0)).segments[0].theta == pytest.approx([3.0])
    assert np.isnan(segment(np.full(100, np.nan)).segments[0].theta).all()
    for wrong in ({"level": 1.0}, {"false": 0.0}, {"shortest": 0}):
        with pytest.raises(ValueError, match="segment"):
            segment(y, **wrong)


def test_standard_errors_have_the_units_of_their_regressors():
    """Of inputs of 1e5 and 1e-7 one had an error of 1e-17 of its size: its direction counted as lost rank."""
    rng = np.random.default_rng(3)
    u = rng.normal(size=(400, 2))
    y = 3.0 + np.where(np.arange(400) < 200, 1.0, 1.6) * u[:, 0] + 0.5 * u[:, 1] + 0.4 * rng.normal(size=400)
    runs = [
        track(Regression(2, intercept=True), RLS(1.0), y, u * unit) for unit in ([1.0, 1.0], [1e5, 1e-7], [1e9, 1e-9])
    ]
    first, *others = (
        np.array(
            [moved.std for moved in run.verdict().parameters[:1]] + [x for s in run.segment().segments for x in s.std]
        )
        for run in runs
    )
    for unit, other in zip(([1e5, 1e-7, 1.0], [1e9, 1e-9, 1.0]), others, strict=True):
        np.testing.assert_allclose(other * np.array([unit[0], *unit, *unit]), first, rtol=1e-6)
    plain, far = (piecewise(run, [200]).std for run in (runs[0], runs[2]))
    np.testing.assert_allclose(far * [1e9, 1e-9, 1.0], plain, rtol=1e-6)


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("change", [1.0, 1e-3])
def test_an_exact_record_is_divided_where_it_changes_and_not_by_its_rounding(unit, change):
    for seed, T in ((2, 300), (5, 300), (0, 3000), (1, 3000)):
        u, t = np.random.default_rng(seed).normal(size=T), np.arange(T)
        found = segment(unit * ((2.0 + change * (t >= T // 2)) * u + 1.0), u)
        assert [one.at for one in found.breaks] == [T // 2]
    t = np.arange(300)
    assert [one.at for one in segment(unit * (7.0 + change * (t > 100))).breaks] == [101]


@pytest.mark.parametrize(("T", "error", "why"), [
    (300, "0", "constant parameters explain nine of ten outputs without error"),
    (12, "0", "12 samples can be used, and at least 20 are needed"),
    (2, "-", "2 samples can be used"),
])  # fmt: skip
def test_a_record_that_is_not_divided_has_errors_that_are_numbers_and_says_why(T, error, why):
    """An exact fit has standard errors of 0; too few samples have none."""
    u = np.random.default_rng(0).normal(size=T)
    text = str(segment(2.0 * u + 1.0, u))
    assert "nan" not in text
    assert [line.split()[3::2] for line in text.splitlines() if line.split()[1:2] == [str(T)]] == [[error, error]]
    assert f"not searched for breaks: {why}" in text


def test_a_record_that_is_too_short_has_the_errors_of_least_squares():
    rng = np.random.default_rng(0)
    X = np.column_stack([rng.normal(size=12), np.ones(12)])
    y = X @ [2.0, 1.0] + rng.normal(size=12)
    e = y - X @ np.linalg.lstsq(X, y)[0]
    std = np.sqrt(e @ e / 10.0 * np.diag(np.linalg.inv(X.T @ X)))
    np.testing.assert_allclose(np.sort(segment(y, X[:, 0]).segments[0].std), np.sort(std), rtol=1e-9)


@pytest.mark.parametrize("offset", [1e6, 1e8])
def test_an_offset_of_an_input_costs_no_digits(offset):
    """Moments of [1 + e, 1] have half of the digits of its rows: errors of 1e-11 for 1e-2, and no drift found."""
    rng = np.random.default_rng(0)
    x = rng.normal(size=400)
    y = 3.0 * x + 0.3 * x * (np.arange(400) >= 250) + 0.1 * rng.normal(size=400)
    plain, far = (track(Regression(1, intercept=True), RLS(1.0), y, x + shift) for shift in (0.0, offset))
    for one, other in zip(plain.segment().segments, far.segment().segments, strict=True):
        assert (one.start, one.std[0]) == (other.start, pytest.approx(other.std[0], rel=1e-3))
    assert piecewise(far, [250]).std[:, 0] == pytest.approx(piecewise(plain, [250]).std[:, 0], rel=1e-3)
    assert far.verdict().p == pytest.approx(plain.verdict().p, rel=1e-3)
    assert far.verdict().p < 1e-6


def resting(rest, seed, T=600):
    """y = 2 u + 3.7, and 4.7 from 300 on, where the input rests."""
    rng = np.random.default_rng(seed)
    u = np.where(np.arange(T) < 300, 5.0 * rng.normal(size=T), rest)
    return u, 2.0 * u + 3.7 + (np.arange(T) >= 300) + 0.1 * rng.normal(size=T)


@pytest.mark.parametrize("seed", [2, 3])
def test_where_an_input_rests_neither_its_gain_nor_the_intercept_is_known(seed):
    """The solution of least norm was reported, 1.1175 +- 0.0002 for 2, or one row of the other segment decided."""
    u, y = resting(20.0, seed)
    moving, still = segment(y, u).segments
    assert np.isfinite(moving.std).all()
    assert np.isinf(still.std).all()
    assert still.theta @ [20.0, 1.0] == pytest.approx(44.7, abs=0.05)
    far = segment(1e3 * y, 1e6 * u).segments[1]
    assert far.theta == pytest.approx(still.theta * [1e-3, 1e3], rel=1e-4)


def test_where_an_input_rests_at_zero_its_gain_is_held_and_the_intercept_is_estimated():
    u, y = resting(0.0, 1)
    found = segment(y, u)
    moving, still = found.segments
    assert still.theta[0] == pytest.approx(moving.theta[0], rel=1e-6)
    assert np.isinf(still.std[0])
    assert still.theta[1] == pytest.approx(4.7, abs=4.0 * still.std[1])
    assert still.std[1] == pytest.approx(0.1 / np.sqrt(300.0), rel=0.2)
    assert f"{still.start}: {found.run.model.names[0]} not determined in this segment" in str(found)
    found.plot()
    whole = segment(y[300:], u[300:])
    assert np.isinf(whole.segments[0].std).tolist() == [True, False]


@pytest.mark.parametrize("positive", [np.exp, np.abs])
def test_noise_that_grows_with_an_input_is_not_divided(positive):
    """An error of ten per cent: 97 and 83 % of records with constant parameters were."""
    divided = 0
    for seed in range(10):
        rng = np.random.default_rng(seed)
        u = positive(rng.normal(size=500))
        found = segment(2.0 * u * (1.0 + 0.1 * rng.normal(size=500)), u, Regression(1))
        divided += len(found.breaks) > 0
        assert abs(found.segments[0].theta[0] - 2.0) < 4.5 * found.segments[0].std[0]
    assert divided <= 1
    step = np.where(np.arange(500) < 250, 1.0, 1.2)
    assert [one.at for one in segment(2.0 * step * u * (1.0 + 0.1 * rng.normal(size=500)), u).breaks] == (
        pytest.approx([250], abs=10)
    )
