"""The engine of the service: the journal alone determines the states, whatever happens to the process."""

import shutil
import sqlite3
import threading
import time
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("msgspec", reason="the service needs driftfit[serve]")

from service_support import (
    MODEL,
    TRACKER,
    UNIT,
    coded,
    configured,
    events,
    feed,
    message,
    opened,
    record,
    results_of,
    rows_of,
    run_of,
    settled,
    stored,
)  # fmt: skip

from driftfit import ARX, DataWarning, track
from driftfit.service.connect.base import Batch
from driftfit.service.core.engine import KEPT_GROUPS, Intake
from driftfit.service.core.section import Section
from driftfit.service.supervisor import Service, rebuild


@pytest.fixture
def engine(tmp_path):
    one = opened(configured(), tmp_path)
    yield one
    one.close()


def test_states_and_results_are_those_of_track(engine):
    y, u = record()
    for k in range(0, 400, 50):
        for pump in "ab":
            assert feed(engine, message(f"plant/{pump}", range(k, k + 50), y[k : k + 50], u[k : k + 50]))
    run = run_of(y, u)
    rows = [row for row in results_of(engine) if row[1] == 2]
    assert np.array_equal(engine.units.get(1).live.theta, run.theta[-1])
    assert np.array_equal([row[5] for row in rows], run.innovation, equal_nan=True)
    assert np.array_equal([row[8] for row in rows], run.theta)
    assert np.array_equal([row[9] for row in rows], run.std)
    assert [row[2] for row in rows] == run.time.tolist()


def test_sinks_see_results_once_before_and_after_these_are_stored(engine):
    y, u = record(KEPT_GROUPS + 6)
    seen, at = [], 0
    for k in range(KEPT_GROUPS + 5):
        feed(engine, message("plant/a", [k], y[k : k + 1], u[k : k + 1]))
        found = engine.after(at, engine.journal) if k % 7 == 0 else []  # sometimes slower than memory reaches back
        seen += [row for group in found for part in group.parts for row in part.rows()]
        at = found[-1].first if found else at
    (fresh,) = engine.after(engine.next - 2, engine.journal)
    assert fresh.first not in [group.first for group in engine.journal.outcomes(0)]
    assert engine.after(0, engine.journal)[0].first == 1
    settled(engine)
    while found := engine.after(at, engine.journal):
        seen += [row for group in found for part in group.parts for row in part.rows()]
        at = found[-1].first
    assert repr(seen) == repr(results_of(engine))
    assert len(seen) == KEPT_GROUPS + 5


def test_late_rows_are_put_in_order(tmp_path):
    y, u = record(200)
    engine = opened(configured(UNIT + "hold_back = 5\n"), tmp_path)
    rng = np.random.default_rng(3)
    order = np.argsort(np.arange(200) + rng.uniform(0, 4.0, 200))
    order = np.concatenate([order, order[-3:]])  # the last three come twice
    for part in np.array_split(order, 40):
        feed(engine, message("plant/a", part, y[part], u[part]))
    feed(engine, message("plant/a", [3.0], [9.0], [9.0]))  # far too late
    unit = engine.units.get(1)
    assert unit.counts["late"] == 1
    assert unit.counts["duplicate"] == 3
    assert unit.waiting == 5
    state, streams = unit.state(), unit.streams
    run = run_of(y[:195], u[:195])
    assert np.array_equal(unit.live.theta, run.theta[-1])
    times, rows = rows_of(engine, 1)
    assert sorted(times) == list(range(200))
    assert len(rows) == 200
    again = Section(0, unit.settings).add(1, "a")
    again.restore(state, {})
    for before, after in zip(streams.waiting.of(0), again.streams.waiting.of(0), strict=True):
        assert np.array_equal(before, after)
    assert np.array_equal(again.live.theta, run.theta[-1])


class Clock:
    """The module `time`, ahead of itself."""

    ahead = 0.0

    def __getattr__(self, name):
        return getattr(time, name)

    def monotonic(self):
        return time.monotonic() + self.ahead


