"""What a bank refuses, and how it says so."""

import json
import re

import numpy as np
import pytest

from driftfit import RLS, Bank, Live, Regression, track
from driftfit.bank.change import Change
from driftfit.bank.reduction import GPB, IMM, Beam, Decide, FirstFloor, Hybrid
from driftfit.bank.sensor import Sensor
from driftfit.engine.tiles import as_compiled, tile_type
from driftfit.run.program import Program

TWO = [Change(0.0), Change(0.5, prob=0.01)]
KNOWN = [Sensor.nominal(0.1)]
P = [[0.99, 0.01], [0.2, 0.8]]


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: Bank([Change(0.0, prob=0.9), Change(0.5, prob=0.2)]), ["sum to 1", "0.9, 0.2"]),
        (lambda: Bank([Change(0.0), Change(0.5), Change(9.0, prob=0.1)]), ["only one", "leave prob= open"]),
        (lambda: Bank([]), ["at least one", "()"]),
        (lambda: Bank(TWO, []), ["at least one"]),
        (lambda: Bank([0.5]), ["each a Change"]),
        (lambda: Bank(TWO, [Sensor.outlier()]), ["first sensor", "nominal"]),
        (lambda: Bank(TWO, transition=np.eye(3)), ["(3, 3)", "(2, 2)"]),
        (lambda: Bank(TWO, transition=np.array(P).T), ["P[to, from]", "transpose"]),
        (lambda: Bank(TWO, transition=[[0.5, 0.6], [0.5, 0.5]]), ["rows", "sum to 1"]),
        (lambda: Bank(TWO, transition=[[0.0, 0.0], [0.5, 0.5]]), ["rows", "sum to 1"]),
        (lambda: Bank(TWO, transition=[[1.5, -0.5], [0.5, 0.5]]), ["within [0, 1]"]),
        (lambda: Bank(TWO, initial=[0.5, 0.6]), ["initial", "sum to 1"]),
        (lambda: Bank(TWO, reduce=Decide(13)), ["8192", "4096", "Beam(9)"]),
        (lambda: Bank(TWO, reduce=GPB(13)), ["8192", "IMM()"]),
        (lambda: Bank(TWO, reduce=Beam(3000)), ["6000"]),
        (lambda: Bank(TWO, [*KNOWN, Sensor.outlier()], reduce=Decide(1)), ["Decide(1)", "never adapts", "force"]),
        (lambda: Bank(TWO, [*KNOWN, Sensor.outlier()], reduce=FirstFloor(2)), ["one sensor"]),
        (lambda: Bank(TWO, reduce=Decide(2, loss=np.ones((3, 3)))), ["(2, 2)", "(3, 3)"]),
        (lambda: Bank(TWO, reduce="beam"), ["reduction", "'beam'"]),
        (lambda: Decide(0), ["depth", "at least 1"]),
        (lambda: Decide(2, loss="mse"), ["'map'"]),
        (lambda: Change([[1.0, 2.0], [2.0, 1.0]]), ["positive semi-definite"]),
        (lambda: Change([[1.0, 0.5], [0.0, 1.0]]), ["symmetric"]),
        (lambda: Change(1.0, size=2.0), ["q or size"]),
        (lambda: Change(1.0, prob=1.5), ["[0, 1]", "1.5"]),
        (lambda: Change(1.0, which=[0, 0]), ["different indices"]),
        (lambda: Change(forget=1.2), ["forget", "1.2"]),
        (lambda: Change(reset=True), ["q="]),
        (lambda: Sensor.nominal(0.0), ["r must be", "above 0"]),
        (lambda: Sensor.frozen(0.0), ["resolution must be positive"]),
        (lambda: Sensor.outlier(kind="spike"), ["'innovation', 'additive'"]),
        (lambda: Live(Regression(2), Bank([Change(0.1, which=[2])])), ["parameter 2", "0 .. 1"]),
        (lambda: Live(Regression(2), Bank([Change([0.1, 0.2, 0.3])])), ["(3,)", "2 parameters"]),
    ],
)  # fmt: skip
def test_wrong_settings_are_named(build, message):
    with pytest.raises(ValueError) as error:
        build()
    for word in message:
        assert word in str(error.value), error.value


def test_a_frozen_sensor_wants_to_persist():
    with pytest.warns(UserWarning, match="transition="):
        Bank(TWO, [*KNOWN, Sensor.frozen(0.01)])


def test_priors_per_sample_are_checked():
    y, u = np.ones(3), np.ones((3, 1))
    bank = Bank(TWO, KNOWN, p0=1.0)
    for prob, message in (
        ([[0.5, 0.6]] * 3, "at sample 0"),
        (np.ones((3, 5)) / 5.0, "2 columns"),
        ([[0.9, 0.1], [1.2, -0.2], [1.0, 0.0]], "at sample 1"),
    ):
        with pytest.raises(ValueError, match=re.escape(message)):
            track(Regression(1), bank, y, u, prob=prob)
    with pytest.raises(ValueError, match="are for a Bank"):
        track(Regression(1), RLS(0.9), y, u, prob=[[0.5, 0.5]] * 3)


@pytest.mark.parametrize(
    "bank",
    [
        Bank(), Bank(TWO, KNOWN, P, GPB(2)), Bank(TWO, [Sensor.nominal(guess=0.2), Sensor.outlier(5.0, "additive")]),
        Bank([Change(0.0), Change(1.0, prob=0.1, which=[1], name="gain")], KNOWN, reduce=Decide("auto")),
        Bank(TWO, [*KNOWN, Sensor.frozen(0.1)], (None, P), Hybrid(5)), Bank(TWO, reduce=IMM(), initial=[0.5, 0.5]),
        Bank(TWO, reduce=Decide(2, loss=[[0.0, 5.0], [1.0, 0.0]])), Bank(TWO, reduce=FirstFloor(2, "prior")),
    ],
)  # fmt: skip
def test_settings_survive_being_written_down(bank):
    again = Bank.from_settings(json.loads(json.dumps(bank.settings())))
    assert again == bank
    assert hash(again) == hash(bank)


def test_events_have_names():
    bank = Bank(TWO, [*KNOWN, Sensor.outlier()])
    assert bank.event_names == ("none, nominal", "none, outlier", "change 1, nominal", "change 1, outlier")


def test_banks_of_all_shapes_have_one_driver():
    """Compiling it takes seconds; what differs lies behind what the compiler knows."""
    three = [*TWO, Change(0.1, prob=0.01)]
    banks = [Bank(TWO, KNOWN, reduce=Beam(3)), Bank(three, [*KNOWN, Sensor.outlier()], reduce=Beam(100))]
    tiles = [Program(Regression(2).bind(2), bank).tile() for bank in banks]
    assert tiles[0]["memory"].shape != tiles[1]["memory"].shape
    assert tiles[0]["report"].shape != tiles[1]["report"].shape
    assert tile_type(tiles[0]) == tile_type(tiles[1])
    for tile in tiles:
        memory, table = as_compiled(tile)["report"].ctypes.data + 8 * tile["report"].size, tile["table"]
        assert memory == tile["memory"].ctypes.data
        assert memory % 64 == 0
        assert {tile["memory"].size, tile["report"].size} <= set(table[0, :, 2, 0].tolist())
