"""Sources and sinks against the real things: mosquitto, PostgreSQL, asyncua's server, librdkafka's mock cluster."""

import contextlib
import importlib.util
import json
import os
import pwd
import shutil
import socket
import subprocess
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("msgspec", reason="the service needs driftfit[serve]")

from service_support import (
    HTTP,
    MODEL,
    TRACKER,
    UNIT,
    configured,
    field,
    free_port,
    metric,
    opened,
    record,
    rows_of,
    running,
    until,
)  # fmt: skip

from driftfit import track
from driftfit.service.connect.base import Event, Outcome
from driftfit.service.connect.files import ReplaySource, TailSource
from driftfit.service.connect.http import INCOMING
from driftfit.service.connect.kafka import KafkaSink, KafkaSource
from driftfit.service.connect.mqtt import REBIRTH, MqttSource
from driftfit.service.connect.opcua import OpcuaSink, OpcuaSource
from driftfit.service.connect.tables import PostgresSink
from driftfit.service.core.journal import Names
from driftfit.service.core.results import OK, Results
from driftfit.service.supervisor import SinkThread, SourceThread


def needs(package):
    return pytest.mark.skipif(importlib.util.find_spec(package) is None, reason=f"needs {package}")


def outcome(count=3, first=1, theta=0.5):
    """A small batch of one unit."""
    values = np.tile([0.0, 1.0, np.nan, 0.1, 0.2, theta, 0.1, 0.1, np.inf], (count, 1))
    values[:, 0] = 1.7e9 + np.arange(count)
    number, unit = first + np.arange(count), np.ones(count, np.int32)
    parts = [Results(number, unit, np.full(count, OK, np.uint8), values)]
    events = [Event(first, "pump 1", 1.7e9, "alarm", {"kind": "band", "cause": "a1", "statistic": 4.0, "limit": 3.0})]
    return Outcome(first, parts, events, {1: "pump 1"}, {"pump 1": {"names": ["a1", "b1"], "parts": {"pump": "1"}}})


class Broker:
    """mosquitto on this machine."""

    def __init__(self, folder):
        self.port, self.folder = free_port(), folder
        lines = [f"listener {self.port} 127.0.0.1", "allow_anonymous true", "max_queued_messages 100000",
                 "persistence true", f"persistence_location {folder}/", "user root"]  # fmt: skip
        (folder / "broker.conf").write_text("\n".join(lines) + "\n")
        self.start()

    def start(self):
        program = shutil.which("mosquitto") or "/usr/sbin/mosquitto"
        self.process = subprocess.Popen([program, "-c", self.folder / "broker.conf"], stderr=subprocess.DEVNULL)
        until(lambda: socket.create_connection(("127.0.0.1", self.port), 1).close() or True)

    def stop(self):
        self.process.terminate()
        self.process.wait(10)


HAS_BROKER = shutil.which("mosquitto") or os.path.exists("/usr/sbin/mosquitto")


@needs("paho")
@pytest.mark.skipif(not HAS_BROKER, reason="needs mosquitto")
def test_mqtt_through_an_absence_of_the_broker(tmp_path):
    from paho.mqtt.client import Client
    from paho.mqtt.enums import CallbackAPIVersion

    broker = Broker(tmp_path)
    url = f"mqtt://127.0.0.1:{broker.port}"
    source = f'[source.plant]\nkind = "mqtt"\nurl = "{url}"\ntopic = "plant/+"\n'
    sink = f'[[sink]]\nkind = "mqtt"\nurl = "{url}"\ntopic = "received/{{pump}}"\n'
    config = configured(UNIT, sink, source)
    engine = opened(config, tmp_path / "folder")
    got, y, u = {}, *record(300)
    listener = Client(CallbackAPIVersion.VERSION2, "listener", clean_session=False)
    listener.on_message = lambda client, user, one: got.setdefault(one.topic, []).append(json.loads(one.payload))
    listener.connect("127.0.0.1", broker.port)
    listener.on_connect = lambda client, *_: client.subscribe([("received/#", 1)])
    listener.loop_start()
    sender = Client(CallbackAPIVersion.VERSION2, "sender")
    sender.connect("127.0.0.1", broker.port)
    sender.loop_start()

    def send(ts):
        for t in ts:
            sender.publish("plant/7", json.dumps({"t": t, "y": y[t], "u": u[t]}), qos=1)

    with running(engine, SourceThread(engine, config.sources[0]), SinkThread(engine, config.sinks[0])):
        until(lambda: _subscribed(sender, engine))
        sender.publish("plant/7", b"{poison", qos=1)
        send(range(150))
        until(lambda: engine.samples >= 150)
        broker.stop()
        send(range(150, 300))
        broker.start()
        until(lambda: engine.samples >= 300, 40)
        until(lambda: len({one["number"] for one in got.get("received/7", [])}) >= 300, 40)
    sender.loop_stop()
    listener.loop_stop()
    broker.stop()
    run = track(MODEL, TRACKER, y, u, time=np.arange(300) * 1.0, dt=1.0)
    assert np.array_equal(engine.units.get(engine.units.names["7"]).live.theta, run.theta[-1])
    assert engine.units.refused["unreadable"] == 1
    received = {one["number"]: one for one in got["received/7"]}
    assert sorted(one["time"] for one in received.values()) == list(range(300))
    assert next(one for one in received.values() if one["time"] == 299.0)["theta"]["a1"] == run.theta[-1, 0]


