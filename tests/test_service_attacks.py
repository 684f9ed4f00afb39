"""Attacks on the service: no alarm is lost without a word, and no request or file stops it."""

import json
import re
import socket
import sqlite3
import time
import urllib.request
from collections import Counter
from contextlib import ExitStack
from string import Formatter
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("msgspec", reason="the service needs driftfit[serve]")

from service_support import (
    MODEL,
    TRACKER,
    UNIT,
    Receiver,
    configured,
    events,
    feed,
    message,
    opened,
    receiver,
    record,
    results_of,
    rows_of,
    running,
    serving,
    settled,
    stored,
    until,
)  # fmt: skip

from driftfit import track
from driftfit.service.config import ProblemsError
from driftfit.service.connect.base import Batch, Event, Outcome, Receipt, Samples
from driftfit.service.connect.http import WebhookSink
from driftfit.service.connect.tables import SqliteSink
from driftfit.service.control import health
from driftfit.service.core import section
from driftfit.service.options import Pattern
from driftfit.service.page.feed import Feed, metrics_of
from driftfit.service.supervisor import EVENT_TRIES, SinkThread, SourceThread


@pytest.mark.parametrize("status", [302, 307, 403, 500])
def test_an_event_that_is_refused_is_tried_again_and_then_set_aside(tmp_path, monkeypatch, status):
    """A redirect was followed, to another address too, and its answer counted; a 5xx held up all alarms behind it."""
    monkeypatch.setattr("driftfit.service.supervisor.FIRST_PAUSE", 1e-3)
    monkeypatch.setattr("driftfit.service.supervisor.LONGEST_PAUSE", 1e-2)
    with receiver(*[status] * (EVENT_TRIES + 2)) as url:
        sink = f'[[sink]]\nkind = "webhook"\nurl = "{url}"\nevents = ["action"]\n'
        config = configured(more=sink)
        engine = opened(config, tmp_path)
        feed(engine, message("plant/a", range(20), *record(20)))
        runner = SinkThread(engine, config.sinks[0])
        with running(engine, runner):
            for k in range(3):
                engine.act("a", {"do": "hold", "on": True, "who": "Ann", "why": f"test {k}"})
            until(lambda: len(Receiver.got) == EVENT_TRIES + 4 and engine.progress)
        engine.close()
    with pytest.raises(ValueError, match="without a password"):
        WebhookSink("w", "https://me:secret@host/").check()
    keys = [key for key, *_ in Receiver.got]
    assert [keys.count(key) for key in dict.fromkeys(keys)] == [EVENT_TRIES, 3, 1]  # each is sent once it is taken
    assert runner.status()["set_aside"] == 1
    assert runner.failures == EVENT_TRIES + 1
    with sqlite3.connect(tmp_path / "driftfit.db") as db:
        ((name, unit, tries, why, detail),) = db.execute("select sink, unit, tries, why, detail from undelivered")
    db.close()
    assert (name, unit, tries, why) == ("webhook-1", "a", EVENT_TRIES, f"127.0.0.1 answered {status}")
    assert json.loads(detail)["why"] == "test 0"


def test_two_alarms_that_begin_at_one_sample_are_two(tmp_path):
    """The second was taken for the first that comes again."""
    made = [Event(7, "a", 0.0, "alarm", {"kind": kind, "cause": "a1"}) for kind in ("band", "glr")]
    writer = SqliteSink("s", str(tmp_path / "out.db")).open()
    for _ in range(2):
        writer.write(Outcome(1, [], made, {}, {}))
    found = writer.db.execute("select detail from event order by detail").fetchall()
    writer.close()
    assert [json.loads(one)["kind"] for (one,) in found] == ["band", "glr"]
    assert len({one.key for one in made}) == 2


