"""The page and the HTTP interface: who may do what, bounds, downsampling, and a real browser."""

import asyncio
import io
import json
import os
import random
import re
import signal
import time
import urllib.error
import urllib.request
from pathlib import Path

import numpy as np
import polars as pl
import pytest

pytest.importorskip("starlette", reason="the page needs driftfit[serve]")
pytest.importorskip("msgspec", reason="the service needs driftfit[serve]")

import browser
from service_support import (
    UNIT,
    Receiver,
    configured,
    feed,
    free_port,
    message,
    opened,
    receiver,
    record,
    serving,
    settled,
    started,
    stopped,
    until,
)

import driftfit
from driftfit.service.connect.http import INCOMING
from driftfit.service.control import Control
from driftfit.service.core.journal import sum_of
from driftfit.service.core.results import extremes_of
from driftfit.service.options import PageOptions, UserOptions
from driftfit.service.page.access import Sessions, hashed, new_token, password_fits, token_fits
from driftfit.service.page.app import Page, Sockets
from driftfit.service.page.feed import Feed, reduced

TOKEN, HASH = (line.split(": ")[1] for line in new_token())
WATCHER, GATEWAY = ([line.split(": ")[1] for line in new_token()] for _ in range(2))
PASSWORD = hashed("a long password")
USERS = [
    UserOptions("Ann", "operator", PASSWORD), UserOptions("robot", "operator", token=HASH),
    UserOptions("screen", "viewer", token=WATCHER[1]), UserOptions("gateway", "sender", token=GATEWAY[1], units=["a"]),
]  # fmt: skip
ANN, SENDER, HOME = USERS[0], USERS[3], "http://localhost:8765"


class Client:
    """Requests to an application, without a network."""

    def __init__(self, app, host="localhost:8765"):
        self.app, self.host = app, host

    def __call__(self, method, path, body=b"", **headers):
        path, _, query = path.partition("?")
        body = body if isinstance(body, bytes) else json.dumps(body).encode()
        given = {"host": self.host, "content-length": str(len(body))} | {
            k.replace("_", "-"): v for k, v in headers.items()
        }
        scope = {
            "type": "http", "method": method, "path": path, "raw_path": path.encode(), "query_string": query.encode(),
            "headers": [(k.encode(), v.encode()) for k, v in given.items()], "client": ("10.0.0.1", 1),
            "scheme": "http", "server": ("localhost", 8765), "root_path": "", "http_version": "1.1", "state": {},
        }  # fmt: skip
        sent, waiting = [], [{"type": "http.request", "body": body, "more_body": False}]

        async def receive():
            if not waiting:
                await asyncio.sleep(60)  # the client stays
            return waiting.pop(0)

        async def send(message):
            sent.append(message)

        asyncio.run(self.app(scope, receive, send))
        self.headers = {k.decode(): v.decode() for k, v in sent[0]["headers"]}
        return sent[0]["status"], b"".join(one.get("body", b"") for one in sent)


@pytest.fixture(scope="module")
def service(tmp_path_factory):
    """An engine with two units and 400 samples each, and a feed over its folder."""
    folder = tmp_path_factory.mktemp("service")
    y, u = record()
    engine = opened(configured(), folder)
    for pump in ("a", "b c"):
        feed(engine, message(f"plant/{pump}", range(400), y, u))
    settled(engine)
    control = Control(engine, folder / "c", engine.status)
    control.start()
    found = Feed(folder, folder / "c")
    found.look()
    found.rank()
    yield engine, found, folder
    control.close()


@pytest.fixture
def client(service):
    _, found, folder = service
    return lambda host="localhost:8765", **options: Client(
        Page(PageOptions(**options), found, Sessions(folder)).app(), host
    )


def test_what_the_interface_says(service, client):
    ask = client()
    status, body = ask("GET", "/api/units")
    assert status == 200
    assert {one["unit"] for one in json.loads(body)["units"]} == {"a", "b c"}
    assert "default-src 'self'" in ask.headers["content-security-policy"]
    status, body = ask("GET", "/api/units/b c")
    found = json.loads(body)
    assert found["now"]["theta"]["a1"] == service[0].units.get(2).live.theta[0]
    assert found["state"]["counts"]["samples"] == 400
    assert ask("GET", "/api/units/nobody")[0] == 404
    assert b"driftfit_units 2" in ask("GET", "/metrics")[1] or b"driftfit_samples_total" in ask("GET", "/metrics")[1]
    assert b"<title>driftfit</title>" in ask("GET", "/")[1]
    about = json.loads(ask("GET", "/api/openapi.json")[1])
    routes = {
        one.path.replace("{unit:path}", "{id}").replace(":path", "") for one in ask.app.routes if "api/" in one.path
    }
    assert {path for path in about["paths"] if "api" in path} | {"/api/openapi.json"} == routes