@needs("paho")
@pytest.mark.skipif(not HAS_BROKER, reason="needs mosquitto")
def test_a_node_of_sparkplug_is_asked_for_its_birth(tmp_path):
    from paho.mqtt.client import Client
    from paho.mqtt.enums import CallbackAPIVersion

    broker = Broker(tmp_path)
    node, asked = Client(CallbackAPIVersion.VERSION2, "node"), []

    def commanded(client, user, message):
        asked.append(message.payload)
        client.publish("spBv1.0/plant/DBIRTH/edge/7", field(1, 1000) + metric(31.5, "flow", 1), qos=1)

    node.on_message = commanded
    node.on_connect = lambda client, *_: client.subscribe("spBv1.0/plant/NCMD/edge")
    node.connect("127.0.0.1", broker.port)
    node.loop_start()
    url = f"mqtt://127.0.0.1:{broker.port}"
    reader = MqttSource("plant", url=url, topic="spBv1.0/plant/+/#", payload="sparkplug").open(None)
    until(lambda: reader.read(0.01) or (reader.client.is_connected() and node.is_connected()))
    time.sleep(0.3)  # both have subscribed
    node.publish("spBv1.0/plant/DDATA/edge/7", field(1, 900) + metric(30.0, alias=1), qos=1)
    found = []
    until(lambda: found.append(reader.read(0.2)) or any(one is not None and one.samples for one in found))
    assert asked == [REBIRTH]
    assert sum(one.refused for one in found if one is not None) == 1
    assert [one for one in found if one is not None][-1].samples[0].columns["flow"] == [31.5]
    reader.close()
    node.loop_stop()
    broker.stop()


def _subscribed(sender, engine):
    """Whether the service hears what is sent."""
    sender.publish("plant/probe", b'{"t": 1.0, "y": 0.0}', qos=1)
    time.sleep(0.1)
    return "probe" in engine.units.names


@contextlib.contextmanager
def postgres(folder):
    """A server of its own, as a user who is not root."""
    programs = (
        subprocess.run(["pg_config", "--bindir"], capture_output=True, text=True) if shutil.which("pg_config") else None
    )
    place = programs.stdout.strip() if programs else ""
    found = [shutil.which("initdb", path=p) for p in (place, os.environ["PATH"], "/usr/lib/postgresql/15/bin")]
    initdb = next((one for one in found if one), None)
    if initdb is None:
        pytest.skip("needs PostgreSQL's initdb")
    user = pwd.getpwnam("nobody") if os.getuid() == 0 else None
    folder.mkdir()
    if user:
        os.chown(folder, user.pw_uid, user.pw_gid)
        for parent in [one for one in folder.parents if one.stat().st_uid == 0 and "pytest" in str(one)]:
            parent.chmod(0o755)
    options = {"user": user.pw_uid, "group": user.pw_gid} if user else {}
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, **options}
    data, port = folder / "data", free_port()
    subprocess.run([initdb, "-D", data, "-U", "me", "-A", "trust", "--no-sync"], check=True, **quiet)
    server = os.path.join(os.path.dirname(os.path.realpath(initdb)), "postgres")
    process = subprocess.Popen([server, "-D", data, "-p", str(port), "-k", folder, "-h", "127.0.0.1", "-F"], **quiet)
    try:
        until(lambda: socket.create_connection(("127.0.0.1", port), 1).close() or True)
        yield f"postgresql://me@127.0.0.1:{port}/postgres"
    finally:
        process.terminate()
        process.wait(20)


@needs("psycopg")
def test_postgres(tmp_path):
    import psycopg

    with postgres(tmp_path / "pg") as url:
        for _ in range(2):  # the same batch again, in a new session
            writer = until(lambda: _opened(PostgresSink("db", url)))
            writer.write(outcome())
            writer.write(outcome(5))
            writer.close()
        with psycopg.connect(url) as db:
            rows = db.execute(
                "select number, unit, y_hat, theta, std, names from driftfit_result order by number"
            ).fetchall()
            for sql in dashboard():
                db.execute(sql).fetchall()
            events = db.execute("select kind, detail->>'cause' from driftfit_event").fetchall()
    assert [row[0] for row in rows] == [1, 2, 3, 4, 5]
    assert rows[0][1] == "pump 1"
    assert np.isnan(rows[0][2])
    assert rows[0][3:] == ([0.5, 0.1], [0.1, float("inf")], ["a1", "b1"])
    assert events == [("alarm", "a1")]


