"""identify: roles, scores against a slow twin, structure, cause, and the answer for a record that ships."""

import json
import shlex
import sys
from dataclasses import replace
from importlib.resources import files
from subprocess import Popen
from time import monotonic

import numpy as np
import polars as pl
import pytest
from typer.testing import CliRunner

from driftfit import identify
from driftfit.cli import app
from driftfit.data.columns import Wanted
from driftfit.identify import answer
from driftfit.identify.answer import _Task
from driftfit.identify.judgement import Move, bounded, mixed
from driftfit.identify.page import SCHEMA, SCHEMA_OF_RECORDS, commands, verb
from driftfit.identify.roles import NoAnswerError, roles
from driftfit.identify.scores import RIDGE, Scores
from driftfit.identify.structure import Structure, search
from driftfit.identify.working_point import cause, products
from driftfit.judge import on_all_cores
from driftfit.judge.changes.recursion import draw
from driftfit.use.simulate import moved, steps_ahead

PUMP = str(files("driftfit.demo") / "pump.csv")
T = 900


@pytest.fixture(scope="module")
def pump():
    return identify(PUMP, y="flow")


def plant(change, seed=0):
    """y with one lag, an effect of u1 at delay 6 that is constant, jumps or is bent, one of u2 at once; u3 is idle."""
    rng = np.random.default_rng(seed)
    U, y = rng.normal(size=(T, 3)), np.zeros(T)
    gain = np.where((np.arange(T) > 450) & (change in ("time", "both")), 2.0, 1.0)
    for t in range(6, T):
        x = np.abs(U[t - 6, 0]) if change in ("working point", "both") else U[t - 6, 0]
        y[t] = 0.5 * y[t - 1] + gain[t] * x + 0.6 * U[t, 1] + rng.normal()
    return y, U


def regressors(y, U):
    """phi (T, 4) of the plant."""
    return np.column_stack([moved(y, 1), moved(U[:, 0], 6), U[:, 1], np.ones(T)])


def searched(y, U, first=0, budget=60.0):
    return search(y, U, 12, first, monotonic() + budget, np.random.default_rng(0))