def test_units_that_fell_silent_before_the_page_started_are_shown_as_silent(tmp_path):
    """They were left out, or seen "now": what a restart hid was the sensor that had died."""
    y, u = record()
    engine = opened(configured(), tmp_path)
    for pump in "abc":
        feed(engine, message(f"plant/{pump}", range(40), y[:40], u[:40]))
        settled(engine)
    db = engine.journal.db
    db.execute("delete from result where first <= 40")  # of a, as after a minute
    for first, count, at, rows, _ in db.execute("select * from result where first <= 80").fetchall():
        changed = (first, count, at - 5000, rows)
        db.execute("replace into result values (?, ?, ?, ?, ?)", (*changed, sum_of(*changed)))
    found = Feed(tmp_path, tmp_path / "c")
    found.look()
    found.rank()
    lines = {one["unit"]: one for one in found.fleet}
    assert [one["unit"] for one in found.fleet][-1] == "a"
    assert [lines[pump]["silent"] for pump in "abc"] == [True, True, False]
    assert lines["a"]["age"] is None
    assert 5000.0 <= lines["b"]["age"] < 5100.0
    ask = Client(Page(PageOptions(), found, Sessions(tmp_path)).app())
    for pump in "abc":
        (one,) = json.loads(ask("GET", f"/api/units?search={pump}")[1])["units"]
        assert (one["unit"], one["silent"]) == (pump, pump != "c")


def test_exports_and_history_are_the_samples(service, client):
    engine = service[0]
    ask, live = client(), engine.units.get(1).live
    table = pl.read_csv(ask("GET", "/api/export?unit=a&format=csv")[1])
    arrow = pl.read_ipc(io.BytesIO(ask("GET", "/api/export?unit=a&format=arrow")[1]))
    assert table.columns[:5] == ["time", "y", "y_hat", "e", "e_std"]
    assert arrow.shape == (400, 9)
    assert np.array_equal(arrow["a1"][-1:], live.theta[:1])
    part = pl.read_ipc(io.BytesIO(ask("GET", "/api/export?unit=a&format=arrow&from=100&to=109")[1]))
    assert part["time"].to_list() == list(range(100, 110))
    for points in (20, 100, 400):
        answer = json.loads(ask("GET", f"/api/history?unit=a&points={points}")[1])
        assert answer["count"] == 400
        assert len(answer["mean"][0]) <= points
        low, high, mean = (np.array(answer[name][1], float) for name in ("low", "high", "mean"))
        assert (min(low), max(high)) == (min(arrow["y"]), max(arrow["y"]))
        assert (low <= mean + 1e-12).all()
        assert (mean <= high + 1e-12).all()
    assert ask("GET", "/api/export?unit=a&format=exe")[0] == 400
    assert ask("GET", "/api/history?unit=a&points=many")[0] == 400


def test_a_million_samples_are_reduced_by_blocks(tmp_path):
    engine = opened(configured(), tmp_path)
    feed(engine, message("plant/a", range(2), [0, 1], [0, 1]))
    rng, db = np.random.default_rng(0), engine.journal.db
    db.execute("begin")
    for k in range(2000):
        values = np.column_stack([np.arange(64.0) + 64 * k, rng.normal(size=(64, 8))])
        row = (1, 100 + 64 * k, 163 + 64 * k, values[0, 0].item(), values[-1, 0].item(), 64)
        row = (*row, extremes_of(values).tobytes())
        db.execute("insert into block values (?, ?, ?, ?, ?, ?, ?, ?)", (*row, sum_of(*row)))
    db.execute("commit")
    begun = time.process_time()
    answer = reduced(engine.journal, 1, [], -np.inf, np.inf, 500)
    assert time.process_time() - begun < 2.0
    assert answer["count"] == 128_000
    assert len(answer["mean"][1]) == 500
    assert abs(np.mean(answer["mean"][1])) < 0.02


def test_a_program_on_this_machine_needs_no_password_and_a_foreign_page_cannot_act(service, client):
    engine = service[0]
    act = {"unit": "a", "do": "hold", "on": True, "why": "cleaning the sensor"}
    ask = client()
    for headers in ({"origin": "http://evil.example"}, {"origin": "null"}):
        assert ask("POST", "/api/actions", act, **headers)[0] == 403
    assert client("evil.example")("GET", "/api/units")[0] == 421
    assert ask("POST", "/api/actions", act | {"why": ""})[0] == 400
    assert ask("POST", "/api/actions", act | {"do": "shutdown"})[0] == 400
    assert ask("POST", "/api/actions", b"[" * 50_000)[0] == 400
    assert ask("POST", "/api/actions", act | {"unit": "nobody"})[0] == 404
    assert engine.intake.take(10, 0.0).actions == []


