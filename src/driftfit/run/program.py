"""Program: a bound model with a tracker. It makes the tiles that hold their state and keeps the compiled drivers.

No other module makes tiles or drivers of a model and a tracker; a tile of several lanes has a program for each of them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from importlib.util import find_spec
from time import perf_counter
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import Progress

from driftfit.data import storage
from driftfit.data.arguments import check_ready
from driftfit.data.record import Record
from driftfit.engine.drivers import GATED, NOWHERE, Drivers, TrackerSteps, drivers
from driftfit.engine.kernel import Array, nothing
from driftfit.engine.tiles import OPEN, held_in, make_tile, output_record, output_type, repeat_tile
from driftfit.models.base import Model
from driftfit.models.regression import Regression
from driftfit.readings.gate import AT_START, SIGNAL, Gate
from driftfit.run.columns import COLLECTED, collecting, put_columns
from driftfit.run.gating import ROW, First, begun, gate_of, judging, replayed
from driftfit.run.layout import Layout, words_of
from driftfit.trackers.base import Tracker

PROGRESS_SAMPLES = 1_000_000
"""Samples beyond which a progress bar is shown."""

FIRST_PART, PART_SECONDS = 1024, 0.1
"""Samples of the first part of a record, and about the seconds that a part takes: Ctrl-C is heard between two parts."""

SINGLE_BLOCK = 4096
"""Samples of a block of results that are kept in single precision."""

WIDEST_LANES = 10
"""Parameters above which loops over lanes are slower than single lanes (docs/decisions/vectorisation.md)."""

State = Mapping[str, Array]
"""Fields of one lane of a tile, by name."""


def progress_bar() -> Progress:
    """A progress bar on the error stream; in a notebook without ipywidgets none, since rich would only warn there."""
    return Progress(
        console=Console(stderr=True, force_jupyter=None if find_spec("ipywidgets") else False), transient=True
    )


@contextmanager
def progress(what: str, total: int, shown: bool) -> Iterator[Callable[[int], None]]:
    """A function that advances a progress bar. The bar is only made when it is shown, because making it takes a
    millisecond.
    """
    if not shown:
        yield lambda count: None
        return
    with progress_bar() as display:
        task = display.add_task(what, total=total)
        yield lambda count: display.advance(task, count)


@dataclass(frozen=True)
class Program:
    """A bound model and the tracker that estimates its parameters; what follows from the two is computed once."""

    model: Model
    tracker: Tracker
    output: str | None = None
    """The index of its output, if each of several outputs has a lane."""
    shared: Model | None = None
    """The model of outputs that share one theta: ``model`` takes them one after the other, as rows of an instant."""
    gate: Gate | None = None
    """What decides which readings are used; None: all."""
    trackers: tuple[Tracker, ...] = ()
    """Those of all outputs, if each of several has a lane."""
    rows: tuple[str, ...] = ()
    """The names of outputs that share one theta, whose rows come one after the other."""

    def __post_init__(self) -> None:
        if (self.model.hidden is not None) != self.tracker.follows_states:
            raise ValueError(
                f"{type(self.tracker).__name__} does not work with {type(self.model).__name__}: a StateSpace is "
                "followed by JointKalman or ParticleFilter, which move its hidden states and follow nothing else."
            )

    def __reduce__(self) -> Any:
        """Copies, and programs sent to another process, are made from the fields."""
        return Program, (self.model, self.tracker, self.output, self.shared, self.gate, self.trackers, self.rows)

    @property
    def whole(self) -> Model:
        """The model that the user gave, with all its outputs."""
        return self.model if self.shared is None else self.shared

    @cached_property
    def settling(self) -> float:
        """`Linearised.settling` of the whole model, or 0."""
        return 0.0 if self.whole.linearised is None else self.whole.linearised.settling

    @cached_property
    def inspects(self) -> bool:
        """Whether the model looks at the whole record before a run."""
        return type(self.model).inspect is not Model.inspect

    @cached_property
    def alone(self) -> Program | None:
        """The program of its output alone; None if the model needs the other outputs, or has none."""
        model = None if self.output is None else self.model.alone(self.output)
        return None if model is None else Program(model, self.tracker, gate=self.gate)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters; of several with one name the later ones have a number: g, g (2)."""
        if self.output is None:
            return _distinct(self.tracker.names_for(self.model))
        own = () if self.alone is None else self.alone.names
        return tuple(f"{name}[{self.output}]" for name in own) or _distinct(self.model.names_of(self.output))

    @cached_property
    def signals(self) -> tuple[str, ...]:
        """Names of the output and of the inputs; of outputs that share one theta those of each, u1[y2] for example."""
        m = self.model.m
        inputs = self.model.input_names or (("u",) if m == 1 else tuple(f"u{j + 1}" for j in range(m)))
        each = ((name, *(f"{one}[{name}]" for one in inputs)) for name in self.rows)
        return tuple(name for names in each for name in names) or (self.output or "y", *inputs)

    @property
    def start(self) -> State:
        """Fields of a lane before the first sample, other than those of the model."""
        if self.output is None:
            return self.tracker_start
        own = self.model if self.alone is None else self.alone.model
        return {**own.fitted_to(self.steps)[0], **self.tracker_start}

    @cached_property
    def tracker_start(self) -> State:
        """The tracker's fields before the first sample."""
        alone = None if self.output is None else self.alone
        own = self.tracker.state_for(self.model if alone is None else alone.model)
        if self.gate is None:
            return own
        return {**own, **begun(self.gate, self.model, len(self.rows))}

    @property
    def scratch(self) -> tuple[str, ...]:
        """Fields that carry nothing from one sample to the next."""
        of = ROW if self.rows else ""
        return (*self.tracker.scratch, *((of + "gate_fit", of + "gate_doubt", "raw_y") if self.gate else ()))

    @property
    def outputs(self) -> tuple[str, ...]:
        """Fields that are stored of every sample, besides those of all trackers."""
        return self.tracker.outputs if self.gate is None else (*self.tracker.outputs, *GATED)

    @cached_property
    def steps(self) -> TrackerSteps:
        """The compiled steps of the tracker; a gate notes readings in its place."""
        steps = self.tracker.steps_for(self.model)
        return steps if self.gate is None else steps._replace(note=nothing)

    @property
    def shapes(self) -> tuple[Any, ...]:
        """Names and shapes of the tracker's state: programs with equal shapes and equal steps may share a tile."""
        return tuple((name, np.shape(value)) for name, value in self.tracker.state_for(self.model).items())

    @cached_property
    def _drivers(self) -> dict[tuple[str, TrackerSteps | None], Drivers]:
        return {}

    @cached_property
    def _begin(self) -> tuple[np.dtype[Any], Array | bytes]:
        """The record of a tile, and that of one lane at its start: where it has no open fields, its bytes, which are
        copied faster than fields.
        """
        tile = _started([self])
        return tile.dtype, tile if OPEN[0] in (tile.dtype.fields or ()) else tile.tobytes()

    def schema(self, arrays: bool = False) -> dict[str, str]:
        """Columns and types of the results at a sample, which `to_table` writes after the signals, before any data.

        Types have the names of SQL: "double", "boolean", "array<double>" (with ``arrays``, theta and std of all
        parameters).
        """
        own = {"prediction": "double", "innovation": "double", "innovation_std": "double", "ok": "boolean"}
        if arrays:
            return own | {"theta": "array<double>", "std": "array<double>"}
        return own | {f"{what}_{name}": "double" for name in self.names for what in ("theta", "std")}

    @cached_property
    def layout(self) -> Layout:
        """Where the fields of a lane are, and which of them a packed state holds."""
        owner = {
            "model": storage.describe(self.model),
            "tracker": storage.describe(self.tracker),
            "output": self.output,
            "gate": None if self.gate is None else self.gate.settings(),
        }
        record = self.tile().dtype
        return Layout(record, held_in(record, tuple(self.tracker_start)), self.scratch, owner)

    def pack(self, tile: Array, lane: int = 0) -> bytes:
        """The state of a lane as bytes (`driftfit.run.layout`)."""
        return self.layout.pack(words_of(tile)[self.layout.rows(tile), lane])

    def unpack(self, data: bytes, tile: Array | None = None, lane: int = 0) -> Array:
        """A tile of one lane, or a lane of the given tile, with the state that `pack` wrote; microseconds.

        Raises
        ------
        ValueError
            For bytes that are damaged, or the state of another model, tracker, setting or layout.
        """
        into = self.tile() if tile is None else tile
        self.layout.put(into, lane, self.layout.unpack(data))
        return into

    def drivers(self, keep: str = "std", steps: TrackerSteps | None = None) -> Drivers:
        """The compiled loops; ``steps`` replace the tracker's own, to inspect the run."""
        found = self._drivers.get((keep, steps))
        if found is None:
            model, own = self.model.fitted_to(self.steps)[1], self.steps if steps is None else steps
            judge = self.gate and judging(self.gate, self.model, self.tracker, (model, own), len(self.rows))
            found = drivers(model, own, keep, judge)
            found = found._replace(run=partial(self._decided, found.run)) if judge else found
            self._drivers[keep, steps] = found
        return found

    def _decided(
        self, run: Any, tile: Array, y: Array, u: Array, known: Array, out: Array, theta: Array = NOWHERE,
        found_too: list[tuple[int, First]] | None = None,
    ) -> int:  # fmt: skip
        """Run to the end, with the first samples once more without the codes that were found among them.

        ``found_too`` takes the sample at which they were found, and the codes.
        """
        done: int = run(tile, y, u, known, out, theta)
        if tile["gate_replay"][0, 0] > 0:
            found = self.replay(tile)
            if found_too is not None:
                found_too.append((done - 1, found))
            if "reason" in (out.dtype.names or ()) and theta is NOWHERE:
                count = min(done, len(found.reason))
                out["reason"][done - count : done] = found.reason[-count:]
            rest = slice(done, None)
            known = known if len(known) == 1 else known[rest]
            into = (out[rest],) if theta is NOWHERE else (out, theta[rest])
            self._decided(run, tile, y[rest], u[rest], known, *into)
        return len(y)

    def replay(self, tile: Array) -> First:
        """Bring a tile, whose gate has found codes among the first samples, to where it is without them."""
        each = zip(self.trackers, self.model.outputs, strict=False)
        lanes = [replace(self, tracker=tracker, output=name) for tracker, name in each] or [self]
        first = replayed(tile, self.model.m, len(self.rows))
        fresh = tile_of(lanes, [{"gate_decided": np.array(1)}] * len(lanes))
        coded, out = first.codes.any(axis=1), self.written(fresh, len(first.y))
        self.drivers().run(fresh, *first.without_codes(), first.known, out)
        fresh["gate_refused"][0] = np.sum(coded, axis=0)
        tile.view(np.uint8)[:] = fresh.view(np.uint8)
        signal = np.argmax(first.codes, axis=1)
        signal += (1 + self.model.m) * (np.arange(len(signal)) % (len(self.rows) or 1))[:, None]
        return first._replace(reason=np.where(coded, AT_START + SIGNAL * signal, out["reason"]))

    @property
    def width(self) -> int:
        """The number of lanes of a tile of many series, or of many settings."""
        most = min(self.model.steps.width, self.tracker.width)
        return 1 if self.model.n > WIDEST_LANES or self.gate is not None else most

    def lanes(self, count: int) -> Array:
        """A tile with this program in every lane, at its start. It is made once and must not be changed."""
        if count not in self._wide:
            self._wide[count] = tile_of([self] * count)
        return self._wide[count]

    @cached_property
    def _wide(self) -> dict[int, Array]:
        return {}

    def tile(self, state: State | None = None) -> Array:
        """A tile of one lane at its start, or with the given fields."""
        record, start = self._begin
        # a bank reads its memory as vectors; another single lane needs no alignment
        tile = repeat_tile(start, 1) if isinstance(start, np.ndarray) else np.ndarray((1,), record, bytearray(start))
        if state is not None:
            put(tile, 0, state)
        return tile

    def resting(self, state: State) -> Array:
        """A tile with the state of a run, without the known factors of its last sample."""
        return self.tile({name: value for name, value in state.items() if name not in STANDING})

    def written(self, tile: Array, T: int, keep: str = "std", dtype: Any = np.float64) -> Array:
        """An array for the results of T samples of a tile."""
        record = output_record(tile.dtype, self.outputs, keep, dtype)
        return np.ndarray(T, record, np.empty(T * record.itemsize, np.uint8))  # np.empty goes through all fields

    def inspected(self, tile: Array, T: int, fields: tuple[str, ...], keep: str = "std") -> Array:
        """An array for T samples of which other steps than the tracker's store these ``fields``."""
        return np.empty(T, output_type(tile, tuple(dict.fromkeys((*(GATED if self.gate else ()), *fields))), keep))

    def loop(self, tile: Array, T: int, keep: str, dtype: Any, collected: bool) -> tuple[Any, Array]:
        """(the routine that runs tiles like this one, an array for the results of T samples); with ``collected`` it
        stores every sample as the tracker receives it, in double precision.
        """
        if not collected:
            return self.fill, self.written(tile, T, keep, dtype)
        fields = (*self.outputs, *COLLECTED)
        return self.drivers(steps=collecting(self.steps)).run, self.inspected(tile, T, fields)

    def run(self, tile: Array, record: Record, keep: str = "std", dtype: Any = np.float64) -> Array:
        """Run a tile over a record, a lane for each output; returns what is kept, (T,) of `output_type`."""
        T = len(record)
        out = self.written(tile, T, keep, dtype)
        if FIRST_PART >= T:
            self.fill(tile, *lanes_of(record), out)
            return out
        a, count = 0, FIRST_PART
        with progress("tracking", T, T > PROGRESS_SAMPLES) as advance:
            while a < T:
                begun, part = perf_counter(), slice(a, min(a + count, T))
                self.fill(tile, *lanes_of(record.part(part)), out[part])
                advance(part.stop - a)
                a, count = part.stop, 2 * count if perf_counter() - begun < PART_SECONDS else max(1, count // 2)
        return out

    def fill(self, tile: Array, y: Array, u: Array, known: Array, out: Array) -> None:
        """Run a tile over samples. Results that are kept in single precision are first written to a block that stays in
        the cache.
        """
        keep, rows = _driven(tile.dtype, self.outputs, out.dtype)
        run, last = self.drivers(keep).run, list[Array]()
        if out.dtype.names == ("theta",):  # the driver writes theta, and the rest of a sample over that of the last one
            last, out, rows = [np.empty(1, rows)], out["theta"], rows["theta"]
        if out.dtype == rows.base:
            run(tile, y, u, known, *last, out)
            return
        block = np.empty(min(SINGLE_BLOCK, len(out)), rows)
        for a in range(0, len(out), SINGLE_BLOCK):
            part = slice(a, min(a + SINGLE_BLOCK, len(out)))
            results = block[: part.stop - a]
            run(tile, y[part], u[part], known if len(known) == 1 else known[part], *last, results)
            _copy(results, out[part])


@lru_cache(maxsize=256)
def _driven(tile: np.dtype[Any], outputs: tuple[str, ...], out: np.dtype[Any]) -> tuple[str, np.dtype[Any]]:
    """(what the driver of a tile keeps, the record that it writes: ``out`` itself if it is equal), for results of which
    ``out`` is kept.
    """
    keep = "cov" if kept(out)[0] == "cov" else "std"
    rows = output_record(tile, outputs, keep)
    return keep, out if out == rows else rows


def _copy(results: Array, out: Array) -> None:
    """Store what ``out`` keeps of results, all at once where it keeps all."""
    T, names = len(out), out.dtype.names
    if names is None:
        out[...] = results
        return
    if names == results.dtype.names and all(results.dtype[name].base == np.float64 for name in names):
        out.view(out.dtype[names[0]].base).reshape(T, -1)[...] = results.view(np.float64).reshape(T, -1)
        return
    for name in names:
        put_columns(results[name], out[name])


def kept(rows: np.dtype[Any]) -> tuple[str, np.dtype[Any]]:
    """(what is kept, in which precision) in rows of results."""
    names = rows.names or ()
    return "cov" if "P" in names else "std" if "var" in names else "theta", rows["theta"].base


STANDING = ("interval", "noise", "drift", "drift_root")
"""Fields with the known factors of one sample."""


def tile_of(programs: Sequence[Program], states: Sequence[State] = ()) -> Array:
    """A tile with a lane for each program (all of one model), at its start or with the given fields."""
    if len(programs) == 1:
        return programs[0].tile(*states)
    tile = _started(programs)
    for lane, state in enumerate(states):
        put(tile, lane, state)
    return tile


def _started(programs: Sequence[Program]) -> Array:
    model, tracker = programs[0].model, programs[0].tracker
    starts = {one: one.start for one in programs}
    memory, _ = model.fitted_to(programs[0].steps)
    if both := sorted((set(memory) & set(programs[0].tracker_start)) - set(tracker.replaces)):
        raise ValueError(
            f"{type(model).__name__} and {type(tracker).__name__} both have a field {', '.join(both)} in their state, "
            "which would be one and the same; rename it in one of them, or list it in the tracker's `replaces`."
        )
    return make_tile(model.n, model.m, memory, [starts[one] for one in programs])


def put(tile: Array, lane: int, state: State) -> None:
    """Write fields of a lane."""
    for name, value in state.items():
        tile[name][0, ..., lane] = value


def lanes_of(record: Record) -> tuple[Array, Array, Array]:
    """(y, u, known) of a record in the form that drivers take: a lane for each output, all with the same inputs."""
    if record.y.ndim > 1:
        return record.y, np.repeat(record.u[:, :, None], record.y.shape[1], axis=2), record.known.columns
    return record.y[:, None], record.u[:, :, None], record.known.columns[:, :, None]


def state_of(tile: Array, lane: int = 0) -> dict[str, Array]:
    """The fields of a lane, by name, as views."""
    return {name: tile[name][0, ..., lane : lane + 1][..., 0] for name in storage.fields(tile)}


def shown(trackers: Sequence[Tracker]) -> str:
    """The text for one tracker shared by all outputs, or for the tracker of each."""
    return repr(trackers[0]) if len(set(trackers)) == 1 else ", ".join(map(repr, trackers))


def programs_of(
    model: Model, tracker: Any, inputs: int | Sequence[str], gate: Gate | bool | None = None
) -> tuple[Program, ...]:
    """The program of each output of a model with these inputs; outputs that share one theta have one.

    ``tracker`` is one for all, or a mapping from the name of each output to its tracker; ``gate`` as in `gate_of`.
    ValueError for settings that are incomplete, or that cannot run together.
    """
    if len(model.outputs) == 1:
        if not isinstance(tracker, Tracker):
            raise ValueError(f"a model with one output takes one tracker for each series; got {tracker!r}.")
        gate = gate if gate is None or isinstance(gate, bool) else gate_of(tracker, gate)
        return _programs(model, tracker, inputs if isinstance(inputs, int) else tuple(inputs), gate)
    if isinstance(tracker, Mapping) and not model.shared:
        if set(tracker) != set(model.outputs):
            raise ValueError(
                f"trackers were given for {', '.join(map(str, tracker))}, but the outputs are "
                f"{', '.join(model.outputs)}."
            )
        trackers = tuple(tracker[name] for name in model.outputs)
    else:
        trackers = (tracker,) * (1 if model.shared else len(model.outputs))
    for one in trackers:
        if not isinstance(one, Tracker):
            raise ValueError(f"several outputs take one tracker, or one for each output by its name; got {tracker!r}.")
        check_ready(one)
    if model.shared:
        judge = gate_of(tracker, gate)
        return (Program(_row_model(model, tracker, inputs), tracker, shared=model, gate=judge, rows=model.outputs),)
    bound = model.bind(inputs)
    programs = tuple(
        Program(bound, one, name, gate=gate_of(one, gate), trackers=trackers)
        for one, name in zip(trackers, model.outputs, strict=True)
    )
    if len({one.steps for one in programs}) > 1 or len({one.shapes for one in programs}) > 1:
        raise ValueError(f"the trackers of several outputs must be of one kind and form; got {shown(trackers)}.")
    return programs


@lru_cache(maxsize=64)
def _programs(
    model: Model, tracker: Tracker, inputs: int | tuple[str, ...], gate: Gate | bool | None
) -> tuple[Program, ...]:
    """The programs are cached for the next record, since settings are compared by value."""
    return (Program(model.bind(inputs), check_ready(tracker), gate=gate_of(tracker, gate)),)


def _row_model(model: Model, tracker: Tracker, inputs: int | Sequence[str]) -> Model:
    """The model of one row of a shared regression."""
    assert isinstance(model, Regression)
    if not tracker.covariance:
        raise ValueError(
            f"{type(tracker).__name__} carries no covariance, so the rows of an instant could not inform each other; "
            "use FLS, Kalman or RLS with shared=True."
        )
    return replace(model, ny=1, shared=False).bind(inputs)


def _distinct(names: tuple[str, ...]) -> tuple[str, ...]:
    """Names of which those that occur again have a number, since tables and columns are read by them."""
    if len(set(names)) == len(names):
        return names
    return tuple(name if (k := names[: i + 1].count(name)) == 1 else f"{name} ({k})" for i, name in enumerate(names))