@pytest.mark.parametrize("stopped", [False, True])
def test_a_file_that_is_cut_and_written_again_is_read_from_its_start(tmp_path, stopped):
    """Copytruncate of logrotate: what was written up to the old position was skipped."""
    path = tmp_path / "plant.csv"
    path.write_text("t,y\n" + "".join(f"{t},1\n" for t in range(1000)))
    config = configured(UNIT, source=f'[source.file]\nkind = "tail"\npath = "{path}"\ntopic = "plant/a"\n')
    engine, source = opened(config, tmp_path / "folder"), config.sources[0]
    runner = SourceThread(engine, source)
    with running(engine, runner):
        until(lambda: runner.count == 1000)
        if not stopped:
            cut(path)
            until(lambda: runner.count == 2500)
    assert runner.count == 1000 if stopped else 2500
    engine.close()
    engine = opened(config, tmp_path / "folder")
    if stopped:
        cut(path)
        runner = SourceThread(engine, source)
        with running(engine, runner):
            until(lambda: runner.count == 1500)
    assert rows_of(engine, 1)[0] == list(range(2500))
    (found,) = events(engine, "source")
    assert "does not continue at byte" in found["noticed"]


def cut(path):
    """The same file with more lines than before, in place."""
    with path.open("r+") as file:
        file.write("t,y\n" + "".join(f"{t},1\n" for t in range(1000, 2500)))


SHORT = 'alarm = { every = 2000, on = ["glr", "band"], reference = %d }\n'


@pytest.mark.parametrize(("reference", "why"), [(149, '"glr" needs a reference of 150 samples'), (69, "150 samples")])
def test_an_alarm_that_cannot_be_set_is_refused_by_check(reference, why):
    """It was reported as calibrated, and never watched."""
    with pytest.raises(ProblemsError, match=why):
        configured(UNIT + SHORT % reference)
    assert configured(UNIT + SHORT % 150).units


def test_alarms_that_are_not_armed_and_units_that_have_failed_are_shown(tmp_path, monkeypatch, caplog):
    """Both looked healthy: on the page, in the metrics, in /healthz, and after a restart."""
    y, u = record(160)
    config = configured(UNIT + SHORT % 150)
    engine = opened(config, tmp_path)
    feed(engine, message("plant/a", range(160), [0.0] * 160, u))  # constant parameters explain it without error
    until(lambda: engine.step(0.0) or engine.units.get(1).calibrated, 180)  # the first time it compiles
    settled(engine)
    assert "alarm glr is not armed" in engine.status()["trouble"]["a"]
    monkeypatch.setattr("driftfit.service.core.section.advance", lambda *_: 1 / 0)
    feed(engine, message("plant/b", range(160), y, u))
    settled(engine)
    levels = {one.getMessage(): one.levelname for one in caplog.records}
    assert (levels["failed"], levels["calibrated"]) == ("ERROR", "ERROR")
    stored(engine)
    engine = opened(config, tmp_path)
    assert [one.name for one in engine.units.resident] == ["b"]  # a is not in memory
    assert list(engine.units.seen(1).trouble) == ["alarm glr is not armed"]  # another thread looks at it by itself
    assert len(engine.units.resident) == 1
    status = engine.status()
    assert (status["failed"], status["troubled"]) == (1, 2)
    answer, code = health(status, True, True)
    assert (code, answer["state"]) == (200, "degraded")
    assert any(one.startswith("b: failed (ZeroDivisionError") for one in answer["reasons"])
    assert health(status, True, False)[0]["reasons"] == ["2 units, sources or sinks; log in for their names"]
    page = Feed(tmp_path, tmp_path / "c")
    page.look()
    page.status = status
    page.rank()
    shown = {one["unit"]: one["trouble"] for one in page.fleet}
    assert shown == {"a": ["alarm glr is not armed"], "b": ["failed"]}
    text = metrics_of(page, 0)
    assert "driftfit_units_failed 1\n" in text
    assert 'driftfit_trouble{unit="a",what="alarm glr is not armed",why="detect: ' in text
    engine.act("b", {"do": "restart"})
    engine.step(0.0)
    settled(engine)
    assert list(engine.status()["trouble"]) == ["a"]


