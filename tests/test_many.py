"""Many runs judged at once: false discovery control, the table, the page; outputs of one record."""

import html
import math
import os
import re
from dataclasses import replace
from datetime import date

import numpy as np
import pandas as pd
import polars as pl
import pytest
from rich.progress import Progress
from scipy import stats
from support import THETA, arx_record, rows_of

from driftfit import ARX, DataWarning, Kalman, Regression, track
from driftfit.judge import on_all_cores
from driftfit.judge.fleet_verdict import discoveries, verdicts
from driftfit.judge.on_all_cores import Processes, available
from driftfit.run import fleet as fleets
from driftfit.show.text import digits

K = Kalman(q=1e-4, r=0.01)
MOVED = (1, 4)
MAP = Processes.map


@pytest.fixture(scope="module")
def fleet():
    """Seven series of an ARX(2, 2) system, a gain of two of which doubles, and one that is too short to tell."""
    T, parts = 300, []
    for k in range(7):
        path = np.tile(THETA, (T, 1))
        path[150:, 2] += 1.0 if k in MOVED else 0.0
        y, u = arx_record(T, 20 + k, theta=path)
        length = 20 if k == 6 else T
        parts.append(pl.DataFrame({"unit": f"<{k}>", "t": np.arange(length), "y": y[:length], "u": u[:length]}))
    return track(ARX(2, 2), K, "y", "u", data=pl.concat(parts), time="t", by="unit")


def test_q_values_are_those_of_benjamini_and_hochberg():
    p = np.random.default_rng(0).uniform(size=40) ** 2
    assert discoveries(p) == pytest.approx(stats.false_discovery_control(p))
    with_gaps = np.insert(p, [3, 17], np.nan)
    assert discoveries(with_gaps)[~np.isnan(with_gaps)] == pytest.approx(discoveries(p))
    assert np.isnan(discoveries(with_gaps)[np.isnan(with_gaps)]).all()
    assert discoveries(np.zeros(0)).shape == (0,)


def test_those_that_move_are_found_and_named(fleet):
    result = fleet.verdict()
    assert set(result.drifting) == {f"<{k}>" for k in MOVED}
    assert result["<1>"].moving == ("b1[u]",)
    assert repr(result["<1>"].verdict) == repr(fleet["<1>"].verdict())  # NaN is not equal to itself
    assert result["<1>"].pays
    assert result.rows[-1].key == "<6>"
    assert "move in 2 of 6" in result.sentences[0]
    assert "1 cannot be tested" in result.sentences[-1]
    table = result.table
    assert table["unit"][0] in result.drifting
    assert table.filter(pl.col("drifts"))["moving"].to_list() == ["b1[u]"] * 2
    printed = {row[0]: row for row in rows_of(result)}
    for key in result.drifting:
        assert "b1[u]" in printed[key]
    assert not any("b1[u]" in printed[f"<{k}>"] for k in range(7) if k not in MOVED)
    with pytest.raises(KeyError, match="<9>"):
        result["<9>"]