def dashboard():
    """The queries of Grafana's dashboard, with its macros written out."""
    page = Path(__file__).parent.parent / "docs" / "service" / "grafana" / "dashboard.json"
    macros = {
        "$__timeGroupAlias(time, $__interval)": "time",
        "$__timeFilter(time)": "true",
        "$__timeFilter(at)": "true",
    }
    for panel in json.loads(page.read_text())["panels"]:
        sql = panel["targets"][0]["rawSql"].replace("$unit", "pump 1")
        for macro, plain in macros.items():
            sql = sql.replace(macro, plain)
        yield sql


def _opened(sink):
    import psycopg

    try:
        return sink.open()
    except psycopg.OperationalError:  # it starts
        return None


@needs("confluent_kafka")
def test_kafka(tmp_path):
    from confluent_kafka import Consumer, Producer

    cluster = Producer({"test.mock.num.brokers": 1, "bootstrap.servers": "x", "log_level": 0})
    broker = next(iter(cluster.list_topics(timeout=20).brokers.values()))
    brokers = f"{broker.host}:{broker.port}"
    for k in range(20):
        cluster.produce("plant", b'{"t": %d, "y": 1.0}' % k if k != 5 else b"{poison", key=b"7")
    assert cluster.flush(20) == 0
    source = KafkaSource("k", brokers=brokers, topics=["plant"], begin="earliest")
    reader, first = source.open(None), []
    batch = until(lambda: reader.read(0.5))
    first += [one.columns["t"] for one in batch.samples]
    reader.close()
    reader = source.open(batch.position)
    while len(first) < 19:
        batch = until(lambda: reader.read(0.5))
        first += [one.columns["t"] for one in batch.samples]
    reader.close()
    assert first == [k for k in range(20) if k != 5]
    assert batch.samples[0].topic == "plant/7"
    for beyond in (50, -7):  # the topic was made again, or its first messages are gone
        reader = source.open({"plant/0": beyond})
        assert "read from its first" in reader.noticed
        assert until(partial(reader.read, 0.5)).samples[0].columns["t"] == 0
        reader.close()
    writer = KafkaSink("out", brokers=brokers, topic="received").open()
    writer.write(outcome())
    consumer = Consumer({"bootstrap.servers": brokers, "group.id": "t", "auto.offset.reset": "earliest"})
    consumer.subscribe(["received"])
    got = []
    until(
        lambda: (
            got.extend(json.loads(one.value()) for one in consumer.consume(3, 0.5) if not one.error()) or len(got) >= 3
        )
    )
    consumer.close()
    assert [one["number"] for one in got] == [1, 2, 3]
    assert got[0]["theta"] == {"a1": 0.5, "b1": 0.1}


@needs("asyncua")
@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::ResourceWarning")
def test_opcua_from_our_own_server():
    url = f"opc.tcp://127.0.0.1:{free_port()}/driftfit"
    writer = OpcuaSink("out", url).open()
    writer.write(outcome(1))
    nodes = {"plant/1": {"flow": "ns=2;s=pump 1.y", "a1": "ns=2;s=pump 1.a1"}}
    reader = OpcuaSource("in", url, nodes, trigger="a1", period=0.02).open(None)
    begun = until(lambda: reader.read(0.5))
    assert begun.samples[0].columns["a1"][-1] == 0.5
    writer.write(outcome(1, 2, theta=0.75))
    found = until(lambda: (one := reader.read(0.5)) and one.samples[0].columns["a1"][-1] == 0.75 and one)
    assert found.samples[0].topic == "plant/1"
    assert found.samples[0].columns["flow"][-1] == 1.0
    reader.close()
    writer.close()


@pytest.mark.parametrize("kind", ["csv", "jsonl"])
def test_tail(tmp_path, kind):
    path = tmp_path / f"plant.{kind}"
    rows = [{"t": t, "pump": f"p{t % 2}", "y": t / 2} for t in range(20)]
    lines = [(",".join(map(str, row.values())) if kind == "csv" else json.dumps(row)) + "\n" for row in rows]
    head = "t,pump,y\n" if kind == "csv" else ""
    path.write_text(head + "".join(lines[:10]) + lines[10][:-3])
    source = TailSource("f", str(path), topic="plant", by="pump")
    reader = source.open(None)
    batch = reader.read(1.0)
    assert [one.topic for one in batch.samples] == ["plant/p0", "plant/p1"]
    assert sum(one.length for one in batch.samples) == 10
    assert reader.read(0.1) is None  # half a line
    with path.open("a") as file:
        file.write(lines[10][-3:] + "no,line\n" + "".join(lines[11:]))
    reader.close()
    reader = source.open(batch.position)
    rest = reader.read(1.0)
    assert sum(one.length for one in rest.samples) == 10
    assert rest.refused == 1
    with path.open("a") as file:
        file.write(lines[0][:-1])
    path.rename(tmp_path / "old")
    path.write_text(head + "".join(lines[:4]))
    found = [reader.read(2.0) for _ in range(2)]  # the end of the old file, and the new one from its beginning
    assert [sum(one.length for one in batch.samples) for batch in found] == [1, 4]
    reader.close()


