"""Warm starts: a run that continues where another one ended.

Everything carries over: the parameters, their covariance, the lags of the model, and the time of the last sample, so
a record cut in two gives the same bits as the whole. A setting that differs between the two trackers takes its new
value, for example a larger q. `JointLayout` holds the states of all outputs of a series as one.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from typing import Any, NamedTuple, Protocol

import numpy as np

from driftfit.data import storage
from driftfit.data.clock import Clock
from driftfit.data.instants import instant
from driftfit.data.record import Labels
from driftfit.engine.kernel import Array
from driftfit.models.base import Model
from driftfit.readings.gate import Gate
from driftfit.run.lanes import by_output
from driftfit.run.layout import own_words, packed, unpacked
from driftfit.run.program import Program, State, programs_of, state_of, tile_of
from driftfit.trackers.base import Tracker

_LEFT = ("interval", "noise", "drift", "drift_root", "F")
"""Fields that are not carried over: an operator's settings of the stream, and the diffuse likelihood of that run."""


KINDS = ("state", "outputs")
"""Kinds of files that hold the state of one output, or of several."""


class End(NamedTuple):
    """Where a run ended, lane by lane (one for a single output): its programs, their states, and its last time.

    ``awaits`` says whether a stream still expects the input of that sample (`driftfit.run.live.stream`); ``dt`` and
    ``zone`` are those of its clock.
    """

    programs: tuple[Program, ...]
    states: tuple[State, ...]
    last: Any
    awaits: int = 0
    dt: Any = None
    zone: str | None = None

    def end(self) -> End:
        """The end itself, so that it can be used in place of a run."""
        return self

    def to_bytes(self) -> bytes:
        """The end as bytes for `Live.from_bytes` and ``warm_start=``: 1,000 to 1,500 bytes more than the state
        itself.
        """
        lanes = [one.pack(one.tile(state)) for one, state in zip(self.programs, self.states, strict=True)]
        extra = {"last": self.last, "awaits": self.awaits, "dt": self.dt, "zone": self.zone}
        return storage.compact(*written(self.programs, lanes, extra))

    @classmethod
    def from_bytes(cls, data: bytes, classes: Iterable[Any] = ()) -> End:
        """The end from bytes, or from those of a stream (``live.to_bytes()``); ValueError if they are damaged or of
        another kind. ``classes`` as for `Live.load`.
        """
        header, arrays = storage.expand(data, KINDS)
        with storage.reading("what was given"):
            model, trackers, extra = read("what was given", header, arrays, classes)
            programs = programs_of(model, by_output(model, trackers), model.m, gate_from(header) or False)
            tile = tile_of(programs)
            restore("what was given", programs, arrays, tile)
            states = tuple(state_of(tile, lane) for lane in range(len(programs)))
            return cls(programs, states, *(extra[name] for name in ("last", "awaits", "dt", "zone")))


ABSENT: Mapping[str, Any] = {
    "dt": None, "zone": None, "limits": None, "last": None, "samples": 0, "ignored": 0, "lag": 0, "awaits": 0,
    "cold": False, "windows": (), "alarms": (), "left_out": [],
}  # fmt: skip
"""Values that are not written for a stream, because they are the default."""


def written(
    programs: Sequence[Program], lanes: Sequence[bytes], extra: Mapping[str, Any]
) -> tuple[dict[str, Any], dict[str, Array]]:
    """Header and arrays of a file: the packed states of all lanes, and the other facts about the stream."""
    described = [storage.describe(one.tracker) for one in programs]
    model = programs[0].whole
    header: dict[str, Any] = {"kind": KINDS[len(model.outputs) > 1], "model": storage.describe(model)}
    header |= {"tracker": described[0] if len(described) == 1 else described}
    header |= {"gate": None if programs[0].gate is None else programs[0].gate.settings()}
    header |= {"extra": {name: value for name, value in extra.items() if value != ABSENT[name]}}
    return header, {f"state{lane}": np.frombuffer(data, np.uint8) for lane, data in enumerate(lanes)}


def read(
    source: str, header: Mapping[str, Any], arrays: Mapping[str, Array], classes: Iterable[Any]
) -> tuple[Model, tuple[Tracker, ...], dict[str, Any]]:
    """(the model, the tracker of each output, everything else) from a file that `written` made."""
    given = header["tracker"]
    described, classes = given if isinstance(given, list) else [given], tuple(classes)
    trackers = tuple(storage.rebuild(one, Tracker, classes) for one in described)
    model = storage.rebuild(header["model"], Model, classes)
    storage.check_size(source, model, trackers[0], len(unpacked(arrays["state0"].tobytes())[1]))
    return model, trackers, {**ABSENT, **header["extra"]}


def gate_from(header: Mapping[str, Any]) -> Gate | None:
    """The gate of a header; None for none."""
    given = header["gate"]
    return None if given is None else Gate.from_settings(given)


