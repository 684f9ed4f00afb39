"""The configuration of the service, and what comes from outside: every wrong thing is named or counted."""

import contextlib
import json
import re
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("msgspec", reason="the service needs driftfit[serve]")

import click
from service_support import HTTP, UNIT, configured, field, metric
from typer.main import get_command
from typer.testing import CliRunner

from driftfit import ARX, AdaptiveKalman, Bank, Change, Kalman, Sensor
from driftfit.cli import app
from driftfit.parsing.settings import parse_model, tracker_of
from driftfit.service.config import ProblemsError, parse, read
from driftfit.service.connect.base import decode, number, seconds
from driftfit.service.connect.http import decoded
from driftfit.service.connect.mqtt import REBIRTH, Sparkplug, UnknownAliasError, rebirth_topic
from driftfit.service.options import Pattern, Secret


def test_the_example_of_the_issue():
    text = """
    [source.plant]
    kind = "mqtt"
    url = "mqtts://broker:8883"
    topic = "plant/+/sensors"
    [[unit]]
    match = "plant/{pump}/sensors"
    y = "flow"
    u = ["pressure", "current"]
    time = "ts"
    dt = "1s"
    model = "ARX(2, [2, 2], intercept=True)"
    tracker = "AdaptiveKalman()"
    limits = { flow = [0, 80] }
    alarm = { every = "1 week", on = ["band", "glr"] }
    [[sink]]
    kind = "mqtt"
    url = "mqtts://broker:8883"
    topic = "driftfit/{pump}"
    """
    pytest.importorskip("paho.mqtt", reason="mqtt needs paho-mqtt")
    config = parse(text)
    (unit,) = config.units
    assert unit.model == ARX(2, [2, 2], intercept=True, inputs=["pressure", "current"])
    assert unit.tracker == AdaptiveKalman()
    assert unit.alarm.every == 7 * 86400.0
    assert unit.match.unit("plant/7/sensors") == "7"
    assert [type(one).__name__ for one in (*config.sources, *config.sinks)] == ["MqttSource", "MqttSink"]


def test_every_problem_has_its_line_and_a_way_out():
    text = """[source.x]
kind = "mqqt"
[[unit]]
match = "plant/{pump"
y = "flow"
[[unit]]
match = "a"
y = "flow"
modle = "ARX(1, 1)"
[[unit]]
match = "a"
y = "flow"
u = ["p"]
model = "ARX(1, 1)"
tracker = "Kalman(q=__import__('os').getpid(), r=1)"
[[unit]]
match = "a"
y = "flow"
model = "ARX(1, 0)"
tracker = "Kalman(q=-1, r=1)"
[page]
host = "0.0.0.0"
[sinks]
"""
    with pytest.raises(ProblemsError) as caught:
        parse(text, "plant.toml")
    found = dict(one.removeprefix("plant.toml:").split(": ", 1) for one in caught.value.messages)
    assert list(found) == ["23", "21", "2", "4", "9", "15", "20"]
    assert "did you mean mqtt" in found["2"]
    assert "did you mean model" in found["9"]
    assert "never evaluated" in found["15"] or "cannot be called" in found["15"]
    assert "driftfit serve --hash" in found["21"]
    with pytest.raises(ProblemsError, match="line 1"):
        parse('kind = "a"; url = "b"')


def test_check_on_the_command_line(tmp_path):
    path = tmp_path / "plant.toml"
    path.write_text(HTTP + UNIT)
    done = CliRunner().invoke(app, ["serve", "--check", str(path)])
    assert done.exit_code == 0
    assert "valid: 1 sources" in done.output
    path.write_text(HTTP + UNIT.replace("Kalman", "Kallman"))
    done = CliRunner().invoke(app, ["serve", "--check", str(path)])
    assert done.exit_code == 2
    assert f"{path}:11: tracker: there is no 'Kallman'; did you mean Kalman" in " ".join(done.output.split())


def test_expressions():
    bank = "Bank(changes=[Change(q=0, prob=.99), Change(q=.5, prob=.01)], sensors=[Sensor.nominal(r=.1)])"
    made = Bank(changes=[Change(q=0, prob=0.99), Change(q=0.5, prob=0.01)], sensors=[Sensor.nominal(r=0.1)])
    assert tracker_of(bank) == made
    assert tracker_of("kalman:q=1e-4;r=0.1") == Kalman(q=1e-4, r=0.1)


@pytest.mark.parametrize(
    "text",
    ["ARX", "ARX(2", "ARX(2, 2).bind(1)", "open('/etc/passwd')", "ARX(*[1, 2])", "ARX(**{'na': 1})",
     "(" * 500 + ")" * 500, "ARX(" * 90 + ")" * 90, "Kalman(q=1, r=1)", "ARX([x for x in (1, 2)])",
     "ARX(1 if 1 else 2)", "ARX(9**9**9)", "a" * 3000, "(lambda: 0)()", "ARX.__init__()", "ARX(f'{1}')",
     "Settings()", "Live()", "track()", ""],
)  # fmt: skip
def test_nothing_is_evaluated(text):
    with pytest.raises(ValueError):
        parse_model(text)