def test_a_unit_from_a_file(client):
    """The answer of the command for the record that ships, or its message."""
    ask, pump = client(), Path(driftfit.__file__).parent / "demo" / "pump.csv"
    status, body = ask("POST", "/api/identify?y=flow&name=../pump 7", pump.read_bytes())
    found = json.loads(body)
    assert status == 200
    assert found["headline"].startswith("The effect of pressure on flow")
    assert 'match = "___pump_7"' in found["unit"]
    assert found["page"].startswith("<!doctype html>")
    for query, text in (("y=level", "no column 'level'"), ("y=--help", "no column '--help'"), ("", "")):
        status, body = ask("POST", f"/api/identify?{query}", pump.read_bytes()[:3000] if query else b"\x00garbage")
        assert status == 400
        assert text in json.loads(body)["error"]
    viewer = client(user=USERS)
    assert viewer("POST", "/api/identify", b"", authorization=f"Bearer {WATCHER[0]}")[0] == 403


ACT = {"unit": "a", "do": "acknowledge", "why": "seen"}
SAMPLE = {"t": 1e3, "y": 1.0, "u": 1.0}


@pytest.mark.parametrize(
    ("who", "method", "path", "body", "status", "text"),
    [
        (None, "GET", "/api/units", {}, 401, ""), (None, "GET", "/healthz", {}, (200, 503), ""),
        ("wrong", "GET", "/api/units", {}, 401, ""), ("viewer", "GET", "/api/units", {}, 200, ""),
        ("viewer", "POST", "/api/actions", ACT, 403, "needs an operator"),
        ("viewer", "POST", "/api/samples", {}, 403, "needs a sender"),
        ("robot", "POST", "/api/actions", {"unit": "a"}, 400, "do must be one of"),
        *(("gateway", method, path, ACT, 403, "may only post samples") for method, path in
          (("GET", "/"), ("GET", "/api/units"), ("GET", "/api/status"), ("GET", "/metrics"),
           ("GET", "/api/export?unit=a"), ("POST", "/api/actions"), ("GET", "/api/samplesX"))),
        ("gateway", "POST", "/api/samples", {"plant/a": SAMPLE, "plant/c": SAMPLE}, 403, "samples of c (plant/c)"),
        ("gateway", "POST", "/api/samples/plant/c", SAMPLE, 403, "samples of c (plant/c)"),
    ],
)  # fmt: skip
def test_who_may_do_what(client, who, method, path, body, status, text):
    tokens = {"viewer": WATCHER[0], "robot": TOKEN, "gateway": GATEWAY[0]}
    headers = {} if who is None else {"authorization": f"Bearer {tokens.get(who, who)}"}
    found, answer = client(user=USERS)(method, path, body, **headers)
    assert found in np.ravel(status)
    assert text in answer.decode()
    assert INCOMING.queue.empty()  # also what a sender might have sent
    assert client(user=USERS)("GET", "/", accept="text/html")[0] == 303


def test_sessions(client):
    ask = client(user=USERS)
    wrong = {"name": "Ann", "password": "not this one"}
    assert [ask("POST", "/api/login", wrong | {"name": name})[0] for name in ("Ann", "nobody")] == [401, 401]
    session = logged_in(ask)
    assert {"HttpOnly", "SameSite=strict"} <= set(ask.headers["set-cookie"].split("; "))
    assert json.loads(ask("GET", "/api/me", **session)[1])["role"] == "operator"
    act = {"unit": "a", "do": "no", "why": "seen"}
    assert ask("POST", "/api/actions", act, **session)[0] == 403  # no Origin
    assert ask("POST", "/api/actions", act, origin=HOME, **session)[0] == 400
    assert ask("GET", "/api/me", cookie=session["cookie"][:-2] + "00")[0] == 401
    assert 429 in [ask("POST", "/api/login", wrong | {"password": "short"})[0] for _ in range(15)]