def test_replay(tmp_path):
    path = tmp_path / "plant.csv"
    path.write_text("t,y\n" + "".join(f"2026-01-01T00:00:{t:02d},{t}\n" for t in range(30)))
    digest = ReplaySource("r", str(path)).open(None).read(1.0).position[1]
    reader = ReplaySource("r", str(path)).open([5, digest])
    fast = reader.read(1.0)
    assert (fast.samples[0].length, fast.position, reader.noticed) == (25, [30, digest], "")
    other = ReplaySource("r", str(path)).open([5, "of another file"])
    assert (other.read(1.0).samples[0].length, "is another file" in other.noticed) == (30, True)
    slow = ReplaySource("r", str(path), time="t", speed=100.0).open(None)
    begun, count = time.monotonic(), 0
    while count < 30:
        count += sum(one.length for one in slow.read(0.5).samples)
    assert 0.25 < time.monotonic() - begun < 5.0
    with pytest.raises(ValueError, match="no column"):
        ReplaySource("r", str(path), time="when").check()


def test_a_request_that_one_of_two_units_takes_is_not_refused(tmp_path):
    config = configured(UNIT + UNIT.replace('"y"', '"p"').replace('["u"]', '["q"]'), source=HTTP)
    engine = opened(config, tmp_path)
    with running(engine, SourceThread(engine, config.sources[0])):
        answers = [
            INCOMING.offer("plant/a", b'{"t": %d, "%s": 1}' % (t, name))
            for t, name in ((1, b"y"), (1, b"y"), (2, b"z"))
        ]
    assert [answer.get("status", 200) for answer in answers] == [200, 200, 422]  # taken, sent again, of neither


def test_http_samples_are_answered_when_they_are_in_the_journal(tmp_path):
    config = configured(source=HTTP)
    engine = opened(config, tmp_path)
    with running(engine, SourceThread(engine, config.sources[0])):
        body = json.dumps({"plant/a": {"t": [1.0, 2.0], "y": [1.0, 2.0]}, "plant/b": {"x": {}}}).encode()
        answer = INCOMING.offer("", body)
        assert answer["received"] == 2
        assert "plant/b" in answer["refused"][0]
        assert "status" not in answer
        assert len(rows_of(engine, 1)[0]) == 2
        for topic, sent, status, reason in (
            ("plant/a", b"{", 400, "not an object"),
            ("", b"[1, 2]", 400, "not an object"),
            ("", b"{}", 400, "no topic"),
            ("nothing", b'{"t": 3, "y": 1}', 422, "no unit for the topic (1)"),
            ("plant/a", b'{"t": 3, "pressure": 1}', 422, "no signal (1)"),
            ("plant/a", b'{"t": [1e11, 1e12], "y": 1}', 422, "time in the future (2)"),
            ("plant/a", b'{"y": [1, 2]}', 422, "no time (2)"),
            ("plant/a", b'{"t": [5, 6], "y": [1]}', 422, "different lengths (t 2, y 1)"),
            ("", b'{"plant/a": {"t": [5, 6], "y": [1]}}', 422, "different lengths (t 2, y 1)"),
            ("plant/a", b'{"t": [], "y": []}', 422, "0 samples in one message"),
        ):
            answer = INCOMING.offer(topic, sent)
            assert (answer["status"], reason in answer["error"]) == (status, True), answer
        answer = INCOMING.offer("plant/a", b'{"t": [2, 3, 1e12], "y": 1}')  # two of them are left out, one is taken
        assert "status" not in answer
        assert answer["left_out"] == {"duplicate": 1, "time in the future": 1}
        answer = INCOMING.offer("plant/a", b'{"t": [4, 5, 6, 7], "y": ["1.5", "high", null, Infinity]}')
        assert answer["missing"]["plant/a"]["y"] == {"count": 3, "first": [1, 2, 3]}  # a number as text is one
        assert answer["missing"]["plant/a"]["u"]["count"] == 4
        assert "status" not in INCOMING.offer("plant/a", b'{"t": 3, "y": 1}')  # sent again, as after a lost answer
        assert len(rows_of(engine, 1)[0]) == 7
    names = Names(engine.journal)
    names.read()
    assert names.about["a"]["names"] == ["a1", "b1[u]"]
