"""Attacks on the service: no alarm is lost without a word, and no request or file stops it."""

import http.server
import json
import sqlite3
import threading
from contextlib import contextmanager

import pytest

pytest.importorskip("msgspec", reason="the service needs driftfit[serve]")

from service_support import UNIT, Receiver, configured, events, feed, message, opened, record, running, until

from driftfit.service.sinks.contract import Event, Outcome
from driftfit.service.sinks.sqlite import Sqlite
from driftfit.service.sinks.webhook import Webhook
from driftfit.service.threads import TRIES, SinkThread, SourceThread


@contextmanager
def receiver(*answers):
    """The address of a server on this machine that gives these answers, then 200."""
    Receiver.got.clear()
    Receiver.answers[:] = answers
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Receiver)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}/x"
    server.shutdown()
    server.server_close()


@pytest.mark.parametrize("status", [302, 307, 403, 500])
def test_an_event_that_is_refused_is_tried_again_and_then_set_aside(tmp_path, monkeypatch, status):
    """A redirect was followed, to another address too, and its answer counted; a 5xx held up all alarms behind it."""
    monkeypatch.setattr("driftfit.service.threads.FIRST_PAUSE", 1e-3)
    with receiver(*[status] * (TRIES + 2)) as url:
        sink = f'[[sink]]\nkind = "webhook"\nurl = "{url}"\nevents = ["action"]\n'
        config = configured(more=sink)
        engine = opened(config, tmp_path)
        feed(engine, message("plant/a", range(20), *record(20)))
        runner = SinkThread(engine, config.sinks[0])
        with running(engine, runner):
            for k in range(3):
                engine.act("a", {"do": "hold", "on": True, "who": "Ann", "why": f"test {k}"})
            until(lambda: len(Receiver.got) == TRIES + 4 and engine.progress)
        engine.close()
    with pytest.raises(ValueError, match="without a password"):
        Webhook("w", "https://me:secret@host/").check()
    keys = [key for key, *_ in Receiver.got]
    assert [keys.count(key) for key in dict.fromkeys(keys)] == [TRIES, 3, 1]  # each is sent once it is taken
    assert runner.status()["set_aside"] == 1
    assert runner.failures == TRIES + 1
    with sqlite3.connect(tmp_path / "driftfit.db") as db:
        ((name, unit, tries, why, detail),) = db.execute("select sink, unit, tries, why, detail from undelivered")
    db.close()
    assert (name, unit, tries, why) == ("webhook-1", "a", TRIES, f"127.0.0.1 answered {status}")
    assert json.loads(detail)["why"] == "test 0"


def test_two_alarms_that_begin_at_one_sample_are_two(tmp_path):
    """The second was taken for the first that comes again."""
    made = [Event(7, "a", 0.0, "alarm", {"kind": kind, "cause": "a1"}) for kind in ("band", "glr")]
    writer = Sqlite("s", str(tmp_path / "out.db")).open()
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
    assert engine.journal.rows_of(1)[0] == list(range(2500))
    (found,) = events(engine, "source")
    assert "does not continue at byte" in found["noticed"]
    engine.close()


def cut(path):
    """The same file with more lines than before, in place."""
    with path.open("r+") as file:
        file.write("t,y\n" + "".join(f"{t},1\n" for t in range(1000, 2500)))