def test_passwords():
    assert password_fits("a long password", PASSWORD)
    assert not password_fits("a long passwore", PASSWORD)
    assert not password_fits("a", "scrypt$x")
    assert token_fits(TOKEN, HASH)
    assert not token_fits(TOKEN + "x", HASH)
    with pytest.raises(ValueError, match="at least 10"):
        hashed("short")
    with pytest.raises(ValueError, match="TLS"):
        PageOptions(host="0.0.0.0", user=USERS)
    with pytest.raises(ValueError, match="units are those of a sender"):
        UserOptions("Ann", "operator", PASSWORD, units=["a"])
    with pytest.raises(ValueError, match="viewer, operator or sender"):
        UserOptions("Ann", "root", PASSWORD)


def logged_in(ask):
    """Headers with the cookie of a session of Ann."""
    assert ask("POST", "/api/login", {"name": "Ann", "password": "a long password"})[0] == 200
    return {"cookie": ask.headers["set-cookie"].partition(";")[0]}


def test_units_of_a_sender_are_named_in_every_section(tmp_path):
    engine = opened(configured(UNIT + UNIT.replace('y = "y"', 'y = "z"')), tmp_path)
    control = Control(engine, tmp_path / "c", dict)
    assert control._foreign(["p:y"])("plant/p") == ["p:z"]
    assert control._foreign(["p:y", "p:z"])("plant/p") == []
    assert control._foreign([])("plant/q") == []
    control.close()


def test_a_session_ends_at_its_logout(service, client):
    ask = client(user=[ANN])
    one, other = logged_in(ask), logged_in(ask)
    assert ask("POST", "/api/logout", origin=HOME, **one)[0] == 200
    assert ask("GET", "/api/me", **one)[0] == 401  # a copy of the cookie
    assert ask("GET", "/api/me", **other)[0] == 200
    again = client(user=[ANN])  # the page's process was restarted
    assert [again("GET", "/api/me", **cookie)[0] for cookie in (one, other)] == [401, 200]


@pytest.mark.parametrize(
    "then", [UserOptions("Ann", "operator", hashed("another password")), SENDER], ids=["password", "user"]
)
def test_a_session_ends_when_the_password_is_changed(client, then):
    cookie = logged_in(client(user=[ANN]))
    assert client(user=[then])("GET", "/api/me", **cookie)[0] == 401


@pytest.mark.parametrize("content", [b"", b"{", b"[]", b'{"x": 1}', bytes(40)])
def test_a_damaged_file_of_sessions_lets_nobody_in(service, client, content):
    folder, cookie = service[2], logged_in(client(user=[ANN]))
    assert cookie["cookie"].partition("=")[2] not in (folder / "sessions.json").read_text()
    (folder / "sessions.json").write_bytes(content)
    ask = client(user=[ANN])
    assert ask("GET", "/api/me", **cookie)[0] == 401
    cookie = logged_in(ask)
    assert client(user=[ANN])("GET", "/api/me", **cookie)[0] == 200


@pytest.mark.parametrize("beside", ["Basic QW5uOng=", "Bearer ", f"Bearer {GATEWAY[0]}"], ids=["Basic", "empty", "key"])
def test_a_cookie_beside_any_authorization_needs_its_origin(client, beside):
    ask, act = client(user=[ANN, SENDER]), {"unit": "a", "do": "no", "why": "an attack"}
    status, body = ask("POST", "/api/actions", act, authorization=beside, **logged_in(ask))
    assert (status, "Origin" in json.loads(body)["error"]) == (403, True)


def test_an_open_page_is_closed_with_its_session(service):
    sent, valid = [], [True, True, False]

    class Socket:
        scope = {"still": lambda: ANN if valid.pop(0) else None}  # noqa: RUF012

        async def send_text(self, text):
            sent.append(text)

        async def close(self, code, reason):
            sent.append(code)

    view = {"view": "fleet", "unit": "", "at": 0}
    asyncio.run(Sockets(service[1], 10)._send(Socket(), view))
    assert [type(one) for one in sent] == [str, str, int]
    assert sent[-1] == 4401


def test_bounds(client):
    ask = client(body=1000)
    assert ask("POST", "/api/samples", b"x" * 2000)[0] == 413
    assert ask("POST", "/api/samples", b"x" * 2000, content_length="10")[0] == 413
    assert ask("POST", "/api/samples", b"x", content_length="-1")[0] == 413
    ask = client(requests=5.0)
    assert {ask("GET", "/healthz")[0] for _ in range(20)} == {200, 429} or ask("GET", "/healthz")[0] == 429