ROWS = np.arange(300.0)
PRESSURE, OTHER = np.random.default_rng(1).normal(size=(2, 300))
TABLE = {"flow": np.cumsum(PRESSURE), "pressure": PRESSURE}
ROLES = {
    "a constant": (np.full(300, 7.0), "constant"),
    "a copy": (3.0 - 2.0 * PRESSURE, "a copy of pressure"),
    "a label": ((ROWS > 200) * 1.0, "labels of 0 and 1"),
    "a second clock": (ROWS * 2.0, "a second clock"),
    "text": ([f"note {k}" for k in range(300)], "text, see --dates and --by"),
    "mostly empty": (np.where(ROWS < 200, np.nan, OTHER), "mostly empty"),
    "a switch": ((ROWS // 10 % 2) * 1.0, ""),
}


@pytest.mark.parametrize("what", ROLES)
def test_columns_that_are_no_inputs_are_named_with_the_reason(what):
    extra, why = ROLES[what]
    found = roles(TABLE | {"clock": ROWS, "extra": extra}, "flow")
    assert (found.clock, found.why.get("extra", "")) == ("clock", why)
    assert found.inputs == (("pressure",) if why else ("pressure", "extra"))
    forced = roles(TABLE | {"extra": extra}, "flow", u=["pressure", "extra"]) if what != "text" else None
    assert forced is None or forced.inputs == ("pressure", "extra")


def test_codes_and_spikes_are_missing_in_inputs_too():
    wrong = np.where(ROWS == 20, -715.0, np.where((ROWS == 120) | (ROWS == 121), 999.0, PRESSURE))
    found = roles(TABLE | {"pressure": wrong}, "flow")
    assert found.refused == {"pressure": 3}
    assert np.isnan(found.U[[20, 120, 121], 0]).all()
    pulses = np.where(np.random.default_rng(2).random(300) < 0.05, np.random.default_rng(3).exponential(size=300), 0.0)
    assert roles(TABLE | {"pressure": pulses}, "flow").refused == {}  # rain is no fault


def test_keys_clocks_that_run_back_and_gaps():
    twice = TABLE | {"clock": ROWS % 150}
    found = roles(twice | {"pump": ["b"] * 150 + ["a"] * 150}, "flow", time="clock")
    assert (found.by, found.groups.max()) == ("pump", 1)
    states = roles(TABLE | {"clock": ROWS, "state": ["on", "off"] * 150}, "flow")
    assert (states.by, states.why["state"]) == (None, "text, see --dates and --by")  # of one plant
    assert roles({"flow": PRESSURE, "name": ["x"] * 300}).output == "flow"  # the only column of numbers
    assert roles(twice, "flow", time="clock").key[-1] == "record 2"
    days = TABLE | {"day": [f"{1 + k % 28}.{1 + k // 28}.2025" for k in range(300)]}
    assert roles(days, "flow", wanted=Wanted((), dates="%d.%m.%Y")).clock == "day"
    late = roles({name: [*x, x[5]] for name, x in (TABLE | {"clock": ROWS}).items()}, "flow")
    assert (late.by, late.dropped, len(late.y)) == (None, 1, 300)
    y, U, place = roles(TABLE | {"clock": ROWS + 3.0 * (ROWS > 100)}, "flow").spread(10)
    assert (len(y), place[101]) == (303, 104)
    assert np.isinf(np.column_stack([y, U])[101:104]).all()


def naive_score(X, y, S, rows):
    """Log-likelihood of blocks under coefficients of the other blocks, with full memory, by plain loops."""
    Z = np.column_stack([(X - [0.0, *X[:, 1:].mean(0)]) / [1.0, *X[:, 1:].std(0)], (y - y.mean()) / y.std()])
    B = int(np.clip(len(y) // rows, 8, 80))
    edges, total = np.linspace(0, len(y), B + 1).astype(int), 0.0
    for b in range(B):
        own = Z[edges[b] : edges[b + 1]][:, [*S, -1]]
        rest = np.delete(Z, slice(edges[b], edges[b + 1]), axis=0)[:, [*S, -1]]
        A = rest[:, :-1].T @ rest[:, :-1] + RIDGE * np.eye(len(S))
        e = own[:, -1] - own[:, :-1] @ np.linalg.solve(A, rest[:, :-1].T @ rest[:, -1])
        total -= 0.5 * len(e) * np.log(np.mean(e**2))
    return total


def test_scores_are_those_of_a_slow_twin_and_each_added_column_that_of_the_larger_set():
    rng = np.random.default_rng(4)
    X = np.column_stack([np.ones(T), rng.normal(size=(T, 5))])
    y = X @ [1.0, 2.0, 0.0, -1.0, 0.0, 0.0] + rng.normal(size=T)
    one = Scores(X, y, memories=(np.inf,))
    assert one.score([0, 1, 3]) == pytest.approx(naive_score(X, y, [0, 1, 3], 30), abs=1e-8)
    mixed = Scores(X, y)
    mixed.refer([0, 1])
    added = mixed.added([0, 1])
    assert added[2:] == pytest.approx([mixed.score([0, 1, c]) for c in range(2, 6)], abs=1e-6)
    assert np.isneginf(added[:2]).all()


@pytest.mark.parametrize("change", ["", "time", "working point", "both"])
def test_structure_and_cause(change):
    y, U = plant(change)
    found, late = searched(y, U), searched(y, U, first=1)
    assert (found.na, dict(found.lags)) == (1, {0: (1, 6), 1: (1, 0)})  # also where it is even
    assert all(nk >= 1 and j != 1 for j, (_, nk) in late.lags.items())
    given = Structure(1, {0: (1, 6), 1: (1, 0)})
    phi, made = regressors(y, U), products(y, U, given, ("u1", "u2", "u3"), "y", 0)
    rows = np.isfinite(phi).all(axis=1)
    assert cause(phi[rows], y[rows], made[0][rows], made[1]).kind(change in ("time", "both")) == change


def test_the_logarithm_of_the_output_is_compared_on_its_scale():
    y, U = plant("")
    assert searched(np.exp(0.3 * y), U).log[0] > 50.0
    assert searched(y + 20.0, U).log[0] < 0.0
    assert searched(y, U).log == (0.0, 0.0)


def test_inputs_that_together_replace_another_are_named():
    one, other, noise = np.random.default_rng(6).normal(size=(3, T))
    y = moved(one + other, 2) + noise
    found = searched(y, np.column_stack([one + other, one, other]))
    assert [(j, sorted(of)) for j, of in found.instead] == [(0, [1, 2])]


def test_a_slow_input_that_is_no_better_than_its_copies_is_left_out():
    rng = np.random.default_rng(11)
    walk, other = np.cumsum(rng.normal(size=(2, T)), axis=1)
    y = 0.2 * walk + rng.normal(size=T)  # nothing to do with the input
    assert searched(y, other[:, None]).lags == {}
    assert searched(y, walk[:, None]).lags.keys() == {0}


def test_the_budget_narrows_the_search_and_what_is_judged():
    y, U = plant("")
    assert "the budget of time ended the search" in searched(y, U, budget=0.0).narrowed
    short = search(y[:120], U[:120], 30, 0, monotonic() + 9.0, np.random.default_rng(0))
    assert short.narrowed == ("lags of inputs up to 12 instead of 30",)
    found = identify(pl.read_csv(PUMP).drop("time"), y="flow", budget=0.0)
    assert "only the last 500 samples of 800 were judged" in str(found)
    assert found.track.time[0] == 300  # rows are counted from the first of the file


def test_track_without_a_model_takes_that_of_identify():
    result = CliRunner().invoke(app, ["track", PUMP, "--y", "flow"])
    assert "Chosen: --model arx:1,1/1,nk=7/2,intercept --u pressure,speed;" in result.output.splitlines()[0]
    assert "2026-03-03" in result.output


def test_lines_to_copy_run(pump, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    lines = [part for line in commands(pump) for part in line.split(" && ")]
    for line in [*lines[:-1], lines[-1] + " --check"]:
        result = CliRunner().invoke(app, shlex.split(line)[1:])
        assert result.exit_code == 0, result.output


def test_a_stream_continues_the_record_with_an_alarm(pump):
    stream = pump.live()
    assert (len(stream.theta), stream.alarms[0].rule.frozen != ()) == (pump.model.n, True)
    for t in range(120):
        stream.update(12.0 + (t >= 60), [3.0, 8.0], pump.track.time[-1] + np.timedelta64(10 * (t + 1), "s"))
    assert stream.alarms[0].active


def test_predictions_some_steps_ahead_and_the_weights_of_a_mixture():
    y, U = plant("time")
    phi, theta = regressors(y, U), np.random.default_rng(3).normal(size=(T, 4))
    t = 700
    assert steps_ahead(theta, phi, 1, 1)[t] == pytest.approx(theta[t] @ phi[t])
    assert steps_ahead(theta, phi, 1, 2)[t + 1] == pytest.approx(theta[t] @ [theta[t] @ phi[t], *phi[t + 1, 1:]])
    size = np.where(np.arange(T) < T // 2, 0.5, 2.0)
    first, second = np.random.default_rng(5).normal(size=(2, T)) * [size, size[::-1]]
    both = mixed(np.stack([first, second]), 1)
    assert np.sqrt(np.mean(both[50:] ** 2)) < 0.75
    late = np.where(np.arange(T) < 150, 3.0, 0.6) * second / size[::-1]  # errors at first do not count for ever
    assert mixed(np.stack([first / size, late]), 1)[-50:] == pytest.approx(late[-50:], abs=0.1)
    assert abs(bounded(y, np.where(t == np.arange(T), 1e4, second), 3)[t]) < 4.0 * np.ptp(y)


def test_the_answer_for_a_pump(pump):
    assert (pump.kind, pump.code, pump.model.lags) == ("moves", 0, ((1, 7), (1, 2)))
    assert [(one.what, 430 <= one.at <= 570) for one in pump.moves] == [("pressure", True)]
    assert pump.headline.startswith("The effect of pressure on flow (delay 70 s) fell from 1.3")
    assert {one.steps: "constant ARX" in one.rms for one in pump.errors} == {1: True, 10: True}
    assert pump.errors[0].rms["driftfit"] < 0.95 * pump.errors[0].rms["constants"]
    assert len(str(pump).splitlines()) <= 25
    assert pump.headline.endswith("; speed matters and is constant; temperature, humidity do not matter.")
    for said in ("pump (constant)", "driftfit detect"):
        assert said in str(pump)


KINDS = {"string": str, "object": dict, "array": list, "number": float, "boolean": bool, "null": type(None)}


def fits(data, schema):
    """Whether plain data have a form, by the words of JSON Schema that ours use."""
    types = schema.get("type", [])
    assert not types or isinstance(data, tuple(KINDS[one] for one in ([types] if isinstance(types, str) else types)))
    assert data in schema.get("enum", [data])
    assert data == schema.get("const", data)
    if isinstance(data, dict):
        own, other = schema.get("properties", {}), schema.get("additionalProperties", {})
        assert set(schema.get("required", [])) <= data.keys()
        assert all(fits(one, own.get(name, other)) for name, one in data.items())
    return True


def test_the_page_and_the_data_of_an_answer(pump, tmp_path):
    assert fits(json.loads(json.dumps(pump.json(), allow_nan=False)), SCHEMA)
    page = pump.page(tmp_path / "pump.html")
    assert (tmp_path / "pump.html").read_text(encoding="utf-8") == page
    heads = "What, since when|The picture|How good|Time or working|What was chosen|Problems|not decide|To go on"
    at = [page.index(head) for head in heads.split("|")]
    assert at == sorted(at)


CODES = {
    "a budget without a length": (
        ["--y", "flow", "--budget", "month"],
        2,
        "--budget month: give seconds, or a duration",
    ),
    "a budget in minutes": (["--y", "flow", "--budget", "1m"], 0, "The effect of pressure on flow"),
    "no such column": (["--y", "flux"], 2, "no column 'flux'"),
    "no output named": ([], 2, "name the output, y= or --y"),
    "no numbers": (["--not-u", "flow,speed,pressure,temperature,humidity"], 3, "no column holds numbers that move"),
    "two outputs": (["--y", "flow,speed"], 2, "it explains one output; call it for flow and for speed"),
    "too few rows": (["--y", "flow", "--limits", "flow=0:11"], 3, "24 rows of 800 have all lags; at least 60"),
    "constant output": (["--y", "pump"], 3, "pump is 1 in all 800 rows"),
    "no input": (["--y", "flow", "--not-u", "pressure,speed,temperature,humidity"], 0, "no input moves, so only its"),
    "text": (["--y", "flow", "--u", "time", "--time", "speed"], 3, "time holds text"),
}


@pytest.mark.parametrize("what", CODES)
def test_exit_codes_of_the_command(what, tmp_path):
    options, code, message = CODES[what]
    page = tmp_path / "page.html"
    result = CliRunner().invoke(app, ["identify", PUMP, *options, "--page", str(page)])
    assert (result.exit_code, message in result.output) == (code, True), result.output
    assert page.exists() == (code != 2)
    assert code == 2 or message in page.read_text(encoding="utf-8")


def test_parameters_move_only_if_the_structures_that_came_next_say_so():
    y, U = plant("time")
    found, task = roles({"y": y, "u": U[:, 0], "v": U[:, 1]}, "y"), _Task(monotonic() + 60.0)
    given = Structure(1, {0: (1, 6), 1: (1, 0)}, {0: (6, 6), 1: (0, 0)})
    assert task.judged(found, given).kind == "moves"
    without = replace(given, second=(((1, ((1, 1, 0),)), 0.0, 1.0),))  # u, whose effect moves, is noise to this one
    assert "the chosen structure (p < 0.0001), but not with one of" in task.judged(found, without).headline


def test_a_curve_and_a_change_are_both_said():
    y, U = plant("both")
    found = identify({"y": y, "u": U[:, 0], "v": U[:, 1]}, y="y")
    assert (found.kind, [(one.what, 440 <= one.at <= 460) for one in found.moves]) == ("both", [("u", True)])
    assert "a bend of u" in found.headline.partition("Besides this: ")[0]
    assert found.headline.partition("Besides this: ")[2].startswith("The curve of u on y")


def test_records_with_one_structure(tmp_path, monkeypatch):
    table = pl.read_csv(PUMP).with_columns(
        unit=pl.when(pl.int_range(800) < 400).then(pl.lit("a")).otherwise(pl.lit("b"))
    )
    found = identify(table.sort("speed").drop("time"), y="flow", by="unit")  # the rows of both are mixed
    assert [list(one) for one in (found.track["a"].time[:3], found.track["b"].time[-3:])] == [
        [0, 1, 2],
        [397, 398, 399],
    ]
    monkeypatch.setattr(answer, "LEAST", 300)
    found = identify(table, y="flow", budget=0.0)
    said = " ".join(str(found).split())
    assert "records by unit (--by)" in said
    assert "only the last 300 samples of every record were judged (--budget)" in said
    assert {key: len(run) for key, run in found.track.items()} == {"a": 300, "b": 300}
    assert fits(json.loads(json.dumps(found.json(), allow_nan=False)), SCHEMA_OF_RECORDS)
    assert found.page(tmp_path / "both.html").index("All records") > 0


def test_another_process_compiles_what_is_needed_where_nothing_is_on_disk(pump, tmp_path, monkeypatch):
    before = len(draw._entries)
    on_all_cores.fill()
    assert len(draw._entries) == before  # it is what an answer calls
    monkeypatch.setattr(on_all_cores, "folder", lambda: tmp_path)
    monkeypatch.setattr(on_all_cores, "cores", lambda: 2)
    monkeypatch.setattr(on_all_cores, "Popen", lambda *_, **__: Popen([sys.executable, "-c", ""]))
    with on_all_cores.compiling_beside() as wait:
        assert wait() == 0
    (tmp_path / "draw-0").touch()
    with on_all_cores.compiling_beside() as wait:
        assert wait() is None


def test_a_negative_effect_neither_rises_nor_falls():
    each = {(-1.9, -1.4): "weakened", (-1.4, -1.9): "grew stronger", (1.0, 2.0): "rose", (1.0, -1.0): "fell"}
    assert {ends: verb(Move("u", "step", *ends, "", "", 0, 0, ())) for ends in each} == each


def test_more_than_one_in_a_hundred_left_out_is_no_answer_unless_the_gate_is_asked_for(pump, tmp_path):
    coded = pl.when(pl.int_range(800) % 40 == 0).then(-715.0).otherwise(pl.col("speed"))
    table = pl.read_csv(PUMP).with_columns(speed=coded)
    twice = pl.concat([pl.read_csv(PUMP), pl.read_csv(PUMP)[:20]]).sort("time")
    assert "20 rows without a time" in identify(twice, y="flow").why
    assert identify(table, y="flow").headline.startswith("Cannot decide: 2.5 % of the readings look like fault codes")
    with pytest.raises(NoAnswerError, match="at least 60"):
        identify(table[:50], y="flow")
