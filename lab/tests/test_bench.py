"""The scoreboard measures what it says: oracle and peers run the filter they name, scores count what they should."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from typer.testing import CliRunner

from driftfit import ARX, RLS, AugmentedFLS, Kalman, Regression, track, trackers
from lab import scenarios
from lab.bench import (
    accuracy,
    accuracy_page,
    commands,
    contestants,
    oracle,
    peers,
    real,
    scores,
    speed,
    speed_page,
    speed_process,
)
from lab.bench.computer import installed
from lab.bench.contest import Contest, Finish, Job, hold
from lab.bench.records import Outcome, Record, regressors, simulated
from lab.bench.speed_process import Start, needed
from lab.program import app

RATIO = (1e-3, 0.0)


@pytest.fixture(scope="module")
def record():
    return simulated("missing_data", "arx", 0, 300)


def close(a, b, atol=1e-6):
    for one, other in zip(a, b, strict=True):
        np.testing.assert_allclose(one[50:], other[50:], rtol=1e-6, atol=atol)


def test_regressors_are_the_shifted_columns_of_the_model():
    y, u = np.arange(1.0, 9.0), np.arange(10.0, 26.0).reshape(8, 2)
    phi = regressors(ARX(2, (1, 2), nk=(0, 1), intercept=True).bind(2), y, u)
    np.testing.assert_array_equal(phi[5], [y[4], y[3], u[5, 0], u[4, 1], u[3, 1], 1.0])
    np.testing.assert_array_equal(regressors(Regression(2), y, u), u)


def test_oracle_is_the_kalman_filter_where_the_drift_is_constant(record):
    truth = record.truth
    assert np.ptp(truth.q, axis=0).max() == 0.0
    run = track(record.model, Kalman(q=truth.q[0], r=0.09, p0=oracle.DIFFUSE), record.y, record.u)
    assert np.isnan(record.phi[3:]).any()
    close(oracle.oracle(record), Outcome.of(run))


def test_the_oracle_knows_jumps_and_outliers():
    jumpy = simulated("sparse_jumps", "regression", 3, 400)
    jump = np.flatnonzero(jumpy.truth.q.any(axis=1))
    found_claims = oracle.oracle(jumpy)
    assert (found_claims.std[jump].max(axis=1) > 0.5).all()
    assert (found_claims.std[jump[jump > 50] - 1].max(axis=1) < 0.2).all()
    wild = simulated("outliers", "regression", 0, 400)
    assert (oracle.oracle(wild).prediction_std[wild.truth.outlier] > 3.0).all()


@pytest.mark.parametrize("peer", contestants.SAME_FILTER, ids=lambda peer: peer.package)
def test_peers_run_our_filter(peer):
    if not installed(peer.package):
        pytest.skip(f"{peer.package} is not installed")
    full = simulated("slow_walk", "arx", 0, 150)
    ours = track(full.model, Kalman(q=1e-3, r=1.0, p0=oracle.DIFFUSE), full.y, full.u)
    close(peer.follow(full, RATIO, np.ones(4)), Outcome.of(ours), atol=1e-5)


def test_adaptive_filters_are_the_ones_they_are_compared_with():
    pytest.importorskip("padasip")
    full = simulated("slow_walk", "arx", 0, 150)
    rls = peers.padasip_rls(full, 0.99, np.ones(4))
    ours = track(full.model, RLS(0.99, p0=oracle.DIFFUSE), full.y, full.u)
    np.testing.assert_allclose(rls.theta[20:], ours.theta[20:], rtol=1e-5, atol=1e-7)
    nlms = peers.padasip_nlms(full, 1.0, np.ones(4))
    ours = track(full.model, AugmentedFLS(mu=0.001, theta0=0.0), full.y, full.u)
    np.testing.assert_allclose(nlms.theta, ours.theta, rtol=1e-6, atol=1e-8)


def test_recursive_least_squares_of_statsmodels_with_missing_samples(record):
    pytest.importorskip("statsmodels")
    out = peers.statsmodels_recursive(record, None, np.ones(4))
    rows = record.usable & (np.arange(300) <= 200)
    np.testing.assert_allclose(
        out.theta[200], np.linalg.lstsq(record.phi[rows], record.y[rows], rcond=None)[0], rtol=1e-6
    )


def test_simulated_outliers_do_not_count_for_the_one_step_band():
    wild = simulated("outliers", "regression", 0, 400)
    T, far = len(wild.y), wild.truth.outlier
    assert far[scores.BURN :].any()
    outcome = Outcome(wild.truth.theta, np.ones((T, 3)), wild.y - np.where(far, 9.0, 0.5), np.ones(T))
    everything = scores.score(wild, outcome, np.ones(T, bool))
    assert everything.y == 1.0
    assert everything.theta == 1.0
    assert everything.rmse == 0.0
    assert everything.error > 1.0


def test_jumps_are_found_and_false_alarms_counted():
    record = simulated("sparse_jumps", "regression", 5, 1000)
    jumps = np.flatnonzero(record.truth.q.any(axis=1))
    late = jumps[jumps >= scores.BURN]
    assert len(late) >= 2
    d = np.zeros(1000)
    d[late[0] + 3] = 5.0
    quiet = next(t for t in range(scores.BURN, 1000) if np.min(np.abs(jumps - t)) > 60)
    d[quiet : quiet + 10] = 5.0
    found = scores.detect(record, d, 1.0)
    assert (found.jumps, found.delays, found.false) == (len(late), (3,), 1)
    assert scores.pooled([found, found]).delays == (3, 3)


def test_threshold_is_passed_in_one_of_twenty_blocks():
    d = [np.random.default_rng(i).normal(size=1200) for i in range(20)]
    level = scores.threshold(d)
    blocks = np.array([x[200:].reshape(20, 50).max(axis=1) for x in d])
    assert np.mean(blocks > level) == pytest.approx(0.05, abs=0.005)


def cell(scored):
    return accuracy.Cell("ramp", "arx", scored, {}, {})


def test_losses_need_size_and_frequency():
    def rows(factors):
        return [scores.Score(f, 1.0, 0.95, 0.95) for f in factors]

    scored = {
        accuracy.ORACLE: rows([0.5] * 4), real.REFERENCE: rows([1.0] * 4),
        "often": rows([0.9, 0.9, 0.9, 2.0]), "seldom": rows([0.5, 0.5, 1.1, 1.1]), "hardly": rows([0.99] * 4),
    }  # fmt: skip
    assert [(row[2], row[4]) for row in accuracy_page.losses([cell(scored)])] == [("often", 0.75)]


def test_settings_come_from_the_lessons():
    def follow(record, setting, c):
        unknown = np.full((len(record.y), 1), np.nan)
        return Outcome(unknown, unknown, record.y - setting, np.ones(len(record.y)))

    lesson = Record(Regression(0, intercept=True).bind(0), np.arange(100.0), np.zeros((100, 0)))
    one = contestants.Contestant("one", "driftfit", follow, (3.0, 0.5, 2.0), default=False, relative=True)
    entry = accuracy.entries([one], [lesson], real.one_step)[0]
    assert (entry.name, entry.setting, entry.scale) == ("one, tuned", 0.5, 0.5)
    np.testing.assert_array_equal(entry.follow(lesson).prediction_std, 0.5)


def test_absent_peers_are_named(monkeypatch):
    monkeypatch.setattr(contestants, "installed", lambda package: None)
    there, absent = accuracy.contestants()
    assert absent == ["filterpy", "padasip", "river", "statsmodels"]
    assert {c.package for c in there} == {"driftfit"}


def test_quick_accuracy_from_the_command_line(tmp_path):
    command = ["bench", "accuracy", "--quick", "--scenario", "sparse_jumps", "--no-real", "--out", str(tmp_path)]
    result = CliRunner().invoke(app, command)
    assert result.exit_code == 0, result.output
    page = (tmp_path / "scoreboard_accuracy.md").read_text()
    for part in ("AdaptiveKalman", "Kalman, tuned", "Kalman, hindsight", "oracle", "found", "arx: / oracle"):
        assert part in page
    assert (tmp_path / "figures" / "scoreboard_sparse_jumps.png").stat().st_size > 10_000
    wrong = CliRunner().invoke(app, ["bench", "accuracy", "--scenario", "sparse_jump"])
    assert wrong.exit_code == 2


def test_real_records_are_there_and_scored():
    pytest.importorskip("statsmodels")
    loaded = dict(real.us_money() + real.danish_money() + real.nile())
    assert [len(r.y) for r in loaded.values()] == [203, 55, 100]
    assert all(np.isfinite(r.y).all() and np.isfinite(r.u).all() for r in loaded.values())
    result = real.judge("Nile", loaded["Nile"])
    by_name = {row.name: row for row in result.rows}
    assert result.samples == 50
    y = loaded["Nile"].y
    assert by_name["persistence"].error == pytest.approx(np.sqrt(np.mean(np.diff(y)[49:] ** 2)))
    constant = [y[t] - y[:t].mean() for t in range(50, 100)]
    assert by_name["RLS(1), constant LS"].error == pytest.approx(np.sqrt(np.mean(np.square(constant))))


def test_contests_compare_numbers_and_name_who_is_absent():
    def absent():
        raise ImportError("no", name="nowhere.module")

    def job(name, theta):
        return Job(name, lambda: None, 10, lambda: np.array(theta))

    contest = Contest("title", "note", job("a", [1.0, 2.0]), [lambda: job("b", [1.0, 2.1]), absent])
    finish = hold(contest, 3)
    assert finish.absent == ["nowhere"]
    assert finish.lines[1].difference == pytest.approx(0.05)
    assert "DIFFER" in speed_page.section(finish)
    assert "nowhere" in speed_page.section(finish)


def test_live_and_record_contests_have_the_same_numbers():
    for make in (speed.live_kalman, speed.live_rls, speed.live_nlms, speed.record_kalman):
        finish = hold(make(60), 1)
        known = [line.difference for line in finish.lines[1:] if not np.isnan(line.difference)]
        assert known or finish.absent, finish
        assert max(known, default=0.0) < 1e-6, finish


def test_pages_of_speed_say_where_we_lose():
    lines = [speed.Finish("t", "", [], []), Finish("title", "", hold(speed.live_kalman(20), 1).lines[:1] * 2)]
    lines[1].lines[1] = lines[1].lines[1]._replace(name="peer", ratio=0.5)
    assert speed_page.losses(lines) == ["* title: peer needs 0.50 of our time."]


def test_the_page_of_speed_is_written(tmp_path, monkeypatch):
    """``bench speed --quick``, with two of its contests, one slope, and no fresh processes."""
    monkeypatch.setattr(
        speed, "contests", lambda quick: [hold(make(20), 1) for make in (speed.live_kalman, speed.live_rls)]
    )
    name, (_, *rest) = next(iter(speed.GROWTH.items()))
    monkeypatch.setattr(speed, "GROWTH", {name: ((10, 20, 40), *rest)})
    monkeypatch.setattr(speed_process, "starts", lambda repeats: ([Start("driftfit", 0.1, 0.2, 1.0, 2.0)], ["absent"]))
    ran = []
    monkeypatch.setattr(commands.subprocess, "run", lambda line, **_: ran.append(line) or SimpleNamespace(returncode=0))
    result = CliRunner().invoke(app, ["bench", "speed", "--quick", "--out", str(tmp_path)])
    assert result.exit_code == 0, result.output
    commands.speed_here(**{"quick": "--quick" in ran[0], "write_to": Path(ran[0][-1])})
    page = (tmp_path / "scoreboard_speed.md").read_text()
    assert "Quick form" in page
    assert page.count("driftfit Live") >= 2
    assert (tmp_path / "figures" / "scoreboard_speed.png").stat().st_size > 5000


def test_slope_is_the_exponent():
    sizes = np.array([1.0, 10.0, 100.0, 1000.0])
    assert speed.slope(sizes, 3.0 * sizes**1.5) == pytest.approx(1.5)


def test_what_a_package_needs():
    pytest.importorskip("packaging")
    assert {"driftfit", "numba", "llvmlite", "polars"} <= needed("driftfit")
    assert "numpy" not in needed("driftfit")


DOCS = Path(__file__).parents[2] / "docs"


def test_every_scenario_is_on_the_page_and_every_tracker_in_its_table():
    page = (DOCS / "scoreboard_accuracy.md").read_text()
    for name in scenarios.found():
        assert f"## {name}\n" in page
        assert (DOCS / "figures" / f"scoreboard_{name}.png").exists()
    summary = page.split("## All scenarios\n\n")[1].split("\n\n")[0]
    chapter = (DOCS / "choosing_a_tracker.md").read_text()
    for kind in trackers.found().values():
        if kind.own_model(1, 1, 1) is None and f"`{kind.__name__}` is not in the" not in chapter:
            assert kind.__name__ in summary