@pytest.mark.parametrize(
    "text",
    ['Bank(sensors=[Sensor(kind="own", likelihood="trap:density")])',
     'Bank(sensors=[Sensor("own", None, .1, 1.0, 0.0, None, None, 4.0, None, "trap:density")])',
     'HammersteinWiener(1, 1, input=Functions("trap:f", "trap:f"))'],
)  # fmt: skip
def test_no_configuration_imports_a_module(text, tmp_path, monkeypatch):
    (tmp_path / "trap.py").write_text("raise SystemExit('code of a configuration was run')")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ValueError, match=r"must be (a function|functions)"):
        (tracker_of if text.startswith("Bank") else parse_model)(text)


def test_patterns():
    assert Pattern("plant/{a}/x/{b}").unit("plant/1/x/2") == "1/2"
    assert Pattern("plant/{a}/x", "pump {a}").unit("plant/1/x") == "pump 1"
    assert Pattern("file.csv").unit("file.csv") == "file.csv"
    assert Pattern("a.c").unit("abc") is None
    for wrong in ("", "a/{a}/{a}", "a/{}", "a/{b", "x" * 300):
        with pytest.raises(ValueError):
            Pattern(wrong)
    with pytest.raises(ValueError, match="no part"):
        Pattern("a/{b}", "{c}")


def test_payloads():
    assert decode("a", b'{"t": 1, "y": 2.5}').length == 1
    assert decode("a", b'{"t": [1, 2], "y": [2.5, null], "site": "x"}').length == 2
    assert decode("a", b'[{"y": 1}, {"u": 2}]').columns == {"y": [1, None], "u": [None, 2]}
    assert np.isnan(decode("a", b'{"y": NaN}').columns["y"])
    (one, other), refused, _ = decoded("", b'{"a": {"y": [NaN, 1.5]}, "b": {"y": 2}}')
    assert (other.columns, refused) == ({"y": 2}, [])
    assert np.isnan(one.columns["y"][0])
    assert [number(one) for one in (1, 1.5, "2.5", True)] == [1.0, 1.5, 2.5, 1.0]
    assert all(np.isnan(number(one)) for one in (None, "x", [1], 10**400))
    assert seconds("2026-01-31T12:00:00Z", 1.0) == seconds("2026-01-31T13:00:00+01:00", 1.0) == 1769860800.0
    assert seconds(1769860800000, 1e-3) == 1769860800.0


ODD = list(b'0123456789.,:[]{}"-eEtyu nulNa\\\x00\xff')


def fuzzed(count, seed):
    """Payloads that are nearly right, or not at all."""
    rng = np.random.default_rng(seed)
    good = json.dumps({"t": [1.0, 2.0], "y": [0.5, None], "u": [1, "3"]}).encode()
    odd = [b"", b"{}", b"[]", b"null", b"[[1]]", b'{"y": [1], "t": [1, 2]}', b'{"y": {"a": 1}}', b"[" * 100_000]
    odd += [b'{"a":' * 5000, b'{"y": 1e999}', b'{"y": NaN, "t": -Infinity}', b'{"\\ud800": 1}', b"\xff\xfe"]
    odd += [b'{"y": ' + b"9" * 5000 + b"}"]
    yield from odd
    for _ in range(count - len(odd)):
        text = bytearray(good if rng.uniform() < 0.7 else rng.bytes(int(rng.integers(1, 80))))
        for _ in range(int(rng.integers(1, 5))):
            text[int(rng.integers(len(text)))] = int(rng.choice(ODD))
        yield bytes(text)


def test_fuzzed_messages():
    refused = 0
    for payload in fuzzed(3000, 1):
        try:
            assert decode("plant/a", payload).length >= 1
        except ValueError:
            refused += 1
        decoded("", payload)
    assert 1000 < refused < 2950


def test_secrets_are_never_shown(tmp_path, monkeypatch):
    pytest.importorskip("paho.mqtt", reason="mqtt needs paho-mqtt")
    monkeypatch.setenv("BROKER", "topsecret")
    (tmp_path / "secret").write_text("filesecret\n")
    source = '[source.x]\nkind = "mqtt"\nurl = "mqtt://a"\ntopic = "plant/+"\nuser = "me"\npassword = '
    one = configured(source=source + '{ env = "BROKER" }').sources[0]
    two = configured(source=source + f'{{ file = "{tmp_path}/secret" }}').sources[0]
    assert (one.password.value, two.password.value) == ("topsecret", "filesecret")
    assert "secret" not in f"{one!r} {two!r} {one.password}".replace("Secret", "")
    for wrong in ('"topsecret"', '{ env = "ABSENT" }'):
        with pytest.raises(ProblemsError) as caught:
            configured(source=source + wrong)
        assert "topsecret" not in str(caught.value)
    assert isinstance(one.password, Secret)