@pytest.mark.parametrize("timed", [True, False])
def test_what_a_stored_state_contains_is_not_processed_again(tmp_path, monkeypatch, timed):
    """A group of two units is needed again for one of them; the state of the other has its samples already."""
    clock, (y, u) = Clock(), record(100)
    monkeypatch.setattr("driftfit.service.core.engine.time", clock)
    config = configured(UNIT if timed else UNIT.replace('time = "t"\ndt = 1.0\n', ""))
    engine = opened(config, tmp_path)
    feed(engine, message("plant/a", range(50), y[:50], u[:50]))
    clock.ahead = 20.0
    engine.intake.put("web", message("plant/a", range(50, 100), y[50:], u[50:]))
    feed(engine, message("plant/b", range(100), y, u))
    clock.ahead = 31.0  # only the state of a has waited for so long
    settled(engine)
    engine.journal.close()
    engine = opened(config, tmp_path)
    assert engine.recovered == 100
    for unit in (1, 2):
        assert engine.units.get(unit).counts["samples"] == 100
        assert np.array_equal(engine.units.get(unit).live.theta, run_of(y, u).theta[-1])


def test_actions_are_part_of_the_journal(tmp_path):
    y, u = record(300)
    config = configured()
    engine = opened(config, tmp_path)
    feed(engine, message("plant/a", range(100), y[:100], u[:100]))
    actions = [
        {"do": "hold", "on": True}, {"do": "hold", "on": False}, {"do": "reset", "p": 1.0, "which": "a1"},
        {"do": "limits", "limits": {"y": [-0.5, 0.5]}}, {"do": "reset", "p": -1.0}, {"do": "nonsense"},
    ]  # fmt: skip
    told = []
    for k, action in enumerate(actions):
        engine.act("a", action | {"who": "Ann", "why": "maintenance"}, told.append)
        engine.step(0.0)
        part = slice(100 + 20 * k, 120 + 20 * k)
        feed(engine, message("plant/a", range(100 + 20 * k, 120 + 20 * k), y[part], u[part]))
    assert [bool(problem) for problem in told] == [False, False, False, False, True, True]
    assert "nonsense" in told[-1]
    theta, counts = engine.units.get(1).live.theta, engine.units.get(1).counts
    assert counts["y outside its limits"] > 10
    engine.journal.close()  # nothing of the state was stored
    engine = opened(config, tmp_path)
    assert engine.recovered == 100 + 6 * 21
    assert np.array_equal(engine.units.get(1).live.theta, theta)
    assert engine.units.get(1).counts == counts
    found = events(engine, "action")
    assert [(one["do"], one["who"], "refused" in one) for one in found] == [
        ("hold", "Ann", False), ("hold", "Ann", False), ("reset", "Ann", False), ("limits", "Ann", False),
        ("reset", "Ann", True), ("nonsense", "Ann", True),
    ]  # fmt: skip


@pytest.mark.parametrize(
    "action",
    [{"do": "hold", "on": "false"}, {"do": "hold", "on": 0}, {"do": "hold"}, {"do": "limits", "limits": [1, 2]},
     {"do": "limits", "limits": {"y": [0, 1], "u": [2, 1]}}, {"do": "limits"}, {"do": "hold", "on": True, "x": 10**21},
     {"do": "hold", "on": True, "x": "\ud800"}, {"do": "reset", "x": {3j}}],
    ids=str,
)  # fmt: skip
def test_actions_of_another_form_change_nothing(engine, action):
    """Of two limits the first was set before the second was refused; what cannot be stored ended the service."""
    y, u = record(60)
    feed(engine, message("plant/a", range(50), y[:50], u[:50]))
    state, told = engine.units.get(1).state(), []
    engine.act("a", action | {"who": "Ann", "why": "an attack"}, told.append)
    engine.step(0.0)
    assert told[0]
    assert ("cannot be stored" in told[0]) == ("x" in action) == (events(engine, "action") == [])
    assert engine.units.get(1).state() == state
    assert feed(engine, message("plant/a", range(50, 60), y[50:], u[50:]))


