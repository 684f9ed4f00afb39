"""One unit of a stream with keyed state: its state as bytes and some rows go in, its state and results come out.

A state is a few numbers, the packed state of its programs and the rows that wait:

    counts, last and newest time (8 bytes each), lengths of the packed state and of that of the alarms (8 each), those
    states, rows of 8 (1 + ny + m) bytes
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from struct import Struct
from typing import Any, NamedTuple

import numpy as np

from driftfit.bridges.spark.flow import PLACES, Origin, migrated
from driftfit.bridges.spark.pieces import COUNTS, SAMPLES, USED, alarms_of, alarms_schema, collects, watched
from driftfit.bridges.spark.task import Task
from driftfit.data import late
from driftfit.engine.drivers import INTERVAL
from driftfit.engine.kernel import Array
from driftfit.run.lanes import Lane
from driftfit.run.layout import tag_of
from driftfit.run.live.rule import AlarmRule
from driftfit.run.warm_start import JointLayout

HEAD = Struct(f"<{len(COUNTS)}q8s8sqq")
MICROS = "M8[us]"


class Known(NamedTuple):
    """A state."""

    counts: Array
    last: Array
    """(1,): the time of the last sample, NaN or NaT if there is none; so is the newest time of a row."""
    newest: Array
    words: Array | None
    watch: str | None
    time: Array
    """(k,): times of the rows that wait, and their numbers (k, ny + m)."""
    rows: Array


@dataclass(frozen=True)
class Unit:
    """The settings of a unit; times are numbers, or microseconds if they are ``dated``.

    ``rules`` has the rule of each output; ``before`` is the tracker that made the states so far, if another one did.
    """

    task: Task
    hold: Any
    dated: bool
    rules: tuple[AlarmRule | None, ...]
    before: Any = None

    @property
    def joint(self) -> JointLayout:
        """The programs of the unit."""
        found = self.task.joint_for(None)
        if isinstance(found, str):
            raise ValueError(found)
        return found

    def step(self, state: bytes | None, rows: Sequence[tuple[Any, ...]]) -> tuple[bytes, list[dict[str, Any]]]:
        """(the state after some rows (time, y, u), the results)."""
        known = self._known(state)
        time, values = self._arriving(rows)
        fates = late.sort_out(
            np.zeros(len(known.time) + len(time), int),
            np.concatenate([known.time, time]),
            np.arange(len(known.time) + len(time)) < len(known.time),
            known.newest,
            self.hold,
        )
        every = np.concatenate([known.rows, values])
        return self._after(known._replace(newest=fates.newest), np.concatenate([known.time, time]), every, fates)

    def ended(self, state: bytes, reason: str) -> list[dict[str, Any]]:
        """The results of what waits, and a row with the reason and the last state of the unit."""
        known = self._known(state)
        order = np.argsort(known.time, kind="stable")
        fates = late.Fates(order, np.full(len(order), late.RELEASED), known.newest)
        after, results = self._after(known, known.time, known.rows, fates)
        final = self._known(after)
        row = self._row(final.last[0], np.full(known.rows.shape[1], np.nan))
        return [*results, row | {"failed": reason, "state": self._packed(final.words)}]

    def begun(self, given: Mapping[str, Any]) -> bytes:
        """A state to begin with, from a packed state, that of alarms, the last and newest time, and counts by name."""
        counts = np.array([given[name] or 0 for name in COUNTS])
        last, newest, never = (self._times(times) for times in ([given["last"]], [given["newest"]], []))
        width = len(self.task.y) + len(self.task.u)
        words = self._words(bytes(given["state"]))
        return self._state(Known(counts, last, newest, words, given["watch"], never, np.zeros((0, width))))

    def newest(self, state: bytes) -> float | None:
        """The newest time of a row; None if there is none."""
        found = np.frombuffer(HEAD.unpack_from(state)[len(COUNTS) + 1], MICROS if self.dated else float)[0]
        return None if found != found else float(found.astype(np.int64) if self.dated else found)

    def _after(self, known: Known, time: Array, every: Array, fates: late.Fates) -> tuple[bytes, list[dict[str, Any]]]:
        """(the state, the results) after rows whose fates are decided."""
        going, staying = (fates.order[fates.fate == code] for code in (late.RELEASED, late.WAITING))
        counts, results = known.counts, list[dict[str, Any]]()
        if len(going):
            known, results = self._run(known, time[going], every[going])
        for code, place in PLACES.items():
            out = fates.order[fates.fate == code]
            counts[place] += len(out)
            results += [self._row(time[k], every[k]) | {"failed": late.REASONS[code]} for k in out.tolist()]
        return self._state(known._replace(time=time[staying], rows=every[staying])), results

    def _known(self, state: bytes | None) -> Known:
        kind, width = np.dtype(MICROS if self.dated else float), len(self.task.y) + len(self.task.u)
        if state is None:
            never = self._times([None])
            return Known(np.zeros(len(COUNTS), int), never, never, None, None, never[:0], np.zeros((0, width)))
        *counts, last, newest, length, alarms = HEAD.unpack_from(state)
        middle = HEAD.size + length
        end = middle + alarms
        count = (len(state) - end) // (8 * (1 + width))
        rows = np.frombuffer(state, float, count * width, end + 8 * count).reshape(count, width)
        first, second = (np.frombuffer(one, kind) for one in (last, newest))
        words = self._words(state[HEAD.size : middle]) if length else None
        alarm = state[middle:end].decode() or None
        return Known(np.array(counts), first, second, words, alarm, np.frombuffer(state, kind, count, end), rows)

    def _words(self, packed: bytes) -> Array:
        """The words of a packed state, carried over if another tracker made it."""
        joint = self.joint
        if self.before is None or tag_of(packed) == joint.tag:
            return joint.unpack(packed)
        return migrated(self.task, joint, packed, None, [Origin(self.before, joint.text)])

    def _packed(self, words: Array | None) -> bytes:
        return self.joint.start if words is None else self.joint.pack(words)

    def _state(self, known: Known) -> bytes:
        packed, alarms = self._packed(known.words), (known.watch or "").encode()
        stamps = (known.last.tobytes(), known.newest.tobytes())
        head = HEAD.pack(*known.counts.tolist(), *stamps, len(packed), len(alarms))
        return head + packed + alarms + known.time.tobytes() + known.rows.tobytes()

    def _arriving(self, rows: Sequence[tuple[Any, ...]]) -> tuple[Array, Array]:
        values = np.array([[np.nan if v is None else v for v in row[1:]] for row in rows], float)
        return self._times([row[0] for row in rows]), values.reshape(len(rows), len(self.task.y) + len(self.task.u))

    def _times(self, given: Sequence[Any]) -> Array:
        if self.dated:
            return np.array(["NaT" if t is None else t for t in given], MICROS)
        return np.array([np.nan if t is None else t for t in given], float)

    def _row(self, time: Any, values: Array) -> dict[str, Any]:
        """The signals of a row."""
        found = dict(zip((*self.task.y, *self.task.u), values.tolist(), strict=True))
        stamp = None if time != time else int(time.astype(np.int64)) if self.dated else float(time)
        return {self.task.time: stamp} | found

    def _run(self, known: Known, time: Array, rows: Array) -> tuple[Known, list[dict[str, Any]]]:
        """(what is known after samples, their results)."""
        task, joint, T, ny = self.task, self.joint, len(time), len(self.task.y)
        tile = joint.tile() if known.words is None else joint.filled(known.words)
        factors = np.ones((T, 3, ny))
        factors[:, INTERVAL] = task.clock.steps(time)[:, None]
        if known.last[0] == known.last[0]:
            factors[0, INTERVAL] = task.clock.between(known.last, time[:1])[0]
        inputs = rows[:, [ny + task.u.index(name) for name in task.order]]
        u = np.repeat(inputs[:, :, None], ny, axis=2)
        run, out = joint.programs[0].loop(tile, T, "std", float, collects(self.rules))
        run(tile, np.ascontiguousarray(rows[:, :ny]), u, factors, out)
        numbers, watch = self._numbers(out), known.watch
        if any(self.rules):
            lanes = [Lane(out, tile, lane) for lane in range(ny)]
            causes, watch = watched(self.rules, joint, watch, int(known.counts[SAMPLES]), lanes, rows[:, :ny])
            numbers |= alarms_of(alarms_schema(task, self.rules), causes)
        known.counts[[SAMPLES, USED]] += T, int((out["ok"] > 0.0).any(axis=1).sum())
        found = [self._row(time[t], rows[t]) | {name: column[t] for name, column in numbers.items()} for t in range(T)]
        return known._replace(last=time[-1:], words=joint.taken(tile), watch=watch), found

    def _numbers(self, out: Array) -> dict[str, list[Any]]:
        """The columns of results."""
        task = self.task
        with np.errstate(invalid="ignore"):
            theta, std, deviation = out["theta"], np.sqrt(out["var"]), np.sqrt(out["s"])
        numbers: dict[str, list[Any]] = {}
        for j, (names, of) in enumerate(zip(task.names, task.suffixes, strict=True)):
            own = {"prediction": out["y_hat"], "innovation": out["e"], "innovation_std": deviation}
            own["ok"] = out["ok"] > 0.0
            numbers |= {f"{name}{of}": values[:, j].tolist() for name, values in own.items()}
            for what, path in (("theta", theta[..., j]), ("std", std[..., j])):
                if task.arrays:
                    numbers[f"{what}{of}"] = path.tolist()
                else:
                    numbers |= {f"{what}_{name}": path[:, i].tolist() for i, name in enumerate(names)}
        return numbers
