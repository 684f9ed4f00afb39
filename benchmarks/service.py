"""The speed of the service: samples per second end to end, latency, memory, and its parts.

    python benchmarks/service.py                 all parts at a small size, some two minutes
    python benchmarks/service.py mqtt            one part: journal, engine, mqtt, latency, http, units, soak, fuzz
    python benchmarks/service.py soak --seconds 900
    python benchmarks/service.py fuzz --count 100000
    chrt -r 1 python benchmarks/service.py latency         where other programs use the processor too
    python benchmarks/service.py --quick         the parts that need no broker, or those given, in seconds

The model is ARX(1, 1), tracked by Kalman(q=1e-4, r=0.1), with times; each sample is journaled before the update. The
floor of MQTT is the same broker and client with an empty handler. The peer is what one writes by hand with filterpy:
the client's handler calls a Kalman filter of two parameters, without journal, sinks, limits or page.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import importlib.util
import json
import shutil
import socket
import sqlite3
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np

from driftfit import track
from driftfit.data.storage import describe
from driftfit.service.config import parse
from driftfit.service.connect.base import Batch, decode
from driftfit.service.connect.http import INCOMING, decoded
from driftfit.service.core.engine import Engine
from driftfit.service.supervisor import SinkThread, SourceThread, cut_the_tail

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
from service_support import HTTP
from service_support import UNIT as TESTED

UNIT = TESTED + "rate = 1e6\n"
ODD = list(b'0123456789.,:[]{}"-eEtyu nulNa\\\x00\xff')


def say(what, value):
    print(f"{what:<58} {value}", flush=True)


def memory():
    """Resident megabytes of this process."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmRSS"):
            return int(line.split()[1]) / 1024
    return 0.0


def payload(first, count, rng):
    t = [float(first + k) for k in range(count)]
    return json.dumps(
        {"t": t, "y": rng.normal(size=count).round(4).tolist(), "u": rng.normal(size=count).round(4).tolist()}
    )


def journal(options, folder):
    """Group commit: SQLite in WAL mode with FULL, and an append-only file with fsync."""
    for group in (1, 100, 1000):
        blob = os.urandom(30 * group)
        db = sqlite3.connect(folder / f"g{group}.db", isolation_level=None)
        db.execute("pragma journal_mode=wal")
        db.execute("pragma synchronous=full")
        db.execute("create table log (first integer primary key, items blob)")
        begun, times = time.perf_counter(), 100
        for k in range(times):
            db.execute("begin")
            db.execute("insert into log values (?, ?)", (k, blob))
            db.execute("commit")
        sqlite = (time.perf_counter() - begun) / times
        with open(folder / f"g{group}.log", "ab") as file:
            begun = time.perf_counter()
            for _ in range(times):
                file.write(blob)
                file.flush()
                os.fsync(file.fileno())
            plain = (time.perf_counter() - begun) / times
        say(
            f"journal, groups of {group}: SQLite, file (us per sample)",
            f"{sqlite / group * 1e6:.2f} {plain / group * 1e6:.2f}",
        )


def engine(options, folder):
    """The engine alone: decoded batches of 20 samples of each of 1,000 units, to stored results; with alarms too."""
    for kinds in ((), ("band",), ("glr",)):
        one = Engine(parse(HTTP + UNIT), folder / "-".join(("engine", *kinds)))
        watched(one, options.units, kinds)
        wall, cpu = fed(one, options.units, 10)
        what = f"engine, {options.units} units, batches of 20{', alarms ' * bool(kinds)}{' and '.join(kinds)}"
        say(f"{what} (samples/s, CPU us)", f"{wall:.0f} {cpu:.1f}")
        one.close() if kinds else one.journal.close()
    begun = time.perf_counter()
    two = Engine(parse(HTTP + UNIT), folder / "engine")
    say("recovery after a crash (samples/s)", f"{two.recovered / (time.perf_counter() - begun):.0f}")
    two.close()


def watched(one, units, kinds):
    """Make the units, with the rules of a reference run."""
    warm(one, units)
    y, u = np.random.default_rng(0).normal(size=(2, 500))
    settings = one.config.units[0]
    run = track(settings.model, settings.tracker, y, u[:, None])
    rules = [describe(run.detect(kind, every=1e6, reference=400).rule) for kind in kinds]
    for name in one.units.names if kinds else ():
        one.act(name, {"do": "calibrated", "rules": rules})
    one.step(0.0)
    assert all(len(unit.alarms) == len(kinds) for unit in one.units.resident)


