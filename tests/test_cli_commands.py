"""Commands other than `track`: they print the same results as Python, for the selected part of the file."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from cli_support import fails, run

from driftfit import ARX, Kalman, Live, Track, cli, track

K = Kalman(q=1e-4, r=0.01)
KALMAN = ["--tracker", "kalman", "-p", "q=1e-4", "-p", "r=0.01"]
START = np.datetime64("2024-03-01T08:00", "us")
MINUTE = np.timedelta64(1, "m")


def simulate(T=300, seed=3):
    rng = np.random.default_rng(seed)
    u = rng.normal(size=T).round(4)
    gain = np.where((np.arange(T) >= 200) & (np.arange(T) < 240), 0.2, 1.0)
    y = np.zeros(T)
    for t in range(1, T):
        y[t] = 0.7 * y[t - 1] + gain[t] * u[t - 1] + 0.1 * rng.normal()
    return y.round(4), u, gain < 1.0


@pytest.fixture
def table(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    y, u, wrong = simulate()
    frame = pl.DataFrame(
        {"when": START + np.arange(len(y)) * MINUTE, "n": np.arange(len(y)), "flow": y, "valve": u, "leak": wrong * 1}
    )
    frame.write_csv("pump.csv")
    return frame


SIGNALS = ["pump.csv", "--y", "flow", "--u", "valve", "--model", "arx:1,1", *KALMAN]
DATED = [*SIGNALS, "--time", "when", "--dt", "1min"]


def expected(a=0, b=None, y=None):
    whole, u, _ = simulate()
    whole = whole if y is None else y
    return track(ARX(1, 1, inputs=["valve"]), K, whole[a:b], u[a:b])


def theta(*arguments, stdin=None):
    run("track", *arguments, "--out", "out.parquet", stdin=stdin)
    return pl.read_parquet("out.parquet")["theta_b1[valve]"].to_numpy()


def test_parts_of_a_record(table):
    part = expected(49, 250).theta[:, 1]
    assert np.array_equal(theta(*SIGNALS, "--rows", "50:250"), part)
    assert np.array_equal(theta(*SIGNALS, "--time", "n", "--from", "49", "--to", "249"), part)
    assert np.array_equal(theta(*DATED, "--from", "2024-03-01 08:49", "--to", "2024-03-01 12:09"), part)
    assert np.array_equal(theta(*DATED, "--to", "2024-03-01"), expected().theta[:, 1])  # a day to its end
    assert "must be a date" in fails("track", *DATED, "--from", "soon")


def test_a_time_of_a_zone_is_typed_in_that_zone(table):
    table.with_columns(pl.col("when").dt.replace_time_zone("Europe/Vienna")).write_parquet("zoned.parquet")
    arguments = ["zoned.parquet", *DATED[1:], "--from", "2024-03-01 08:49", "--to", "2024-03-01 12:09"]
    assert np.array_equal(theta(*arguments), expected(49, 250).theta[:, 1])
    table = pl.read_parquet("out.parquet")
    assert str(table["when"][0]) == "2024-03-01 08:49:00+01:00"


def test_the_other_ways_to_write_a_table(table):
    text = table.with_columns(pl.col(pl.Float64).cast(pl.String).str.replace(".", ",", literal=True))
    arguments = ["--decimal", ",", *SIGNALS[1:]]
    for sign, name in ((";", ";"), ("\t", "tab"), ("|", "|")):
        text.write_csv("comma.csv", separator=sign)
        more = [] if sign == ";" else ["--separator", name]
        assert np.array_equal(theta("comma.csv", *arguments, *more), expected().theta[:, 1])
    for encoding in ("utf-16", "cp1252"):  # parts of a file are read as the whole file is
        Path("foreign.csv").write_bytes(Path("comma.csv").read_text().encode(encoding))
        assert np.array_equal(
            theta("foreign.csv", *arguments, *more, "--rows", "50:250"), expected(49, 250).theta[:, 1]
        )
    piped = io.BytesIO()
    table.write_csv(piped)
    assert np.array_equal(theta("-", *SIGNALS[1:], stdin=piped.getvalue()), expected().theta[:, 1])


def test_valid_ranges_and_intervals_left_out(table):
    y, _, _ = simulate()
    y[(y < -2.0) | (y > 2.0)] = np.nan
    assert np.array_equal(theta(*SIGNALS, "--limits", "flow=-2:2"), expected(y=y).theta[:, 1])
    whole, u, _ = simulate()
    whole[100:121], u[100:121] = np.nan, np.nan
    left = track(ARX(1, 1, inputs=["valve"]), K, whole, u).theta[:, 1]
    assert np.array_equal(theta(*SIGNALS, "--exclude", "101..121"), left)
    assert np.array_equal(theta(*DATED, "--exclude", "2024-03-01 09:40..2024-03-01 10:00"), left)
    printed = run("track", *SIGNALS, "--limits", "flow=-2:2", "--exclude", "101..121")
    assert "21 excluded" in " ".join(printed.split())
    run("tune", *SIGNALS[:-2], "--limits", "flow=-2:2", "--exclude", "101..121")


@pytest.mark.parametrize("command", ["track", "tune"])  # the others read records as one of these does
def test_a_gate_leaves_out_codes(table, command):
    y = table["flow"].to_numpy().copy()
    y[100] = 9999.0
    table.with_columns(flow=y).write_csv("pump.csv")
    options = SIGNALS[: -2 if command == "tune" else None]
    assert "1 sample far outside" in " ".join(run(command, *options, "--gate").split())
    with pytest.warns(UserWarning, match="tune: |track: ") as said:
        run(command, *options, "--no-gate")
    assert any("gate=True leaves them out" in str(one.message) for one in said)


def test_a_saved_run_or_stream_is_continued(table):
    run("track", *SIGNALS, "--rows", ":200", "--out", "first.npz")
    y, u, _ = simulate()
    stream = Live(ARX(1, 1, inputs=["valve"]), K)
    for t in range(200):
        stream.update(y[t], u[t])
    stream.save("live.npz")
    rest = ["pump.csv", "--y", "flow", "--u", "valve", "--rows", "201:", "--start"]
    for state in ("first.npz", "live.npz"):
        assert np.array_equal(theta(*rest, state), expected().theta[200:, 1])
    assert "come from the file" in fails("track", *rest, "first.npz", "--model", "arx:1,1")


def test_verdict_and_tables_of_eighty_columns(table, monkeypatch):
    printed = run("verdict", *DATED)
    of_run = expected().verdict()
    assert f"p = {of_run.p:.2g}" in " ".join(printed.split()) or "p < 0.0001" in printed
    monkeypatch.setattr(cli.program.out, "width", 80)
    printed = run("verdict", *DATED)
    assert "…" not in printed
    assert "< 0.0001" in printed
    assert "2024-03-01" in printed.split("Changes")[1]


def test_detect_scores_labels_and_writes_alarms(table):
    options = ["--reference", "150", "--every", "1000", "--labels", "leak"]
    printed = run(
        "detect", *DATED, *options, "--kind", "band", "--out", "alarms.csv", "--plot", "a.png", "--report", "page.html"
    )
    alarms = expected().detect("band", reference=150, every=1000)
    score = alarms.score(simulate()[2])
    assert score.found == 1
    assert f"Labels: 1 of 1 found, {score.delay:g} samples after" in printed
    written = pl.read_csv("alarms.csv")
    assert len(written) == len(alarms.onsets)
    assert written["from"][0] == str(START + alarms.onsets[0] * MINUTE).replace("T", " ")[:19]
    page = Path("page.html").read_text()
    assert "Faults and alarms" in page
    assert "2024-03-01 11:20:00" in page  # the label begins
    assert "1 of 1 labelled intervals found" in page
    printed = run("detect", *DATED, "--kind", "band", "--reference", "b1[valve]=0.5:1.5", "--from", "2024-03-01 08:10")
    assert "b1[valve]" in printed
    assert "leave out --by" in fails("detect", *DATED, "--labels", "leak", "--by", "leak")
    assert "name=low:high" in fails("detect", *DATED, "--reference", "a1=x:y")
    assert "--labels: labels are 0 or 1" in fails("detect", *DATED, *options[:-1], "flow")


def test_tune_smooth_and_forecast(table):
    kalman = ["pump.csv", "--y", "flow", "--u", "valve", "--model", "arx:1,1", "--tracker", "kalman"]
    printed = run("tune", *kalman, "-p", "r=0.01")
    assert "--tracker kalman -p q=" in printed
    run("smooth", *SIGNALS, "--out", "path.csv")
    path = pl.read_csv("path.csv")
    assert np.allclose(path["theta_b1[valve]"], expected().smooth().theta[:, 1], rtol=1e-12)
    table.tail(4).select("valve").write_csv("plan.csv")
    printed = run("forecast", *SIGNALS, "--future", "plan.csv", "--out", "ahead.csv")
    made = expected().forecast(4, table["valve"].to_numpy()[-4:])
    assert np.allclose(pl.read_csv("ahead.csv")["y_hat"], made.y_hat)
    assert f"{made.y_hat[0]:.6g}" in printed
    assert "--future FILE" in fails("forecast", *SIGNALS)


def test_select_compares_models(table):
    printed = run(
        "select", "pump.csv", "--y", "flow", "--u", "valve", *KALMAN, "--model", "arx:1,1", "--model", "arx:1,0"
    )
    assert printed.index("ARX(na=1, inputs=('valve',))") < printed.index("nb=0")


def test_warm_and_cache(table):
    printed = run("warm", "--model", "arx:1,1", *KALMAN)
    assert "Folder" in printed
    assert "without" not in printed
    printed = run("cache")
    assert "of this version and processor" in printed
    assert "at least 0" in fails("cache", "--prune", "--days", "-1")


def test_warm_compiles_what_users_call(monkeypatch):
    called = []
    for verb in ("summary", "verdict", "diagnose", "detect", "report"):
        monkeypatch.setattr(Track, verb, lambda self, *_, verb=verb, **__: called.append(verb))
    printed = run("warm", "--model", "arx:1,1", "--tracker", "rls", "-p", "forgetting=0.99")
    assert called == ["summary", "verdict", "diagnose", "detect", "report"]
    assert "without smooth: RLS does not describe a random walk" in printed


def test_picture_of_the_system(table):
    run("track", *SIGNALS, "--system", "system.png", "--out", "run.npz")
    assert Track.load("run.npz").names == ("a1", "b1[valve]")
    assert "one series" in fails("track", *SIGNALS, "--by", "leak", "--system", "s.png")


def test_alarms_of_a_fleet(table):
    two = [table.with_columns(pump=pl.lit("a")), table.with_columns(pump=pl.lit("b"), flow=pl.col("flow").shift(0))]
    pl.concat(two).write_csv("two.csv")
    options = ["--by", "pump", "--reference", "150", "--every", "1000", "--out", "alarms.csv", "--report", "page.html"]
    assert "2 series" in run("detect", "two.csv", *DATED[1:], *options)
    written = pl.read_csv("alarms.csv")
    assert set(written["pump"]) == {"a", "b"}
    page = Path("page.html").read_text()
    assert "Faults and alarms" in page
    assert str(written["from"][0]) in page


def test_page_of_a_fleet_marks_labels(table):
    y, u, wrong = simulate()
    fleet = track(ARX(1, 1), K, np.stack([y, y]), np.stack([u, u])[..., None], by="row")
    fleet.report("page.html", labels={0: wrong})
    page = Path("page.html").read_text()
    assert "Intervals labelled as wrong" in page
    assert ">200<" in page
    with pytest.raises(ValueError, match="which has no result"):
        fleet.report("page.html", labels={7: wrong})
    with pytest.raises(ValueError, match="300 samples"):
        fleet.report("page.html", labels={0: wrong[1:]})
