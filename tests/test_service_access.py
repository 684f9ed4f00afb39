"""Who may do what: senders, and sessions that end; each test was an attack that succeeded."""

import asyncio
import json

import pytest

pytest.importorskip("starlette", reason="the page needs driftfit[serve]")
pytest.importorskip("msgspec", reason="the service needs driftfit[serve]")

from service_support import UNIT, configured, opened
from test_service_page import PASSWORD, client, service  # noqa: F401  (fixtures)

from driftfit.service.connect.http import INCOMING
from driftfit.service.control import Control
from driftfit.service.options import UserOptions
from driftfit.service.page.access import hashed, new_token
from driftfit.service.page.app import Sockets

GATEWAY = [line.split(": ")[1] for line in new_token()]
ANN = UserOptions("Ann", "operator", PASSWORD)
SENDER = UserOptions("gateway", "sender", token=GATEWAY[1], units=["a"])
BEARER = {"authorization": f"Bearer {GATEWAY[0]}"}
HOME = "http://localhost:8765"


def logged_in(ask):
    """Headers with the cookie of a session of Ann."""
    assert ask("POST", "/api/login", {"name": "Ann", "password": "a long password"})[0] == 200
    return {"cookie": ask.headers["set-cookie"].partition(";")[0]}


@pytest.mark.parametrize(
    ("method", "path"),
    [("GET", "/"), ("GET", "/api/units"), ("GET", "/api/status"), ("GET", "/metrics"), ("GET", "/api/export?unit=a"),
     ("POST", "/api/actions"), ("GET", "/api/samplesX")],
)  # fmt: skip
def test_a_sender_may_only_post_samples(client, method, path):  # noqa: F811
    ask = client(user=[ANN, SENDER])
    status, body = ask(method, path, {"unit": "a", "do": "hold", "on": True, "why": "an attack"}, **BEARER)
    assert (status, "may only post samples" in json.loads(body)["error"]) == (403, True)


def test_a_sender_posts_samples_of_its_units_alone(service, client):  # noqa: F811
    ask, sample = client(user=[SENDER]), {"t": 1e3, "y": 1.0, "u": 1.0}
    for topic, body in (("", {"plant/a": sample, "plant/c": sample}), ("/plant/c", sample)):
        status, answer = ask("POST", f"/api/samples{topic}", body, **BEARER)
        assert (status, "samples of c (plant/c)" in json.loads(answer)["error"]) == (403, True)
    assert INCOMING.queue.empty()  # also what the sender might have sent


def test_units_of_a_sender_are_named_in_every_section(tmp_path):
    engine = opened(configured(UNIT + UNIT.replace('y = "y"', 'y = "z"')), tmp_path)
    control = Control(engine, tmp_path / "c", dict)
    assert control._foreign(["p:y"])("plant/p") == ["p:z"]
    assert control._foreign(["p:y", "p:z"])("plant/p") == []
    assert control._foreign([])("plant/q") == []
    control.close()


def test_a_session_ends_at_its_logout(service, client):  # noqa: F811
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
def test_a_session_ends_when_the_password_is_changed(client, then):  # noqa: F811
    cookie = logged_in(client(user=[ANN]))
    assert client(user=[then])("GET", "/api/me", **cookie)[0] == 401


@pytest.mark.parametrize("content", [b"", b"{", b"[]", b'{"x": 1}', bytes(40)])
def test_a_damaged_file_of_sessions_lets_nobody_in(service, client, content):  # noqa: F811
    folder = service[2]
    cookie = logged_in(client(user=[ANN]))
    (folder / "sessions.json").write_bytes(content)
    ask = client(user=[ANN])
    assert ask("GET", "/api/me", **cookie)[0] == 401
    cookie = logged_in(ask)
    assert client(user=[ANN])("GET", "/api/me", **cookie)[0] == 200


def test_the_file_of_sessions_opens_none(service, client):  # noqa: F811
    cookie = logged_in(client(user=[ANN]))["cookie"].partition("=")[2]
    assert cookie not in (service[2] / "sessions.json").read_text()


@pytest.mark.parametrize("beside", ["Basic QW5uOng=", "Bearer ", f"Bearer {GATEWAY[0]}"], ids=["Basic", "empty", "key"])
def test_a_cookie_beside_any_authorization_needs_its_origin(client, beside):  # noqa: F811
    ask, act = client(user=[ANN, SENDER]), {"unit": "a", "do": "no", "why": "an attack"}
    status, body = ask("POST", "/api/actions", act, authorization=beside, **logged_in(ask))
    assert (status, "Origin" in json.loads(body)["error"]) == (403, True)


def test_an_open_page_is_closed_with_its_session(service):  # noqa: F811
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


def test_a_sender_needs_no_more_than_its_units():
    with pytest.raises(ValueError, match="units are those of a sender"):
        UserOptions("Ann", "operator", PASSWORD, units=["a"])
    with pytest.raises(ValueError, match="viewer, operator or sender"):
        UserOptions("Ann", "root", PASSWORD)