def test_a_time_far_ahead_mutes_no_unit(tmp_path):
    """One sample stamped 23 hours ahead made all others late, also after a restart."""
    now, times = time.time(), range(10)
    engine = opened(
        configured(UNIT.replace("time =", 'ahead = "1h"\ntime =') + UNIT.replace("plant", "other")), tmp_path
    )
    for topic, far in (("plant/a", 7200.0), ("other/a", 301.0)):
        feed(engine, message(topic, [now - 20.0 + t for t in times], *record(10)))
        feed(engine, message(topic, [now + far], [0.0], [0.0]))
        feed(engine, message(topic, [now - 5.0], [0.0], [0.0]))
    for unit in engine.units.resident:
        assert unit.counts["samples"] == 11
        assert unit.counts["time in the future"] == 1
    feed(engine, message("plant/a", [now + 3000.0], [0.0], [0.0]))  # allowed there
    feed(engine, message("plant/a", [now], [0.0], [0.0]))
    engine.act("a:y", {"do": "restart"})
    engine.step(0.0)
    feed(engine, message("plant/a", [now], [0.0], [0.0]))
    assert (engine.units.get(1).counts["late"], engine.units.get(1).counts["samples"]) == (1, 13)


def test_a_message_that_is_not_understood_harms_no_other(tmp_path):
    """Sources hand on what devices send: lists as values, and lists of another length than they say."""
    engine = opened(configured(), tmp_path)
    y, u = record(20)
    for k, columns in enumerate(
        ({"t": 1.0, "y": [[1.0, 2.0]]}, {"t": [1.0, 2.0], "y": [1.0]}, {"t": object(), "y": [3j]})
    ):
        engine.intake.put("x", Batch([Samples(f"plant/odd{k}", 1, columns)], acknowledge=lambda: 1 / 0))
    assert feed(engine, message("plant/a", range(20), y, u))
    assert engine.units.refused["not understood"] == 1
    assert np.array_equal(engine.units.get(engine.units.names["a"]).live.theta, theta_of(y, u))


def theta_of(y, u):
    return track(MODEL, TRACKER, y, u, time=np.arange(len(y)) * 1.0, dt=1.0).theta[-1]


def fails_in(where):
    """A function of the service that fails for unit 1, at the first place of the first section."""
    before, within = section.advance, section.Section._within

    def fails(one, *given):
        fine = where == "section.Section._within" and one.streams.index == 1
        return within(one, *given) if fine else 1 / 0

    return (lambda *a: 1 / 0 if 0 in a[1].keys else before(*a)) if where == "section.advance" else fails


@pytest.mark.parametrize("where", ["section.advance", "section.Section._within", "unit.Unit.watch"])
def test_an_exception_in_a_unit_ends_neither_the_service_nor_another_unit(tmp_path, monkeypatch, where):
    """In the lanes that units of a section share, before them, and behind them; an operator starts the unit again."""
    engine = opened(configured(UNIT + UNIT.replace("plant", "other")), tmp_path)
    y, u = record(20)
    topics = ("plant/a", "plant/b") if where == "section.advance" else ("plant/a", "other/b")
    for topic in topics:
        feed(engine, message(topic, range(10), y[:10], u[:10]))
    if where == "unit.Unit.watch":
        engine.units.get(1).alarms = [SimpleNamespace(rule=SimpleNamespace(kind="band"))]
    with monkeypatch.context() as planted:
        planted.setattr(f"driftfit.service.core.{where}", fails_in(where))
        for topic in topics:
            engine.intake.put("web", message(topic, range(10, 20), y[10:], u[10:]))
        engine.step(0.0)
    assert "ZeroDivisionError" in engine.units.get(1).failure
    assert np.array_equal(engine.units.get(2).live.theta, theta_of(y, u))
    assert [one["error"][:4] for one in events(engine, "failed")] == ["Zero"]
    engine.act(engine.units.get(1).name, {"do": "restart", "who": "me", "why": "a test"})
    engine.step(0.0)
    feed(engine, message("plant/a", range(20, 40), y, u))
    assert np.array_equal(engine.units.get(1).live.theta, theta_of(y, u))


def test_clients_that_do_not_send_their_requests_hold_up_no_others():
    """500 connections without a request, or with slow headers or bodies, took page, ingest and health down."""
    pytest.importorskip("uvicorn", reason="the page needs driftfit[serve]")
    head = b"POST /api/samples HTTP/1.1\r\nhost: localhost\r\ncontent-length: 100\r\n"
    with serving() as port, ExitStack() as held:
        for k in range(600):
            one = held.enter_context(socket.create_connection(("127.0.0.1", port + 1000 * (k % 10 == 0))))
            one.sendall((b"", head, head + b"\r\n{")[k % 3])
        for path, where in (("/healthz", port), ("/api/units", port), ("/healthz", port + 1000)):
            with urllib.request.urlopen(f"http://127.0.0.1:{where}{path}", timeout=5) as answer:
                found = json.loads(answer.read())
        assert found["state"] == "healthy"


