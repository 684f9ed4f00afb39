"""Small services for tests: one model and tracker, which other tests compile too."""

import contextlib
import http.server
import json
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request

import numpy as np

from driftfit import ARX, Kalman, track
from driftfit.service.config import parse
from driftfit.service.connect.base import Batch, decode
from driftfit.service.core.engine import Engine
from driftfit.service.core.journal import Rows

MODEL, TRACKER = ARX(1, 1), Kalman(q=1e-4, r=0.1)
UNIT = """
[[unit]]
match = "plant/{pump}"
y = "y"
u = ["u"]
time = "t"
dt = 1.0
model = "ARX(1, 1)"
tracker = "Kalman(q=1e-4, r=0.1)"
"""
HTTP = '[source.web]\nkind = "http"\n'


def configured(unit=UNIT, more="", source=HTTP):
    return parse(source + unit + more)


def record(T=400, seed=0):
    rng = np.random.default_rng(seed)
    u, y = rng.normal(size=T), np.zeros(T)
    for t in range(1, T):
        y[t] = 0.8 * y[t - 1] + 0.5 * u[t - 1] + 0.1 * rng.normal()
    return y, u


def run_of(y, u, time=None, **more):
    return track(
        MODEL, TRACKER, y, u, time=np.arange(len(y)) * 1.0 if time is None else time, dt=1.0, gate=True, **more
    )


def rows_of(engine, unit):
    """(times, values) of a unit, by its number, that the log has, in the order of their arrival."""
    rows = [item for _, items in engine.journal.groups(1) for item in items if isinstance(item, Rows)]
    own = [item.some(item.unit == unit) for item in rows]
    return [t for one in own for t in one.time.tolist()], [row for one in own for row in one.values.tolist()]


def coded():
    y, u = record(100)
    y[[5, 60]] = 9999.0
    return y, u


def message(topic, t, y, u, **more):
    columns = {"t": list(map(float, t)), "y": list(map(float, y)), "u": list(map(float, u))}
    return Batch([decode(topic, json.dumps(columns | more))], arrived=time.monotonic())


def feed(engine, batch):
    """One message, journaled and processed; True once it was acknowledged."""
    done = []
    engine.intake.put("web", batch._replace(acknowledge=lambda: done.append(1)))
    engine.step(0.0)
    return bool(done)


def settled(engine):
    """Store the results that wait for the next transaction."""
    while engine._pending:
        engine.step(0.0)


def stored(engine):
    """Store the states, and close."""
    engine._store_states(everything=True)
    engine._commit()
    engine.close()


def results_of(engine):
    """All stored results, as rows."""
    settled(engine)
    return [row for _, parts, *_ in engine.journal.outcomes(0, 10**6) for one in parts for row in one.rows()]


def events(engine, kind=None):
    settled(engine)
    found = engine.journal.db.execute("select kind, detail from event order by rowid").fetchall()
    return [json.loads(detail) for one, detail in found if kind in (None, one)]


def opened(config, folder):
    return Engine(config, folder)


def varint(value):
    found = bytearray()
    while True:
        value, low = value >> 7, value & 0x7F
        found.append(low | (0x80 if value else 0))
        if not value:
            return bytes(found)


def field(number, value):
    """A field of a protobuf message, from a whole number, a text or bytes; floats as double."""
    if isinstance(value, float):
        return varint(number << 3 | 1) + struct.pack("<d", value)
    if isinstance(value, int):
        return varint(number << 3) + varint(value)
    value = value.encode() if isinstance(value, str) else value
    return varint(number << 3 | 2) + varint(len(value)) + value


def metric(value, name=None, alias=None, when=None, kind=10, **more):
    """A metric of Sparkplug B; fields by their names in its definition."""
    numbers = {"historical": 5, "null": 7}
    parts = [(1, name), (2, alias), (3, when), (4, kind), *((numbers[key], one) for key, one in more.items())]
    which = 13 if isinstance(value, float) else 14 if isinstance(value, bool) else 10 if isinstance(value, int) else 15
    data = b"".join(field(number, one) for number, one in (*parts, (which, value)) if one is not None)
    return field(2, data)


def free_port():
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


def started(port, *what):
    command = [sys.executable, "-m", "driftfit", "serve", *(what or ["--demo"]), "--port", str(port)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    until = time.monotonic() + 90
    while time.monotonic() < until:
        try:
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/healthz", timeout=2):
                return process
        except (urllib.error.URLError, OSError):
            assert process.poll() is None, process.stderr.read()
            time.sleep(0.2)
    raise TimeoutError


def stopped(process):
    process.send_signal(signal.SIGTERM)
    result = process.communicate(timeout=60)[1]
    assert process.returncode == 0, result
    return [json.loads(line) for line in result.splitlines() if line.startswith("{")]


def until(what, seconds=30.0):
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        with contextlib.suppress(OSError):
            if found := what():
                return found
        time.sleep(0.02)
    raise TimeoutError


@contextlib.contextmanager
def running(engine, *runners):
    """Runners of sources and sinks, and the engine, until the end of the block."""
    worker = threading.Thread(target=engine.run, daemon=True)
    for one in (*runners, worker):
        one.start()
    yield
    for one in runners:
        one.stop()
    engine.stop()
    for one in (*runners, worker):
        one.join(20)


class Receiver(http.server.BaseHTTPRequestHandler):
    """Answers with the statuses in ``answers``, and keeps what came."""

    got, answers = [], []

    def do_POST(self):
        body = self.rfile.read(int(self.headers["content-length"])).decode()
        read = json.loads(body) if self.headers["content-type"] == "application/json" else body
        self.got.append((self.headers["idempotency-key"], read, self.headers["title"]))
        self.answer()

    def do_GET(self):
        self.got.append(("GET", self.path, self.headers["authorization"]))
        self.answer()

    def answer(self):
        self.send_response(self.answers.pop(0) if self.answers else 200)
        self.send_header("location", "/elsewhere")
        self.end_headers()

    def log_message(self, *args):
        pass


@contextlib.contextmanager
def receiver(*answers):
    """The address of a server on this machine that gives these answers, then 200."""
    Receiver.got.clear()
    Receiver.answers[:] = answers
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Receiver)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}/x"
    server.shutdown()
    server.server_close()


@contextlib.contextmanager
def serving(*what):
    """The port of a service in a process of its own."""
    port = free_port()
    process = started(port, *what)
    try:
        yield port
    finally:
        stopped(process)
        process.stderr.close()