def restore(source: str, programs: Sequence[Program], arrays: Mapping[str, Array], tile: Array) -> None:
    """Set the lanes of a tile to the states of a file; ``source`` is named in errors.

    ValueError for states of other settings or versions.
    """
    for lane, program in enumerate(programs):
        try:
            program.unpack(arrays[f"state{lane}"].tobytes(), tile, lane)
        except ValueError as error:
            name = type(program.tracker).__name__
            raise ValueError(f"{source} does not fit {name} in this version: {error}") from None


class Run(Protocol):
    """Runs from which a warm start can begin: a `Track`, a `Live`, or one of several outputs."""

    def end(self) -> End:
        """The end of the run."""


def ended(run: Run | bytes, programs: Sequence[Program]) -> End:
    """The end of a run, or the end that the given bytes hold, which may need what the programs are made of."""
    if not isinstance(run, bytes):
        return run.end()
    return End.from_bytes(run, [part for one in programs for part in storage.parts_of((one.whole, one.tracker))])


def carried(run: Run | bytes | None, programs: Sequence[Program]) -> tuple[State, ...]:
    """The fields that each lane takes over from a run before; ValueError if the two do not fit."""
    if run is None:
        return ()
    end = ended(run, programs)
    if len(end.programs) != len(programs):
        raise ValueError(f"warm_start: {run!r} is not a run of these outputs.")
    return tuple(_carried(*lane) for lane in zip(end.programs, end.states, programs, strict=True))


def _carried(before: Program, state: State, now: Program) -> State:
    if type(now.tracker) is not type(before.tracker):
        raise ValueError(
            f"warm_start: the earlier run was made by {type(before.tracker).__name__}, this one is by "
            f"{type(now.tracker).__name__}; start from its estimates instead, with theta0= and p0=."
        )
    if now.gate != before.gate:
        raise ValueError(
            f"warm_start: the earlier run had gate={before.gate!r}, this one has gate={now.gate!r}, and a gate must "
            "know all readings from the first on; give the gate of the earlier run, or run its record again."
        )
    if not now.model.follows(before.model):
        raise ValueError(f"warm_start: the earlier run followed {before.model!r}, this one follows {now.model!r}.")
    old, new = before.tracker.state_for(before.model), now.tracker.state_for(now.model)
    changed = {name for name, value in new.items() if not _same(old.get(name), value)}
    return {name: value for name, value in state.items() if name not in changed and name not in _LEFT}


def _same(one: Any, other: Any) -> bool:
    return np.shape(one) == np.shape(other) and bool(np.all(np.equal(one, other) | (np.not_equal(one, one))))


def first_interval(run: Run, time: Any, labels: Labels) -> float:
    """Nominal intervals from the end of a run to the first sample of the next; 1 if either has no time."""
    last = run.end().last
    if last is None or time is None:
        return 1.0
    interval = Clock.of(labels.dt, labels.zone).since(instant(last), instant(time))
    if not interval >= 0.0:
        raise ValueError(f"warm_start: the record begins at {time}, not after the end of the earlier run, {last}.")
    return interval


class JointLayout:
    """The programs of a series; all of one model and one kind of tracker."""

    def __init__(self, programs: Sequence[Program]) -> None:
        self.programs = tuple(programs)

    def __repr__(self) -> str:
        return f"JointLayout({', '.join(map(repr, self.programs))})"

    @cached_property
    def size(self) -> int:
        """Words of a state, W."""
        return sum(one.layout.size for one in self.programs)

    @cached_property
    def tag(self) -> bytes:
        """Fingerprint of all programs, 8 bytes."""
        tags = [one.layout.tag for one in self.programs]
        return tags[0] if len(tags) == 1 else hashlib.sha256(b"".join(tags)).digest()[:8]

    @cached_property
    def start(self) -> bytes:
        """The packed state before the first sample."""
        return self.pack(self.taken(self.tile()))

    def tile(self, states: Sequence[State] = ()) -> Array:
        """A tile with a lane for each output, at its start or with the given fields."""
        return tile_of(self.programs, states)

    def taken(self, tile: Array) -> Array:
        """The words (W,) of the lanes of a tile."""
        words: Array = self.programs[0].layout.taken(tile)
        return words.reshape(-1)

    def filled(self, words: Array) -> Array:
        """A tile with a state (W,)."""
        tile = self.tile()
        self.programs[0].layout.put(tile, np.arange(len(self.programs)), words)
        return tile

    def field(self, words: Array, name: str) -> Array:
        """A field of numbers of a state (W,), as (ny, k)."""
        return self.programs[0].layout.field(words.reshape(len(self.programs), -1), name)

    def pack(self, words: Array) -> bytes:
        """A state (W,) as bytes."""
        return packed(self.tag, words)

    def unpack(self, data: bytes) -> Array:
        """The inverse of `pack`; ValueError for anything else."""
        return own_words(data, self.tag, self.size, self.programs)