def test_new_units_are_limited_by_client_and_those_that_had_few_samples_are_forgotten(tmp_path, monkeypatch):
    """A body of 3.5 MB made 100,000 units, which stayed in memory for good."""
    config = configured(UNIT, "[service]\nnew_units = 20\n")
    engine, left = opened(config, tmp_path), Counter()
    y, u = record(40)
    feed(engine, message("plant/good", range(12), y[:12], u[:12]))
    feed(engine, message("plant/slow", [0.0], y[:1], u[:1]))
    for client in ("Ann", "Bob"):
        samples = [Samples(f"plant/{client}{k}", 1, {"t": 0.0, "y": 1.0}) for k in range(50)]
        engine.intake.put("web", Batch(samples, client=client, receipt=Receipt(left_out=left)))
        engine.step(0.0)
    assert len(engine.units) == 42
    assert left["too many new units"] == engine.units.refused["too many new units"] == 60
    engine._store_states(everything=True)
    settled(engine)
    monkeypatch.setattr("driftfit.service.core.units.QUIET_SECONDS", -1.0)
    for _ in range(2):
        engine.step(0.0)
    assert [one.name for one in engine.units.resident] == ["good"]
    capacity = engine.units.sections[0].streams.capacity
    monkeypatch.setattr("driftfit.service.core.units.QUIET_SECONDS", 1e9)
    for k in range(15):
        feed(engine, message(f"plant/other{k}", [0.0], y[:1], u[:1]))
    for again in range(2):  # a unit that was forgotten is there again, as it was; also for another process
        part = slice(1 + again, 2 + again)
        feed(engine, message("plant/slow", [1.0 + again], y[part], u[part]))
        engine.close()
        engine = opened(config, tmp_path)
    assert engine.units.sections[0].streams.capacity <= capacity
    feed(engine, message("plant/slow", range(3, 40), y[3:], u[3:]))
    feed(engine, message("plant/Ann0", [1.0], y[:1], u[:1]))
    assert np.array_equal(engine.units.get(engine.units.names["slow"]).live.theta, theta_of(y, u))
    rows = rows_of(engine, engine.units.names["slow"])[0]
    assert rows == list(range(40))
    assert len(engine.units) == 18
    assert len({row[0] for row in results_of(engine)}) == engine.next - 1


@pytest.mark.parametrize("text", ["{a}-{b}", "{a}{b}x", "x{a}-{b}/{c}", "{{{a}", "{a}--{b}--{c}"])
def test_topics_match_as_regular_expressions_do_and_in_linear_time(text):
    pattern, rng = Pattern(text), np.random.default_rng(1)
    parts = [(re.escape(fixed), name) for fixed, name, *_ in Formatter().parse(text)]
    slow = re.compile("".join(fixed + f"(?P<{name}>[^/]+)" * bool(name) for fixed, name in parts))
    for _ in range(2000):
        topic = "".join(rng.choice(list("ab-x/{"), int(rng.integers(0, 9))))
        found = slow.fullmatch(topic)
        assert pattern.match(topic) == (found and found.groupdict()), topic
    assert Pattern("plant/{a}-{b}-{c}-{d}-{e}-{f}x").match("plant/" + "-" * 190) is None  # it took hours


def test_results_that_no_sink_has_written_are_not_deleted_without_a_word(tmp_path):
    sink = f'[[sink]]\nkind = "sqlite"\npath = "{tmp_path}/out.db"\n[service]\nresults = -1.0\n'
    engine = opened(configured(more=sink), tmp_path)
    feed(engine, message("plant/a", range(20), *record(20)))
    settled(engine)
    engine._archive.begin(engine._pending, engine.journal, engine._sinks_at())
    (found,) = events(engine, "lost")
    assert found["why"].startswith("1 groups of results are older")