def fed(one, units, rounds):
    """(samples/s, us of CPU of each) of some rounds of 20 samples of every unit, after the first."""
    rng = np.random.default_rng(0)
    bodies = [[payload(20 * k, 20, rng) for _ in range(50)] for k in range(rounds)]
    for k in range(rounds):
        if k == 1:
            begun, cpu = time.perf_counter(), time.process_time()
        for unit in range(units):
            samples = decode(f"plant/{unit}", bodies[k][unit % 50])
            one.intake._batches.append(("web", Batch([samples], arrived=time.monotonic())))
        while one.intake._batches:
            one.step(0.0)
    while one._pending:
        one.step(0.0)
    count = units * 20 * (rounds - 1)
    return count / (time.perf_counter() - begun), (time.process_time() - cpu) / count * 1e6


class Broker:
    """mosquitto on a port of its own."""

    def __init__(self, folder):
        with socket.socket() as one:
            one.bind(("127.0.0.1", 0))
            self.port = one.getsockname()[1]
        lines = [
            f"listener {self.port} 127.0.0.1",
            "allow_anonymous true",
            "max_queued_messages 1000000",
            "max_inflight_messages 1000",
        ]
        (folder / "broker.conf").write_text("\n".join(lines) + "\n")
        program = shutil.which("mosquitto") or "/usr/sbin/mosquitto"
        self.process = subprocess.Popen([program, "-c", folder / "broker.conf"], stderr=subprocess.DEVNULL)
        time.sleep(0.5)


SENDER = """
import sys, time, json, random
from paho.mqtt.client import Client
from paho.mqtt.enums import CallbackAPIVersion
port, messages, size, units, rate = map(int, sys.argv[1:])
client = Client(CallbackAPIVersion.VERSION2, "sender")
client.max_inflight_messages_set(1000); client.connect("127.0.0.1", port); client.loop_start()
clock, begun, sent = [0] * units, time.time(), []
for k in range(messages):
    unit = k % units
    t = [clock[unit] + j for j in range(size)]; clock[unit] += size
    body = json.dumps({"t": t, "y": [random.gauss(0, 1)] * size, "u": [random.gauss(0, 1)] * size})
    sent.append(client.publish(f"plant/{unit}", body, qos=1))
    ahead = begun + k / rate - time.time()
    if ahead > 0.002: time.sleep(ahead)
for one in sent: one.wait_for_publish(60)
"""


def send(broker, messages, size, units, rate=1_000_000):
    arguments = [broker.port, messages, size, units, rate]
    return subprocess.Popen([sys.executable, "-c", SENDER, *map(str, arguments)])


def mqtt(options, folder):
    """Over MQTT: the floor, a consumer by hand, the service without and with a sink."""
    known = importlib.util.find_spec("filterpy") is not None
    print(f"{'mqtt: samples in a message, handler':<44}{'samples/s':>10}{'CPU us':>8}  source engine   sink")
    for size, messages in ((1, 20_000), (20, 20_000)):
        broker, count = Broker(folder), messages * size
        line(f"{size}, empty (the floor)", count, listened(broker, messages, size, options.units, lambda *_: None))
        if known:
            line(f"{size}, filterpy by hand", count, listened(broker, messages, size, options.units, Peer().handle))
        for what in ("none", "sqlite"):
            found = served(broker, folder / f"{what}{size}", messages, size, options.units, sink=what)
            line(f"{size}, the service, sink {what}", count, found[:2], found[3])
        broker.process.terminate()


