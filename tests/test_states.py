"""States as bytes: small, checked, the same everywhere, refused where they do not belong; runs that continue them."""

from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support import arx_record, damaged, same

from driftfit import ARX, Kalman, Live, track
from driftfit.data import late
from driftfit.data.late import LATE, RELEASED, REPEATED, UNTIMED, WAITING, HoldBack, sort_out
from driftfit.data.record import Known, Records
from driftfit.run.layout import SPARSE_WORDS, packed, unpacked
from driftfit.run.parallel_lanes import advance
from driftfit.run.program import Program
from driftfit.run.warm_start import End

GOLDEN = Path(__file__).parent / "golden" / "kalman_arx22.state"
"""`golden` as written on x86-64 by Python 3.11."""
OLDER = GOLDEN.with_name("kalman_arx22_older.state")
"""The same, in an older format."""

K = Kalman(q=1e-3, r=0.1)
Y, U = damaged(*arx_record(120, 5))


def golden():
    """A stream whose numbers are exact in floating point, so that they are the same on every machine."""
    live = Live(ARX(2, 2), Kalman(q=0.25, r=0.5, p0=1.0), dt=2.0)
    for t in range(4):
        live.update((-1.0) ** t, float(t % 2), time=2.0 * t)
    return live


def test_bytes_written_elsewhere_are_read_and_written_again():
    data = GOLDEN.read_bytes()
    live = Live.from_bytes(data)
    assert (live.model, live.tracker, live.dt) == (ARX(2, 2).bind(1), Kalman(q=0.25, r=0.5, p0=1.0), 2.0)
    assert live.to_bytes() == data
    np.testing.assert_allclose(live.theta, golden().theta, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(live.update(1.0, 1.0, time=8.0), golden().update(1.0, 1.0, time=8.0), rtol=1e-12)


def test_states_of_older_formats_are_refused_with_the_remedy():
    """Trackers judged readings by rules of their own: what their states had learned is not what they know now."""
    with pytest.raises(ValueError, match=r"older driftfit \(format 2\).*run the record again"):
        Live.from_bytes(OLDER.read_bytes())
    program = Program(ARX(2, 2).bind(1), K)
    old = bytearray(program.pack(program.tile()))
    old[4] = 1
    with pytest.raises(ValueError, match=r"older driftfit \(format 1\).*run the record again"):
        program.unpack(bytes(old))


def test_a_state_is_its_numbers_and_a_thousand_bytes():
    live = Live(ARX(2, 2), K)
    for t in range(60):
        live.update(Y[t], U[t])
    numbers = 8 * live.program.layout.size
    assert numbers < 0.85 * live._tile.nbytes
    assert len(live.program.pack(live._tile)) == numbers + 24
    assert len(live.to_bytes()) < numbers + 1100  # model, tracker, names of fields


@pytest.mark.parametrize("stop", [1, 3, 50])
def test_a_packed_state_continues_in_another_tile(stop):
    program = Program(ARX(2, 2).bind(1), K)
    whole = track(program.model, K, Y, U)
    first = track(program.model, K, Y[:stop], U[:stop])
    data = first.program.pack(first._lane.tile)
    rest = track(program.model, K, Y[stop:], U[stop:], warm_start=End.from_bytes(first.end().to_bytes()))
    assert same(rest.theta, whole.theta[stop:])
    live = Live.from_bytes(first.end().to_bytes())
    assert same([live.update(*row)[0] for row in zip(Y[stop:], U[stop:], strict=True)], whole.prediction[stop:])
    tile = first.program.tile()
    assert first.program.pack(first.program.unpack(data, tile)) == data
    assert same(tile["theta"], first._lane.tile["theta"])


def test_a_track_continues_from_the_bytes_of_a_stream_and_the_other_way_round():
    live = Live(ARX(2, 2), K, dt="1min")
    start = np.datetime64("2024-01-01", "us")
    time = start + np.arange(120) * np.timedelta64(60, "s")
    for t in range(50):
        live.update(Y[t], U[t], time=time[t])
    rest = track(ARX(2, 2), K, Y[50:], U[50:], time=time[50:], dt="1min", warm_start=live.to_bytes())
    whole = track(ARX(2, 2), K, Y, U, time=time, dt="1min")
    assert same(rest.theta, whole.theta[50:])
    again = Live.from_bytes(whole.end().to_bytes())
    assert not again.update(0.0, 0.0, time=time[-1])[3]
    assert again.ignored == 1


def test_foreign_and_damaged_states_are_refused():
    program = Program(ARX(2, 2).bind(1), K)
    data = program.pack(program.tile())
    for other in (
        Program(program.model, replace(K, q=1e-2)),
        Program(ARX(1, 1).bind(1), K),
        Program(program.model, replace(K, form="sqrt")),
    ):
        with pytest.raises(ValueError, match=r"another model, tracker, gate, setting or version.*warm_start="):
            other.unpack(data)
    for place in range(0, len(data), 7):
        flipped = bytearray(data)
        flipped[place] ^= 1
        with pytest.raises(ValueError, match=r"not a packed state|damaged|newer driftfit"):
            program.unpack(bytes(flipped))
    for wrong in (b"", b"hello", data[:-1], data + b"0", data[:20]):
        with pytest.raises(ValueError, match=r"not a packed state|damaged"):
            program.unpack(wrong)


def test_many_words_leave_out_those_that_are_zero():
    words = np.zeros(SPARSE_WORDS + 3, np.int64)
    words[[0, 8, SPARSE_WORDS + 2]] = -1, 5, 2**62
    data = packed(bytes(8), words)
    assert len(data) == 24 + -(-len(words) // 8) + 3 * 8
    assert same(unpacked(data)[1], words)
    full = np.arange(1, SPARSE_WORDS + 4)
    assert len(packed(bytes(8), full)) == 24 + full.nbytes
    assert same(unpacked(packed(bytes(8), full))[1], full)


def rows_in_batches(rng, T=400, hold=7.0):
    """(times, values, arrivals): rows that arrive out of order by less than ``hold``, some of them twice."""
    time = np.cumsum(rng.uniform(0.5, 1.5, T))
    arrival = time + rng.uniform(0.0, 0.9 * hold, T) * (rng.random(T) < 0.3)
    twice = rng.random(T) < 0.1
    which = np.concatenate([np.arange(T), np.flatnonzero(twice)])
    arrival = np.concatenate([arrival, arrival[twice] + 0.5])
    return time, which[np.argsort(arrival, kind="stable")]


def test_rows_that_wait_come_out_as_the_sorted_record():
    """Two series that arrive in turn, each in parts."""
    rng = np.random.default_rng(3)
    given = [rows_in_batches(rng) for _ in range(2)]
    waiting, newest, out = HoldBack(7.0, 1), np.full(2, np.nan), [[], []]
    refused = 0
    parts = [np.split(arriving, np.sort(rng.choice(len(arriving), 40))) for _, arriving in given]
    for some in zip(*parts, strict=True):
        series = np.repeat([0, 1], [len(part) for part in some])
        time, which = (np.concatenate(one) for one in ([given[k][0][some[k]] for k in range(2)], some))
        taken, fate = waiting.judge(series, time, newest)
        refused += int((fate != RELEASED).sum() - (fate == WAITING).sum())
        if rng.random() < 0.5:  # what is refused may be left out before, or not
            series, time, which = series[taken], time[taken], which[taken]
        series, time, rows = waiting.take(series, time, which[:, None].astype(float), newest)
        assert len(waiting) < 60
        for k in range(2):
            out[k] += rows[series == k, 0].tolist()
            assert same(given[k][0][rows[series == k, 0].astype(int)], time[series == k])
    for k, (time, _) in enumerate(given):
        assert [*out[k], *waiting.of(k)[1][:, 0]] == list(range(len(time)))
    assert refused == sum(len(arriving) - len(time) for time, arriving in given) > 40


def test_fates_of_dates_are_those_of_numbers():
    rng = np.random.default_rng(4)
    series, time, waited = rng.integers(0, 3, 60), rng.integers(0, 30, 60).astype(float), rng.random(60) < 0.2
    time[::17] = np.nan
    newest = np.array([12.0, np.nan, 5.0])
    dated = [np.datetime64("2024-01-01", "us") + (one * 1e6).astype("m8[us]") for one in (time, newest)]
    plain = sort_out(series, time, waited & np.isfinite(time), newest, 4.0)
    found = sort_out(series, dated[0], waited & np.isfinite(time), dated[1], np.timedelta64(4, "s"))
    assert same(found.order, plain.order)
    assert same(found.fate, plain.fate)
    assert set(plain.fate.tolist()) == set(range(5))


def test_rows_in_order_have_the_same_fates_with_and_without_sorting(monkeypatch):
    rng, quick, counted = np.random.default_rng(4), late.all_in_order, Counter()
    for _ in range(300):
        series, time = np.sort(rng.integers(0, 3, 6)), np.cumsum(rng.integers(0, 3, 6)) * 1.0
        time[rng.uniform(size=6) < 0.03] = rng.choice([np.nan, np.inf])
        newest = rng.choice([np.nan, 0.0, 2.0], 3)
        given = series, time, np.zeros(6, bool), newest, 0.0
        monkeypatch.setattr(late, "all_in_order", quick)
        counted[quick(series, time, newest) is not None] += 1
        found = sort_out(*given)
        monkeypatch.setattr(late, "all_in_order", lambda *_: None)
        assert all(map(same, found, sort_out(*given)))
    assert min(counted[True], counted[False]) > 20


def test_rows_that_are_too_late_are_counted():
    def given(waiting, times, names, newest=None):
        newest = np.full(1, np.nan) if newest is None else newest
        series, rows = np.zeros(len(times), int), np.array([[ord(name)] for name in names], float)
        _, fate = waiting.judge(series, np.array(times), newest)
        return [chr(int(row[0])) for row in waiting.take(series, np.array(times), rows, newest)[2]], fate.tolist()

    waiting, newest = HoldBack(2.0, 1), np.full(1, np.nan)
    assert given(waiting, [5.0, 1.0, np.nan, 1.0], "abcd", newest) == (["b"], [WAITING, RELEASED, UNTIMED, REPEATED])
    assert given(waiting, [3.0, 5.0, 4.0], "efg", newest) == ([], [LATE, REPEATED, WAITING])
    assert given(waiting, [9.0], "h", newest) == (["g", "a"], [WAITING])
    assert waiting.of(0)[0].tolist() == [9.0]
    with pytest.raises(ValueError, match="must not be negative"):
        HoldBack(-1.0, 1)
    at_once = HoldBack(0.0, 1)
    assert given(at_once, [1.0, 2.0], "ab", newest := np.full(1, np.nan))[0] == ["a", "b"]
    assert given(at_once, [2.0, 1.5, 3.0], "cde", newest) == (["e"], [REPEATED, LATE, RELEASED])


@pytest.mark.parametrize("count", [3, 40])
def test_series_continue_in_lanes_from_their_states(count):
    """Cut at different places, of different lengths, some of them new: as if each had been run alone."""
    rng = np.random.default_rng(count)
    model = ARX(2, 2).bind(1)
    programs = [Program(model, replace(K, r=float(r))) for r in rng.uniform(0.1, 1.0, count)]
    records = [damaged(*arx_record(int(T), k)) for k, T in enumerate(rng.integers(20, 60, count))]
    cuts = [int(rng.integers(0, len(y))) for y, _ in records]
    states, first, rest = {}, [], []
    for part in (slice(0, 1), slice(1, 2)):
        found = [(y[:cut], u[:cut]) if part.start == 0 else (y[cut:], u[cut:])
                 for cut, (y, u) in zip(cuts, records, strict=True)]  # fmt: skip
        some = [k for k in range(count) if len(found[k][0])]
        length = np.array([len(found[k][0]) for k in some])
        y, u = (np.concatenate([found[k][j] for k in some]) for j in range(2))
        whole = Records(tuple(some), np.cumsum(length) - length, length, y, u[:, None], Known.of())
        begun = np.array([k in states for k in some])
        words = np.stack([states.get(k, np.zeros(programs[k].layout.size, np.int64)) for k in some])
        got = advance([programs[k] for k in some], whole, words, begun, 1)
        after = got.states()
        states |= {k: programs[k].layout.unpack(programs[k].layout.pack(after[j])) for j, k in enumerate(some)}
        theta, e = got.column("theta"), got.column("e")
        assert theta.shape == (len(y), 4)
        ends = np.cumsum(length)
        into = rest if part.start else first
        into.append({k: (theta[b - T : b], e[b - T : b]) for k, b, T in zip(some, ends, length, strict=True)})
    for k, (y, u) in enumerate(records):
        run = track(model, programs[k].tracker, y, u)
        parts = [some[k] for some in (*first, *rest) if k in some]
        assert same(np.concatenate([part[0] for part in parts]), run.theta)
        assert same(np.concatenate([part[1] for part in parts]), run.innovation)
        assert programs[k].layout.pack(states[k]) == run.program.pack(run._lane.tile)