def test_a_folder_that_a_kill_left_is_removed_at_the_next_start(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    first = Service(configured(), tmp_path / "folder")
    left = first.control.path.parent
    assert left.is_dir()
    first.engine.close()
    first.control.listener.close()
    first._lock.close()  # as when the process is killed
    (tmp_path / "driftfit-other").mkdir()
    second = Service(configured(), tmp_path / "folder")
    assert not left.exists()
    assert second.control.path.parent.is_dir()
    assert (tmp_path / "driftfit-other").is_dir()  # of another service
    second._close([])
    assert not second.control.path.parent.exists()


ALARM = UNIT + 'alarm = { every = 2000, on = ["band", "glr"], reference = 300 }\n'


def test_alarms_from_a_frozen_reference(tmp_path):
    y, u = record(900)
    for t in range(600, 900):
        y[t] = 0.8 * y[t - 1] - 0.5 * u[t - 1]
    config = configured(ALARM)
    engine = opened(config, tmp_path)
    feed(engine, message("plant/a", range(300), y[:300], u[:300]))
    deadline = time.monotonic() + 180
    while not engine.units.get(1).calibrated and time.monotonic() < deadline:  # the first time it compiles
        engine.step(0.1)
    rules = [alarm.rule for alarm in engine.units.get(1).alarms]
    assert [rule.kind for rule in rules] == ["band", "glr"]
    run = track(MODEL.bind(["u"]), TRACKER, y[:300], u[:300], time=np.arange(300.0), dt=1.0)
    assert rules == [run.detect(kind, reference=300, every=4000).rule for kind in ("band", "glr")]
    for k in range(300, 900, 100):
        feed(engine, message("plant/a", range(k, k + 100), y[k : k + 100], u[k : k + 100]))
    found = events(engine, "alarm")
    assert {one["kind"] for one in found} == {"band", "glr"}
    assert min(one["time"] for one in found) > 600
    assert not engine.units.get(1).acknowledged
    before = [alarm.plain() for alarm in engine.units.get(1).alarms]
    engine.journal.close()
    engine = opened(config, tmp_path)
    assert [alarm.plain() for alarm in engine.units.get(1).alarms] == before
    assert len(events(engine, "alarm")) == len(found)


def test_a_full_disk_holds_back_and_loses_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr("driftfit.service.core.engine.RETRY_SECONDS", 0.2)
    y, u = record(100)
    engine = opened(configured(), tmp_path)
    feed(engine, message("plant/a", range(50), y[:50], u[:50]))
    settled(engine)
    pages = engine.journal.db.execute("pragma page_count").fetchone()[0]
    engine.journal.db.execute(f"pragma max_page_count = {pages}")
    problems = []

    def make_room():
        while not engine.problem:
            time.sleep(0.01)
        problems.append(engine.problem)
        engine.journal.db.execute("pragma max_page_count = 1000000")

    helper = threading.Thread(target=make_room)
    helper.start()
    wide = message("plant/a", range(50, 100), y[50:], u[50:], other=["x" * 200] * 50)
    for k in range(40):  # other units until the file is full
        engine.intake.put("web", message(f"plant/x{k}", range(50), y[:50], u[:50]))
    assert feed(engine, wide)
    helper.join()
    assert "full" in problems[0]
    assert engine.problem == ""
    assert np.array_equal(engine.units.get(1).live.theta, run_of(y, u).theta[-1])


def test_a_torn_write_leaves_a_whole_journal(tmp_path):
    y, u = record(400)
    config = configured()
    engine = opened(config, tmp_path / "whole")
    for k in range(0, 400, 10):
        feed(engine, message("plant/a", range(k, k + 10), y[k : k + 10], u[k : k + 10]))
    rng = np.random.default_rng(5)
    wal = (tmp_path / "whole" / "driftfit.db-wal").read_bytes()
    run, lengths = run_of(y, u), []
    for attempt in range(8):
        torn = tmp_path / f"torn{attempt}"
        torn.mkdir()
        shutil.copy(tmp_path / "whole" / "driftfit.db", torn / "driftfit.db")
        cut = int(rng.integers(len(wal) // 4, len(wal)))
        (torn / "driftfit.db-wal").write_bytes(wal[:cut] + rng.bytes(3000 * (attempt % 2)))
        again = opened(config, torn)
        times, _ = rows_of(again, 1)
        assert times == list(range(len(times)))
        if times:
            assert np.array_equal(again.units.get(1).live.theta, run.theta[len(times) - 1])
        lengths.append(len(times))
        again.close()
    assert len(set(lengths)) > 3


def test_a_unit_that_floods_is_cut_off_alone(tmp_path):
    y, u = record(200)
    engine = opened(configured(UNIT + "rate = 10\n"), tmp_path)
    feed(engine, message("plant/a", range(90), y[:90], u[:90]))
    feed(engine, message("plant/a", range(90, 190), y[90:190], u[90:190]))
    feed(engine, message("plant/b", range(90), y[:90], u[:90]))
    assert engine.units.get(1).counts == {"samples": 90, "used": 89, "flood": 100}
    assert engine.units.get(2).counts["samples"] == 90


def test_the_queue_is_bounded():
    y, u = record(100)
    intake = Intake(150)
    assert intake.put("a", message("plant/a", range(100), y, u))
    second = threading.Thread(target=intake.put, args=("a", message("plant/a", range(100), y, u)), daemon=True)
    second.start()
    time.sleep(0.1)
    assert second.is_alive()
    assert intake.waiting == 100
    assert len(intake.take(1000, 0.0).batches) == 1
    second.join(5)
    assert intake.waiting == 100
    assert intake.held_back == 1
    intake.close()
    intake.put("a", Batch([]))


def test_topics_that_no_unit_has(engine):
    y, u = record(10)
    for topic in ("other/a", "plant/", "plant/a/b", "plant/\x07", "x" * 300, ""):
        assert feed(engine, message(topic, range(10), y, u))
    assert engine.units.refused["no unit for the topic"] == 60
    assert len(engine.units) == 0
    engine.units.options = replace(engine.units.options, units=2)
    for k in range(5):
        feed(engine, message(f"plant/{k}", range(10), y, u))
    assert len(engine.units) == 2
    assert engine.units.refused["too many units"] == 30


def test_a_folder_of_another_configuration_is_refused(tmp_path):
    y, u = record(10)
    engine = opened(configured(UNIT + UNIT.replace("plant", "other")), tmp_path)
    feed(engine, message("other/a", range(10), y, u))
    engine.close()
    with pytest.raises(ValueError, match="use another folder"):
        opened(configured(), tmp_path)


def test_a_state_that_cannot_be_read_stops_its_unit_alone(tmp_path):
    y, u = record(50)
    engine = opened(configured(), tmp_path)
    for pump in "ab":
        feed(engine, message(f"plant/{pump}", range(50), y, u))
    stored(engine)
    with sqlite3.connect(tmp_path / "driftfit.db") as db:
        db.execute("update snapshot set state = x'00' where unit = 1")
    db.close()
    engine = opened(configured(), tmp_path)
    assert "cannot be read" in engine.units.get(1).failure
    assert np.array_equal(engine.units.get(2).live.theta, run_of(y, u).theta[-1])


def test_states_are_carried_over_to_other_settings_of_the_tracker(tmp_path):
    y, u = record(100)
    engine = opened(configured(), tmp_path)
    for pump in "ab":
        feed(engine, message(f"plant/{pump}", range(50), y[:50], u[:50]))
    stored(engine)
    engine = opened(configured(UNIT.replace("q=1e-4", "q=1e-2")), tmp_path)
    feed(engine, message("plant/a", range(50, 100), y[50:], u[50:]))
    other = replace(TRACKER, q=1e-2)
    time = np.arange(100.0)
    before = run_of(y[:50], u[:50])
    rest = track(MODEL, other, y[50:], u[50:], time=time[50:], dt=1.0, gate=True, warm_start=before)
    assert np.array_equal(engine.units.get(1).live.theta, rest.theta[-1])
    assert engine.units.get(2).failure == ""
    engine.close()
    engine = opened(configured(UNIT.replace("ARX(1, 1)", "ARX(2, 1)")), tmp_path)
    assert "follows" in engine.units.get(1).failure


@pytest.mark.parametrize("size", [1, 40])
def test_what_gates_leave_out_is_counted_by_reason(tmp_path, size):
    """Also what is found among the first samples, whether they came in one message or one by one."""
    y, u = coded()
    engine = opened(configured(), tmp_path)
    for k in range(0, 100, size):
        feed(engine, message("plant/a", range(k, min(k + size, 100)), y[k : k + size], u[k : k + size]))
    wanted = {name.lower(): count for name, count in run_of(y, u).left_out.counts.items()}
    assert wanted == {"left out": 1, "left out at the start": 1}
    assert engine.status()["left_out"] == wanted
    assert wanted.items() <= engine.units.get(1).counts.items()
    assert np.array_equal(engine.units.get(1).live.theta, run_of(y, u).theta[-1])


def test_states_of_another_gate_are_refused_and_computed_again(tmp_path):
    y, u = coded()
    engine = opened(configured(), tmp_path)
    feed(engine, message("plant/a", range(100), y, u))
    stored(engine)
    without = configured(UNIT + "gate = false\n")
    engine = opened(without, tmp_path)
    assert "driftfit serve FILE --rebuild" in engine.units.get(1).failure
    engine.close()
    rebuild(tmp_path)
    engine = opened(without, tmp_path)
    assert engine.recovered == 100
    with pytest.warns(DataWarning, match="y: 2 values look like fault codes"):
        run = track(MODEL, TRACKER, y, u, time=np.arange(100.0), dt=1.0)
    assert np.array_equal(engine.units.get(1).live.theta, run.theta[-1])


def test_many_units_with_few_rows_are_those_of_track(tmp_path):
    """Groups of units in lanes, of unequal lengths, some of them held, with limits, late rows and several sections."""
    rng, records = np.random.default_rng(9), [record(60, seed) for seed in range(40)]
    more = UNIT.replace("plant", "other").replace("ARX(1, 1)", "ARX(2, 1)")
    engine = opened(configured(UNIT + "hold_back = 3\nlimits = { u = [-2, 2] }\n" + more), tmp_path)
    order = [np.argsort(np.arange(60) + rng.uniform(0, 2.0, 60)) for _ in records]
    cuts = [np.sort(rng.integers(0, 60, 7)) for _ in records]
    for k in range(8):
        for j, (y, u) in enumerate(records):
            for part in np.array_split(np.split(order[j], cuts[j])[k], 2):
                if len(part):
                    engine.intake.put("web", message(f"{('plant', 'other')[j % 2]}/{j}", part, y[part], u[part]))
        if k == 4:
            engine.act("7:y", {"do": "hold", "on": True, "who": "me", "why": "test"})
        engine.step(0.0)
    for j in range(12):
        unit = engine.units.get(engine.units.names[f"{j}:y"])
        times, rows = rows_of(engine, unit.number)
        if j % 2 == 0:
            run = run_of(*np.array(rows)[np.argsort(times)][:-3].T, limits={"u": (-2, 2)})
            assert unit.waiting == 3
            assert unit.counts["u outside its limits"] > 0
        elif j != 7:  # without hold_back a row that comes in a later group than a later row is left out
            run = track(ARX(2, 1), TRACKER, *np.array(rows).T, time=np.array(times), dt=1.0)
        else:
            continue
        assert np.array_equal(unit.live.theta, run.theta[-1])
    held = engine.units.get(engine.units.names["7:y"])
    rows = [row for row in results_of(engine) if row[1] == held.number]
    assert {row[7] for row in rows[-5:]} == {False}
    assert np.array_equal(held.live.theta, rows[-5][8])