def test_fuzzed_requests(service, client, monkeypatch):
    monkeypatch.setattr(service[1], "control", service[2] / "nobody")  # nothing waits for the engine
    ask, rng = client(requests=1e9), np.random.default_rng(2)
    paths = ["/ws", "/static/../app.py", "/static/%2e%2e/app.py", "/metrics", "/login", "/api/samples/\x00"]
    paths += [f"/api/{one}" for one in ("units", "units/", "history", "export", "events", "actions", "login")]
    names = ["unit", "from", "to", "points", "limit", "format"]
    seen = set()
    for _ in range(1000):
        path = str(rng.choice(paths)) + "?" + "&".join(
            f"{rng.choice(names)}={''.join(map(chr, rng.integers(33, 500, 8)))}"
            for _ in range(int(rng.integers(0, 4)))
        ).replace("#", "").encode("ascii", "replace").decode()  # fmt: skip
        status, _ = ask(str(rng.choice(["GET", "POST", "PUT", "HEAD"])), path, rng.bytes(int(rng.integers(0, 60))))
        seen.add(status)
    assert max(seen) < 504
    assert 500 not in seen


@pytest.mark.skipif(browser.PROGRAM is None, reason="needs Chromium")
def test_the_demo_in_a_browser(tmp_path):
    pytest.importorskip("websockets", reason="the browser is driven by WebSocket")
    pytest.importorskip("uvicorn", reason="the page needs driftfit[serve]")
    port = free_port()
    process = started(port)
    page = browser.Browser()
    try:
        page.open(f"http://127.0.0.1:{port}/")
        page.until("document.querySelectorAll('#units tbody tr').length === 6", 60)
        page.until("document.querySelector('#units tbody tr').dataset.unit === 'pump 3'", 60)  # its valve closes
        page.key("ArrowDown")
        page.key("Enter")
        page.until("document.querySelectorAll('.chart canvas').length === 5")
        page.until("document.querySelector('#events .bad')?.textContent === 'alarm'", 60)
        page.picture(tmp_path / "unit.png")
        assert pl.Series((tmp_path / "unit.png").read_bytes()).n_unique() > 100  # something is drawn
        page.value("[...document.querySelectorAll('#buttons button')].find(b => b.textContent === 'Hold').click()")
        page.value(
            "document.querySelector('[name=why]').value = 'a test'; document.querySelector('[value=do]').click()"
        )
        page.until("document.querySelector('#badges').textContent.includes('held')")
        page.until("document.querySelector('#events').textContent.includes('a test')")
        page.key("Escape")
        page.until("!document.querySelector('#fleet').hidden")
        page.call("Emulation.setDeviceMetricsOverride", width=390, height=844, deviceScaleFactor=2, mobile=True)
        page.until("document.documentElement.scrollWidth <= 390")  # nothing is cut off on a phone
        assert page.console == []
        logs = stopped(process)
        assert any(one["message"] == "alarm" and one["unit"] == "pump 3" for one in logs)
        page.until("document.querySelector('#link').textContent === 'reconnecting'")
        process = started(port)
        page.until("document.querySelector('#link').textContent === 'live'", 60)
        page.until("document.querySelectorAll('#units tbody tr').length === 6", 60)
    finally:
        page.close()
        if process.poll() is None:
            os.kill(process.pid, signal.SIGTERM)
            process.wait(60)
        process.stderr.close()


def test_the_docs_lead_to_an_alarm_on_a_phone(tmp_path):
    """The file and the program of the page, word for word but for the addresses, and quicker."""
    pytest.importorskip("uvicorn", reason="the page needs driftfit[serve]")
    chapter = (Path(__file__).parent.parent / "docs" / "service.md").read_text()
    chapter = chapter[chapter.index("## An alarm on a phone") : chapter.index("## Your own plant")]
    (settings,), (program,) = (re.findall(f"```{kind}\n(.*?)```", chapter, re.S) for kind in ("toml", "py"))
    file, sent = tmp_path / "pump.toml", []
    with receiver() as here:
        file.write_text(settings.replace("https://ntfy.sh/choose-a-long-name", here))
        with serving(str(file), "--folder", str(tmp_path / "data")) as port:
            address = f"http://127.0.0.1:{port}"

            def wait(seconds):
                """Until the limits of the alarms are known, after the ten minutes of the reference."""
                if len(sent) == 10:
                    until(lambda: b"calibrated" in urllib.request.urlopen(f"{address}/api/events").read(), 60.0)

            random.seed(1)
            text = program.replace("http://127.0.0.1:8765", address).replace("time.sleep", "wait")
            exec(text, {"wait": wait, "print": sent.append})
            until(lambda: Receiver.got)
    assert any(
        who == "pump 1" and text.startswith("pump 1: band alarm, cause b1[pressure], ") for _, text, who in Receiver.got
    )
