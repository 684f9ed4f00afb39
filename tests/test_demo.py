"""The demo's sentence is recomputed without the library; its parts print what they say."""

import re
import sys
from io import StringIO

import numpy as np
import pytest
from rich.console import Console

from driftfit.demo import demo


@pytest.fixture(scope="module")
def record():
    return demo.read_record()


@pytest.fixture(scope="module")
def found(record):
    return demo.search(record)


def naive(record, q, r, kappa=1e8):
    """Textbook filter from a wide prior: paths of theta and P, innovations and their variances."""
    y, u = record.y, record.u
    theta, P = np.zeros(4), kappa * np.eye(4)
    paths, stds, e, s = [], [], [], []
    for t in range(1, len(y)):
        phi = np.array([y[t - 1], u[t, 0], u[t, 1], 1.0])
        P = P + np.diag(q)
        s.append(phi @ P @ phi + r)
        e.append(y[t] - phi @ theta)
        k = P @ phi / s[-1]
        theta = theta + k * e[-1]
        ikp = np.eye(4) - np.outer(k, phi)
        P = ikp @ P @ ikp.T + r * np.outer(k, k)
        paths.append(theta)
        stds.append(np.sqrt(np.diag(P)))
    return np.array(paths), np.array(stds), np.array(e), np.array(s)


def naive_loglik(record, q, r, kappa=1e8):
    """The diffuse log-likelihood: that of the wide prior, and (n / 2) log(2 pi kappa) for its n directions.

    A diffuse sample counts -1/2 log F here, without 2 pi.
    """
    _, _, e, s = naive(record, q, r, kappa)
    return -0.5 * np.sum(np.log(2.0 * np.pi * s) + e**2 / s) + 2.0 * np.log(2.0 * np.pi * kappa)


def test_record_is_complete_and_in_order(record):
    assert len(record.time) == 203
    assert record.time[0] == 1959.0
    assert record.time[-1] == 2009.5
    assert (np.diff(record.time) == 0.25).all()
    assert np.isfinite(record.y).all()
    assert np.isfinite(record.u).all()


def test_sentence_says_what_a_textbook_filter_says(record, found):
    output = re.match(
        r"The coefficient of (\w+) went from ([\d.]+) \(standard error ([\d.]+)\) in (\d+) Q(\d) to ([\d.]+) "
        r"\(standard error ([\d.]+)\) in (\d+) Q(\d), .* log-likelihood by ([\d.]+) over no drift\.$",
        demo.sentence(found),
    )
    assert output
    assert output[1] == "income"
    settings = found.run.tracker.settings()
    theta, std, _, _ = naive(record, np.array(settings["q"]), settings["r"])
    for value, error, year, quarter in (output.group(2, 3, 4, 5), output.group(6, 7, 8, 9)):
        t = (int(year) - 1959) * 4 + int(quarter) - 1
        assert float(value) == pytest.approx(theta[t - 1, 1], abs=6e-4)
        assert float(error) == pytest.approx(std[t - 1, 1], abs=6e-4)
    still = found.still.tracker.settings()["r"]
    gain = naive_loglik(record, np.array(settings["q"]), settings["r"]) - naive_loglik(record, np.zeros(4), still)
    assert float(output[10]) == pytest.approx(gain, abs=0.1)


def test_move_is_the_largest_within_two_years(found):
    path = found.run.theta[:, demo.INCOME]
    move = demo.largest_move(path)
    size = abs(path[move.after] - path[move.before])
    for lag in range(1, demo.HORIZON + 1):
        assert np.abs(path[demo.SETTLED + lag :] - path[demo.SETTLED : -lag]).max() <= size


def test_caveat_says_what_the_searches_say(record, found):
    early = demo.search(record.until(2008.0))
    assert early.run.time[-1] == 2007.75
    output = demo.caveat(found, early)
    gains = {which: max(run.loglik for run in row.values()) for which, row in early.runs.items()}
    for which in ("income", "all four"):
        assert f"{gains[which] - early.still.loglik:.1f}" in output
    assert f"up to 2007 Q4 income gains {gains['income'] - early.still.loglik:.1f}" in output
    half = 1.96 * found.run.std[:, demo.INCOME]
    move = demo.largest_move(found.run.theta[:, demo.INCOME])
    gap = abs(found.run.theta[move.before, demo.INCOME] - found.run.theta[move.after, demo.INCOME])
    assert ("dates overlap" in output) == (gap < half[move.before] + half[move.after])


def shown(picture):
    text = StringIO()
    demo.show(Console(file=text, width=96), Console(file=StringIO()), picture)
    return text.getvalue()


def test_shows_everything_and_saves_the_picture(tmp_path):
    text = shown(tmp_path / "picture.png")
    for part in (
        "Log-likelihood gained by drift",
        "One-step prediction error",
        "This is not a test",
        "Without a search",
        "62.1",
    ):
        assert part in " ".join(text.split())
    assert (tmp_path / "picture.png").stat().st_size > 10_000


def test_without_matplotlib_the_numbers_stay(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    text = shown(tmp_path / "picture.png")
    assert "The coefficient of income" in text
    assert 'pip install "driftfit[plot]"' in text
    assert not (tmp_path / "picture.png").exists()


def test_what_the_tracker_without_settings_finds(record, found):
    adaptive = demo.free(record)
    output = demo.adaptive_estimate(found, adaptive)
    move = demo.largest_move(adaptive.theta[:, demo.INCOME])
    for t in (move.before, move.after):
        assert f"{adaptive.theta[t, demo.INCOME]:.3f}" in output
        assert demo.quarter(adaptive.time[t]) in output
    late = slice(demo.SETTLED, None)
    assert f"{np.sqrt(np.nanmean(adaptive.innovation[late] ** 2)):.4f}" in output