def test_sparkplug():
    """The payloads of the specification; a birth, data by aliases and by exception, history, restarts."""
    pytest.importorskip("google.protobuf", reason="sparkplug needs protobuf")
    reader, topic = Sparkplug(), "spBv1.0/plant/{}/edge 1/pump 7"
    born = field(1, 1000) + metric(31.5, "flow", 1) + metric(4.25, "pressure", 2) + metric(2**64 - 5, "t", 3, kind=3)
    found = reader.decode(topic.format("DBIRTH"), born + field(3, 0))
    assert found == (
        "spBv1.0/plant/edge 1/pump 7", 1,
        {"flow": [31.5], "pressure": [4.25], "t": [-5], "timestamp": [1000]},
    )  # fmt: skip
    changed = reader.decode(topic.format("DDATA"), field(1, 2000) + metric(32.0, alias=1))
    assert changed.columns == {"flow": [32.0], "pressure": [4.25], "t": [-5], "timestamp": [2000]}
    more = metric(33.0, alias=1, when=2500) + metric(5.0, alias=2, when=2600) + metric(0.0, alias=3, when=2600, null=1)
    two = reader.decode(topic.format("DDATA"), field(1, 3000) + more)
    assert two.columns == {
        "flow": [33.0, 33.0], "pressure": [4.25, 5.0], "t": [-5, None], "timestamp": [2500, 2600]}  # fmt: skip
    reader.decode(topic.format("DDATA"), field(1, 3000) + metric(9.0, alias=1, when=10, historical=1))
    assert reader.decode(topic.format("DDATA"), field(1, 4000) + metric(5.5, alias=2)).columns["flow"] == [33.0]
    assert reader.decode(topic.format("DDATA"), field(1, 5000) + metric(True, "on") + metric("x", "text")).columns["on"]
    assert reader.decode("spBv1.0/plant/NDEATH/edge 1", field(1, 1)) is None
    assert reader.decode("spBv1.0/STATE/host", b"{}") is None
    with pytest.raises(UnknownAliasError, match="alias 1 was declared by no birth of plant/edge 1"):
        Sparkplug().decode(topic.format("DDATA"), field(1, 2000) + metric(32.0, alias=1))
    assert metric(True, "Node Control/Rebirth", kind=11) == REBIRTH
    assert rebirth_topic(topic.format("DDATA")) == "spBv1.0/plant/NCMD/edge 1"
    rng = np.random.default_rng(0)
    for _ in range(3000):
        data = bytearray(born)
        for place in rng.integers(0, len(data), 3):
            data[place] = rng.integers(256)
        with contextlib.suppress(ValueError):
            reader.decode(topic.format("DBIRTH"), bytes(data[: rng.integers(len(data))]))


def test_the_files_of_the_docs_fit_the_service(monkeypatch):
    """What systemd and the image run, and what the containers mount, is there and is accepted."""
    pytest.importorskip("psycopg", reason="there is no psycopg")
    folder = Path(__file__).parent.parent / "docs" / "service"
    monkeypatch.setenv("POSTGRES_PASSWORD", "x")
    config = read(folder / "plant.toml")
    assert [type(one).__name__ for one in config.sinks] == ["WebhookSink", "PostgresSink"]
    assert {type(one).__name__ for one in config.sources} == {"MqttSource", "HttpSource"}
    (start,) = re.findall(
        r"^ExecStart=/opt/driftfit/bin/driftfit (.*)$", (folder / "driftfit.service").read_text(), re.M
    )
    image = (folder / "Containerfile").read_text()
    (warm,) = re.findall(r"^RUN driftfit (.*)$", image, re.M)
    run = [*json.loads(re.findall(r"^ENTRYPOINT (.*)$", image, re.M)[0])[1:],
           *json.loads(re.findall(r"^CMD (.*)$", image, re.M)[0])]  # fmt: skip
    for words in (start.split(), warm.split(), run):
        command = get_command(app).commands[words[0]]
        command.parse_args(click.Context(command), words[1:])
    compose = (folder / "compose.yaml").read_text()
    for mounted in re.findall(r"- (\./[^:]+):", compose) + re.findall(r'"(\./[^:]+):', compose):
        assert (folder / mounted).exists(), mounted
    assert set(re.findall(r"\$\{(\w+)", compose)) == {"POSTGRES_PASSWORD", "GRAFANA_PASSWORD"}
    assert (folder.parent.parent / re.findall(r"dockerfile: (\S+) ", compose)[0]).exists()
    (source,) = set(re.findall(r"uid: (\w+)", (folder / "grafana" / "datasource.yaml").read_text()))
    panels = json.loads((folder / "grafana" / "dashboard.json").read_text())["panels"]
    assert {one["datasource"]["uid"] for one in panels} == {source}