def latency(options, folder):
    """Seconds from the arrival of a message to its result, and until it is in the sink, at two rates."""
    for rate in (5_000, 20_000):
        broker = Broker(folder)
        *_, found, _ = served(broker, folder / f"at{rate}", rate // 4, 20, options.units, rate // 20)
        broker.process.terminate()
        for name, key in (("result", ""), ("sink", "sink ")):
            what = f"mqtt at {rate} samples/s in messages of 20, to {name}: p50, p99 (ms)"
            say(what, f"{found[f'{key}p50'] * 1e3:.1f} {found[f'{key}p99'] * 1e3:.1f}")


def line(what, count, found, stages=None):
    seconds, used = found
    each = [] if stages is None else [f"{stages.get(name, 0.0) / count * 1e6:7.2f}" for name in STAGES]
    print(f"{what:<44}{count / seconds:>10.0f}{used / count * 1e6:>8.2f} {''.join(each)}", flush=True)


class Peer:
    """What one writes by hand: filterpy's Kalman filter on the regressors of ARX(1, 1)."""

    def __init__(self):
        self.filters = {}

    def handle(self, topic, body):
        from filterpy.kalman import KalmanFilter

        found = self.filters.get(topic)
        if found is None:
            one = KalmanFilter(dim_x=2, dim_z=1)
            one.P *= 1e3
            one.R *= 0.1
            one.Q *= 1e-4
            found = self.filters[topic] = [one, np.zeros((1, 2))]
        data = json.loads(body)
        for y, u in zip(data["y"], data["u"], strict=True):
            found[0].predict()
            found[0].update(y, H=found[1])
            found[1] = np.array([[y, u]])


def listened(broker, messages, size, units, handle):
    """(seconds, seconds of CPU) of a client with a handler, for all messages."""
    from paho.mqtt.client import Client
    from paho.mqtt.enums import CallbackAPIVersion

    done, count = threading.Event(), [0]

    def heard(client, user, message):
        handle(message.topic, message.payload)
        client.ack(message.mid, message.qos)
        count[0] += 1
        if count[0] >= messages:
            done.set()

    client = Client(CallbackAPIVersion.VERSION2, "listener", clean_session=True, manual_ack=True)
    client.on_message = heard
    client.on_connect = lambda one, *_: one.subscribe("plant/+", 1)
    client.connect("127.0.0.1", broker.port)
    client.loop_start()
    time.sleep(0.3)
    sender = send(broker, messages, size, units)
    while not count[0]:
        time.sleep(0.01)
    begun, cpu = time.perf_counter(), time.process_time()
    done.wait(300)
    found = time.perf_counter() - begun, time.process_time() - cpu
    client.disconnect()
    client.loop_stop()
    sender.wait()
    return found


STAGES = ("driftfit-source", "engine", "driftfit-sink")
"""How the names of the threads begin."""


def clocks():
    """Seconds of CPU of every thread, by how its name begins."""
    found = dict.fromkeys(STAGES, 0.0)
    for thread in threading.enumerate():
        for name in STAGES:
            if thread.name.startswith(name):
                found[name] += time.clock_gettime(time.pthread_getcpuclockid(thread.ident))
    return found


def served(broker, folder, messages, size, units, rate=1_000_000, sink="sqlite"):
    """(seconds, seconds of CPU, status, seconds of CPU by stage) of the service for all messages."""
    source = f'[source.plant]\nkind = "mqtt"\nurl = "mqtt://127.0.0.1:{broker.port}"\ntopic = "plant/+"\n'
    more = "" if sink == "none" else f'[[sink]]\nkind = "{sink}"\npath = "{folder}.db"\n'
    config = parse(source + UNIT + more)
    one = Engine(config, folder)
    warm(one, units)
    runners = [SourceThread(one, config.sources[0]), *(SinkThread(one, each) for each in config.sinks)]
    worker = threading.Thread(target=one.run, name="engine")
    for thread in (*runners, worker):
        thread.start()
    time.sleep(1.0)
    cut_the_tail()
    sender, before = send(broker, messages, size, units, rate), one.samples
    while one.samples == before:
        time.sleep(0.01)
    begun, cpu, first = time.perf_counter(), time.process_time(), clocks()
    for each in (one, *runners[1:]):
        each.latencies.clear()
    while time.perf_counter() - begun < 300 and (
        one.samples - before < messages * size or any(sink.count < messages * size for sink in runners[1:])
    ):
        time.sleep(0.01)
    last = clocks()
    status = one.status() | {f"sink {key}": value for sink in runners[1:] for key, value in sink.status().items()}
    found = time.perf_counter() - begun, time.process_time() - cpu, status
    for runner in runners:
        runner.stop()
    one.stop()
    for thread in (*runners, worker):
        thread.join(30)
    one.close()
    sender.wait()
    return *found, {name: last[name] - first[name] for name in STAGES}


def warm(one, units):
    """Make the units before the clock starts."""
    for unit in range(units):
        one.intake._batches.append(("plant", Batch([decode(f"plant/{unit}", b'{"t": -1, "y": 0, "u": 0}')])))
    one.step(0.0)


def http(options, folder):
    """Bodies of POST /api/samples, each with 20 samples of 50 units, as the page's process hands them over."""
    rng, config = np.random.default_rng(0), parse(HTTP + UNIT)
    one = Engine(config, folder)
    warm(one, options.units)
    runner, worker = SourceThread(one, config.sources[0]), threading.Thread(target=one.run, name="engine")
    runner.start()
    worker.start()
    bodies = []
    for k in range(200):
        first = 20 * (50 * k // options.units)
        topics = [f"plant/{(50 * k + j) % options.units}" for j in range(50)]
        bodies.append(json.dumps({topic: json.loads(payload(first, 20, rng)) for topic in topics}).encode())
    begun, cpu, waits = time.perf_counter(), time.process_time(), []
    for body in bodies:
        then = time.perf_counter()
        INCOMING.offer("", body)
        waits.append(time.perf_counter() - then)
    wall, cpu = time.perf_counter() - begun, time.process_time() - cpu
    count = 200 * 1000
    say("http bodies of 1,000 samples (samples/s, CPU us)", f"{count / wall:.0f} {cpu / count * 1e6:.1f}")
    say(
        "http: p50, p99 until a body is in the journal (ms)",
        f"{np.median(waits) * 1e3:.1f} {np.quantile(waits, 0.99) * 1e3:.1f}",
    )
    runner.stop()
    one.stop()
    worker.join(30)
    one.close()


def units(options, folder):
    """Memory of many units."""
    one = Engine(parse(HTTP + UNIT + f"[service]\nnew_units = {options.many}\n"), folder)
    before, count = memory(), options.many
    begun = time.perf_counter()
    for unit in range(count):
        one.intake._batches.append(
            ("web", Batch([decode(f"plant/{unit}", b'{"t": [1, 2, 3], "y": [1, 2, 3], "u": [1, 1, 2]}')]))
        )
        if unit % 1000 == 999:
            one.step(0.0)
    one.step(0.0)
    each = (memory() - before) / count * 1024
    say(f"{count} units: KB each; GB of 100,000", f"{each:.1f} {each * 1e5 / 1024**2:.2f}")
    say("making a unit (ms)", f"{(time.perf_counter() - begun) / count * 1e3:.2f}")
    one._stop.set()
    one.journal.close()


def soak(options, folder):
    """A steady rate of 2,000 samples a second, with a sink: memory, and samples, in ten parts of the time."""
    sink = f'[[sink]]\nkind = "sqlite"\npath = "{folder / "sink.db"}"\n'
    config, rng = parse(HTTP + UNIT + sink), np.random.default_rng(0)
    one = Engine(config, folder)
    runner, worker = SinkThread(one, config.sinks[0]), threading.Thread(target=one.run, name="engine")
    runner.start()
    worker.start()
    begun, clock, part = time.monotonic(), 0, 0
    print(f"{'soak: seconds':>14} {'samples':>9} {'in the sink':>12} {'MB':>7} {'CPU us':>7}", flush=True)
    while part < 10:
        for unit in range(100):
            one.intake.put("web", Batch([decode(f"plant/{unit}", payload(clock, 20, rng))], arrived=time.monotonic()))
        clock += 20
        time.sleep(max(0.0, begun + clock / 20 - time.monotonic()))
        passed = time.monotonic() - begun
        if passed >= (part + 1) * options.seconds / 10:
            part += 1
            each = time.process_time() / max(one.samples, 1) * 1e6
            print(f"{passed:>14.0f} {one.samples:>9} {runner.count:>12} {memory():>7.1f} {each:>7.1f}", flush=True)
    runner.stop()
    one.stop()
    for thread in (worker, runner):
        thread.join(30)
    one.close()


def fuzz(options, folder):
    """Damaged messages: each refused or counted, memory flat."""
    rng, one = np.random.default_rng(1), Engine(parse(HTTP + UNIT), folder)
    good, refused, start = payload(0, 3, rng).encode(), 0, 0.0
    for k in range(options.count):
        text = bytearray(good if rng.uniform() < 0.7 else rng.bytes(int(rng.integers(1, 80))))
        for _ in range(int(rng.integers(1, 4))):
            text[int(rng.integers(len(text)))] = int(rng.choice(ODD))
        topic = f"plant/{rng.integers(20)}" if rng.uniform() < 0.8 else rng.bytes(5).decode("latin1")
        samples, wrong, _ = decoded(topic, bytes(text))
        refused += len(wrong)
        one.intake._batches.append(("web", Batch(samples, refused=len(wrong))))
        if k % 200 == 199:
            one.step(0.0)
        if k == options.count // 5:
            start = memory()
    one.step(0.0)
    failed = sum(bool(unit.failure) for unit in one.units.resident)
    say(f"{options.count} fuzzed messages: refused, units that failed", f"{refused} {failed}")
    say("memory after a fifth and at the end (MB)", f"{start:.0f} {memory():.0f}")
    one.close()


PARTS = {
    "journal": journal,
    "engine": engine,
    "mqtt": mqtt,
    "latency": latency,
    "http": http,
    "units": units,
    "soak": soak,
    "fuzz": fuzz,
}


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("parts", nargs="*", choices=[[], *PARTS], default=[])
    parser.add_argument("--units", type=int, default=1000)
    parser.add_argument("--many", type=int, default=2000)
    parser.add_argument("--seconds", type=int, default=20)
    parser.add_argument("--count", type=int, default=5000)
    parser.add_argument("--quick", action="store_true")
    options = parser.parse_args()
    if options.quick:
        options.parts = options.parts or ["journal", "engine", "fuzz"]
        options.units, options.count, options.seconds = 20, 500, 2
    for name in options.parts or [name for name in PARTS if name != "soak"]:
        with tempfile.TemporaryDirectory(prefix="driftfit-benchmark-", dir=os.environ.get("TMPDIR")) as folder:
            PARTS[name](options, Path(folder))


if __name__ == "__main__":
    main()