@pytest.mark.parametrize("by", ["pump", ["pump", "day"], ["q", "pump"]])
def test_tables_of_a_fleet_join_to_the_users_table_by_its_keys(by):
    """Integers and dates keep their type, and a column of ours makes room for one of the keys; what was not tested is
    null and has a reason.
    """
    rng, T, days = np.random.default_rng(6), 300, [date(2024, 1, k) for k in (1, 2, 3)]
    u = rng.normal(size=3 * T)
    moves = np.where(np.arange(3 * T) < T // 2, 1.0, 2.0)
    of = np.repeat(np.arange(3), T)
    y = moves * u + 0.1 * rng.normal(size=3 * T)
    data = pl.DataFrame({"pump": 7 + of, "day": [days[k] for k in of], "q": 0.5 * of, "y": y, "u": u})[: 2 * T + 5]
    fleet = track(Regression(1), Kalman(q=1e-4, r=0.01), "y", "u", data=data, by=by)
    keys = [by] if isinstance(by, str) else by
    known = data.select("pump", "day", "q").unique(maintain_order=True).with_columns(site=pl.Series(["a", "b", "c"]))
    tables = [fleet.verdict().table, fleet.diagnose().table, fleet.detect("band", every=100.0, reference=100).table]
    for table in tables:
        assert table.columns[: len(keys)] == keys
        joined = table.join(known, on=keys)
        assert joined.height == table.height > 0
        assert joined.schema["pump"] == pl.Int64
    verdict = known.select([*keys, "site"]).join(tables[0], on=keys).sort("site")
    assert verdict["drifts"].to_list() == [True, False, None]
    assert verdict["pays"].to_list() == [True, False, None]
    assert verdict["untested"].to_list() == ["", "", "not tested: 5 of 12 samples"]
    assert ("q_" in verdict.columns) == ("q" in keys)
    assert "those whose q is below 0.05" in str(fleet.verdict()).splitlines()[0]


def test_a_level_is_the_false_discovery_rate(fleet):
    """Lower levels accuse fewer; the test of one series is not that of the fleet."""
    strict = fleet.verdict(level=1e-12)
    assert set(strict.drifting) <= {f"<{k}>" for k in MOVED}
    for row in fleet.verdict().rows:
        assert np.isnan(row.q) or row.q >= row.verdict.p


def test_ranked_by_change_puts_the_largest_share_first(fleet):
    """b1 from 1 to 2 doubles; b2 from 0.4 to 1.2 is less in numbers and in p, and more as a share."""
    T = 300
    path = np.tile(THETA, (T, 1))
    path[150:, 3] += 0.8
    y, u = arx_record(T, 24, theta=path)
    result = verdicts({**dict(fleet.items()), "<4>": track(ARX(2, 2), K, y, u)}, fleet.by, 0.05)
    rows = result.ranked("change").rows
    assert [row.key for row in rows[:2]] == ["<4>", "<1>"]
    assert rows[0].relative == pytest.approx(2.0, abs=0.1)
    assert rows[1].relative == pytest.approx(1.0, abs=0.05)
    assert all(row.relative == 0.0 for row in rows[2:])
    assert {row.key for row in rows} == {f"<{k}>" for k in range(7)}
    assert result.ranked("change").ranked("clearest").rows == result.rows
    cells = next(row for row in result.table.iter_rows(named=True) if row[fleet.by[0]] == "<4>")
    assert cells["parameter"] == "b2"
    assert abs(cells["sample"] - 150) < 10
    assert [cells["before"], cells["after"]] == pytest.approx([0.4, 1.2], abs=0.1)
    assert 0.85 < cells["coverage"] < 1.0
    assert cells["left_out"] == 0
    with pytest.raises(ValueError, match="'change'"):
        result.ranked("size")


def test_a_share_of_almost_nothing_is_one_of_its_error(fleet):
    row = fleet.verdict()["<1>"]
    parts = tuple(replace(m, before=1e-9, after=0.5, std=0.1) if m.moves else m for m in row.verdict.parameters)
    assert replace(row, verdict=replace(row.verdict, parameters=parts)).relative == pytest.approx(5.0)


@pytest.mark.parametrize(("patience", "shown"), [(0.0, 1), (1e9, 0)])
def test_progress_is_shown_where_it_takes_long(fleet, monkeypatch, patience, shown):
    started = []
    monkeypatch.setattr(Progress, "start", lambda bar: started.append(bar))
    monkeypatch.setattr(on_all_cores, "PATIENCE", patience)
    assert len(fleet.verdict()) == 7
    assert len(started) == shown


def test_processes_judge_as_threads_do(fleet, monkeypatch):
    here = fleet.verdict()
    monkeypatch.setattr(on_all_cores, "WORTH", 0.0)
    monkeypatch.setattr(on_all_cores, "cores", lambda: 2)
    sent = []
    monkeypatch.setattr(Processes, "map", lambda self, *what: sent.append(what) or MAP(self, *what))
    there = fleet.verdict()
    assert sent
    assert repr(there.rows) == repr(here.rows)


def test_what_a_process_cannot_do_is_done_here():
    with Processes(1) as processes:
        (process,) = processes._all
        assert processes.map(os.getpid, [(), ()]) == [process.pid] * 2
        assert processes.map(lambda x: -x, [(1,), (2,)]) == [-1, -2]
        with pytest.raises(ValueError, match="math"):
            processes.map(math.sqrt, [(4.0,), (-1.0,)])
        assert processes.map(os.getpid, [()]) == [process.pid]
        process.kill()
        process.wait()
        assert processes.map(os.getpid, [()]) == [os.getpid()]
    assert process.stdin.closed


def test_a_program_that_is_not_python_is_not_started(monkeypatch):
    for path, allowed in (
        ("/usr/bin/python3.11", True),
        (r"pypy3", True),
        ("/opt/matlab/bin/MATLAB", False),
        ("", False),
    ):
        monkeypatch.setattr("sys.executable", path)
        assert available() == allowed


def test_diagnoses_are_counted(fleet):
    health = fleet.diagnose()
    assert len(health) == 7
    assert health["<2>"].checks == fleet["<2>"].diagnose().checks
    for name, count in health.counts.items():
        assert count == sum(not health[key][name].ok for key in fleet)
    assert health.table.height == 7
    assert "whiteness (p)" in health.table.columns
    printed = rows_of(health)
    for name, count in health.counts.items():
        assert [*name.split(), str(count), str(health.computed[name])] in printed
    for key in fleet:
        wrong = [check.name for check in health[key].checks if not check.ok]
        assert (f"{key} {', '.join(wrong)}".split() in printed) == bool(wrong)
    assert health.ok == (sum(health.counts.values()) == 0)


def test_page_of_a_fleet(fleet, tmp_path):
    fleet.report(tmp_path / "fleet.html", "Seven")
    text = (tmp_path / "fleet.html").read_text()
    assert text.count("<section>") == text.count("</section>") == 5
    assert fleet.verdict().sentences[0] in text
    assert "&lt;1&gt;" in text
    assert "<h3>&lt;6&gt;" not in text  # pictures only of those that move
    with pytest.raises(ValueError, match=r"\.html"):
        fleet.report(tmp_path / "fleet.txt")


def test_a_page_begins_with_what_changed_since(fleet, tmp_path):
    """The two gains double at sample 150: since 140 they changed, since 160 nothing did."""
    for since, said in ((160, "None of 7"), (140, "2 of 7")):
        fleet.report(tmp_path / "fleet.html", since=since)
        text = (tmp_path / "fleet.html").read_text()
        assert f'<div class="verdict"><p>{said} series changed since {since}.</p>' in text
    section = re.search("What changed since 140</h2>(.*?)</section>", text, re.S)
    cells = [re.findall("<td[^>]*>(.*?)</td>", row) for row in re.findall("<tr>(.*?)</tr>", section[1])[1:]]
    first = {key: moved for key in ("<1>", "<4>") for moved in fleet.verdict()[key].moves[:1]}
    shown = {html.unescape(cell[0]): cell for cell in cells if cell[1] == first[html.unescape(cell[0])].name}
    assert shown.keys() == first.keys()
    for key, moved in first.items():
        values = (digits(moved.before, moved.std), digits(moved.after, moved.std))
        share = f"{100.0 * (moved.after - moved.before) / abs(moved.before):+.0f} %"
        assert (*shown[key][3:6], shown[key][7]) == (moved.when, *values, share)
    with pytest.raises(ValueError, match=r"report: since: for this record .* must be a number"):
        fleet.report(tmp_path / "fleet.html", since="2024-03-01")


def test_memory_is_announced_before_the_run(monkeypatch):
    monkeypatch.setattr(fleets, "PROGRESS_SAMPLES", 100)
    monkeypatch.setattr(fleets.os, "sysconf", lambda name: 64)
    y = np.zeros((2, 100))
    with pytest.warns(DataWarning, match=r"results of 2 series take .* keep='theta'"):
        track(ARX(2, 2), K, y, y + 1.0, by="row")


def test_a_page_counts_what_was_left_out_and_what_cannot_be_computed(tmp_path):
    """Rows without a unit or at a repeated time, readings outside their limits, and a series without an output."""
    rng = np.random.default_rng(4)
    u = rng.normal(size=200)
    hours = pd.date_range("2024-10-26 12:00", periods=200, freq="h", tz="Europe/Berlin")
    parts = [pd.DataFrame({"unit": k, "at": hours, "y": 2.0 * u + 0.1 * rng.normal(size=200), "u": u}) for k in "ab"]
    parts[0].loc[7, "y"] = 9999.0
    parts[1]["y"] = np.nan
    table = pd.concat([*parts, parts[0].head(3), parts[0].head(2).assign(unit=None)])
    with pytest.warns(DataWarning, match="3 of 403 rows repeat"):
        fleet = track(Regression(1), K, "y", "u", data=table, time="at", by="unit", dt="1h", limits={"y": (-50, 50)})
    assert fleet.dropped == {"without a unit": 2, "at a repeated time": 3}
    health = fleet.diagnose()
    assert health.known == ("a",)
    assert set(health.computed.values()) <= {0, 1}
    fleet.report(tmp_path / "fleet.html")
    page = (tmp_path / "fleet.html").read_text()
    assert "<dd>2 without a unit, 3 at a repeated time</dd>" in page
    assert "<dd>1 of y outside its limits</dd>" in page
    assert re.search(r">not tested: 0 of 12 samples\s*<", page)
    assert not re.search(r">\s*nan\s*<", page)
    assert "not tested: 0 of 12 samples" in str(fleet.verdict())
    assert not re.search(r"\bnan\b", str(fleet.verdict()))
    out = sum(not health[key].ok for key in fleet)
    assert (f"{out} of 1 have diagnostics out of bounds" if out else "within limits") in page


def test_outputs_of_one_record(tmp_path):
    rng = np.random.default_rng(3)
    T = 300
    u = rng.normal(size=(T, 2))
    gain = np.where(np.arange(T) < 150, 1.0, 2.0)
    y = np.column_stack([u @ [1.0, -0.5], gain * u[:, 0]]) + 0.1 * rng.normal(size=(T, 2))
    run = track(Regression(2, ny=("level", "flow")), K, y, u)
    result = run.verdict()
    assert result.drifting == ("flow",)
    assert run.diagnose()["level"]["noise level"].ok
    run.report(tmp_path / "outputs.html")
    page = (tmp_path / "outputs.html").read_text()
    assert "<h1>level, flow</h1>" in page
    assert "The series that move most clearly" in page
    rows = np.stack([u, u[:, ::-1]], axis=1)
    theta = np.column_stack([np.ones(T), gain])
    y = np.einsum("toi,ti->to", rows, theta) + 0.1 * rng.normal(size=(T, 2))
    shared = track(Regression(2, ny=2, shared=True), K, y, rows)
    assert shared.verdict().drifts
    shared.report(tmp_path / "shared.html")


def test_alarms_of_a_fleet_share_one_rate(fleet):
    """Each series is watched for its part of the rate; what is found is named, and series that are too short are
    reported.
    """
    result = fleet.detect("band", every=1000.0, reference=140)
    assert set(result.faulty) == set(result.alarmed) == {f"<{k}>" for k in MOVED}
    assert len(result) == 6
    assert "too short" in result.failed["<6>"]
    alone = fleet["<1>"].detect("band", every=7000.0, reference=140)
    assert np.array_equal(result["<1>"].limits, alone.limits)
    assert np.array_equal(result["<1>"].onsets, alone.onsets)
    assert result.expected == pytest.approx(6 * 160 / 7000.0)
    assert [row.q for row in result.rows] == pytest.approx(discoveries(np.array([row.alarms.p for row in result.rows])))
    assert {row.key for row in result.rows[:2]} == {f"<{k}>" for k in MOVED}
    table = result.table
    assert len(table) == sum(len(row.alarms.onsets) for row in result.rows)
    assert set(table["unit"]) == {f"<{k}>" for k in MOVED}
    assert result.rows[0].first.endswith(result.rows[0].alarms.cause(int(result.rows[0].alarms.onsets[0])))
    printed = rows_of(result)
    assert ["Alarm", "band,", "one", "false", "alarm", "of", "all", "6", "series", "in", "1000", "samples"] in printed
    assert f"Alarms {len(table)} in 2 series; 0.14 false alarms expected".split() in printed
    for row in result.rows:
        judged = [str(len(row.alarms.onsets)), *row.first.split()]
        printed_row = next(line for line in printed if line[0] == row.key)
        assert printed_row[1 : 1 + len(judged)] == judged
        assert (printed_row[-1] == "fault") == row.faulty
    assert ["not", "judged,", "<6>:"] in [line[:3] for line in printed]
    with pytest.raises(KeyError, match="too short"):
        result["<6>"]


def test_clear_series_are_judged_by_the_limits_of_their_group_and_the_others_by_their_own():
    rng = np.random.default_rng(8)
    u = rng.normal(size=(8, 700))
    y = u + 0.1 * rng.normal(size=u.shape)
    y[2, 500:] += 0.2 * u[2, 500:]
    fleet = track(Regression(1), Kalman(q=0.0, r=0.01), y, u, by="row")
    result, full = fleet.detect("glr", every=1000.0), fleet.detect("glr", every=1000.0, records=64)
    assert result.faulty == full.faulty == (2,)
    assert result.alarmed == full.alarmed == (2,)
    assert result[2].rule == full[2].rule
    clear = [k for k in fleet if result[k].rule != full[k].rule]
    assert len(clear) >= 3
    for k in clear:
        assert min(result[k].p, full[k].p) > 0.05
        np.testing.assert_allclose(result[k].limits, full[k].limits, rtol=0.2)
    with pytest.raises(ValueError, match="100 normal samples at least"):
        fleet.detect("glr", reference=80)


def test_every_series_may_have_a_reference_of_its_own(fleet):
    bands = {key: {"b1[u]": (0.5, 1.5)} for key in fleet} | {"<4>": {"b1[u]": (0.5, 2.5)}}
    result = fleet.detect("band", every=1000.0, reference=bands)
    assert result.faulty == ("<1>",)
    assert not result.failed


def test_without_faults_few_series_are_accused():
    """p-values of series without a fault are not too small, and not much too large."""
    rng = np.random.default_rng(6)
    u, v = rng.normal(size=(2, 200, 400))
    fleet = track(Regression(1), Kalman(q=0.0, r=1.0), u + v, u, by="row")
    p = np.array([row.alarms.p for row in fleet.detect(every=10.0, reference=200).rows])
    for level in (0.01, 0.05, 0.2, 0.5):
        assert np.mean(p < level) < level + 2.0 * np.sqrt(level * (1.0 - level) / 200)
    assert np.mean(p < 0.2) > 0.09
    assert np.mean(p < 0.5) > 0.3


@pytest.mark.parametrize(
    ("settings", "match"),
    [
        ({"kind": "bands"}, "kind"),
        ({"level": 0.0}, "level"),
        ({"level": "high"}, "level"),
        ({"every": 0.5}, "every"),
        ({"every": "ten"}, "every"),
        ({"every": np.inf}, "every"),
        ({}, "normal range of the parameters"),
        ({"reference": {}}, "maps parameters"),
        ({"reference": {"b1[u]": 1.0}}, "low <= high"),
        ({"reference": {7: (0.0, 1.0)}}, "no parameter 7"),
        ({"reference": {"<1>": 140}}, "missing for <0>, <2>"),
    ],
)
def test_what_a_fleet_cannot_be_watched_for(fleet, settings, match):
    with pytest.raises(ValueError, match=match):
        fleet.detect(**{"kind": "band"} | settings)


def test_a_page_about_nothing_says_so(tmp_path):
    """Neither that no drift was found, nor that the diagnostics are within their limits."""
    run = track(Regression(1, ny=("level", "flow")), K, np.full((200, 2), np.nan), np.ones((200, 1)))
    run.report(tmp_path / "nothing.html")
    page = (tmp_path / "nothing.html").read_text()
    assert "2 cannot be tested" in page
    assert "No diagnostic can be computed" in page
    assert not any(claim in page for claim in ("No drift is found in any of", "within limits", "move most clearly"))
