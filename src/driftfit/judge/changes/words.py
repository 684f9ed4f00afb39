"""Events, the numbers that tables print of a change, and the sentences formed from them alone.

Each event is a row of the table for every parameter that it moves. A test reads the
sentences back: every date and value in them stands in the table.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.judge.changes.changes import Changes
from driftfit.show.text import digits

DATED = ("step", "temporary", "jump")
"""Kinds of events whose date has an interval."""


class Move(NamedTuple):
    """The change of one parameter in an event.

    ``before``, ``after``: its values on both sides, of a gradual change those at its ends. ``std``: standard error of
    their difference, NaN where it is not known. ``instead``: other parameters whose change would explain the record as
    well.
    """

    name: str
    before: float
    after: float
    std: float
    instead: tuple[str, ...] = ()

    @property
    def values(self) -> tuple[str, str]:
        """Both values as they are printed."""
        return digits(self.before, self.std), digits(self.after, self.std)


class Event(NamedTuple):
    """What happened at a date, or from one to another.

    ``kind``: "step", "temporary", "gradual", "wandering" or "jump". Samples and their times as text: ``at``, between
    ``earliest`` and ``latest`` (95 %); ``until``, between the last two, is the end of what has one, and None otherwise.
    """

    kind: str
    at: int
    earliest: int
    latest: int
    until: int | None
    until_earliest: int | None
    until_latest: int | None
    moves: tuple[Move, ...]
    when: str = ""
    ended: str = ""
    span: str = ""


def events(changes: Changes, names: Sequence[str], at: Array, text: Callable[[int], str]) -> tuple[Event, ...]:
    """The events of a record whose rows are the samples ``at`` (N,), whose times ``text`` prints."""
    kind = changes.kind.name
    if kind in ("gradual", "wandering"):
        found = [_slow(changes, names, at)]
    elif kind == "drift with jumps":
        steps = _steps(changes, names, at, "jump")
        found = [_slow(changes, names, at), *(steps[k] for k in changes.kind.dates)]
    else:
        found = _joined(_steps(changes, names, at, "step"), changes.which.temporary)
    return tuple(
        one._replace(
            when=text(one.at),
            ended="" if one.until is None else text(one.until),
            span=f"{text(one.earliest)} to {text(one.latest)}" if one.kind in DATED else "",
        )
        for one in found
    )


def _steps(changes: Changes, names: Sequence[str], at: Array, kind: str) -> list[Event]:
    """An event for every date."""
    dated, own, found = changes.found, changes.which, []
    for k, row in enumerate(dated.breaks):
        instead = tuple(names[j] for j in own.instead[k])
        moves = tuple(
            Move(names[j], float(own.theta[k, j]), float(own.theta[k + 1, j]), float(own.std[k, j]), instead)
            for j in own.at[k]
        )
        earliest, latest = (int(at[one]) for one in dated.spans[k])
        found.append(Event(kind, int(at[row]), earliest, latest, None, None, None, moves))
    return found


def _joined(found: list[Event], temporary: tuple[int, ...]) -> list[Event]:
    """The same with temporary changes as one event."""
    joined = []
    for k, one in enumerate(found):
        if k - 1 in temporary:
            continue
        if k in temporary:
            back = found[k + 1]
            names = {move.name for move in one.moves}
            more = tuple(
                move._replace(before=move.after, after=move.before) for move in back.moves if move.name not in names
            )
            one = one._replace(
                kind="temporary", until=back.at, until_earliest=back.earliest, until_latest=back.latest,
                moves=one.moves + more,
            )  # fmt: skip
        joined.append(one)
    return joined


def _slow(changes: Changes, names: Sequence[str], at: Array) -> Event:
    """An event that takes time: a gradual change, with the values at its ends, or a walk, with its range."""
    gradual, theta = changes.kind.name == "gradual", changes.found.theta
    first, last = changes.kind.ends if gradual else (0, len(at) - 1)
    ends = changes.kind.path[[first, last]] if gradual else (theta.min(axis=0), theta.max(axis=0))
    moves = tuple(Move(names[j], float(ends[0][j]), float(ends[1][j]), float("nan")) for j in changes.moving)
    begin = int(at[first])
    return Event("gradual" if gradual else "wandering", begin, begin, begin, int(at[last]), None, None, moves)


def clause(event: Event) -> str:
    """An event in words."""
    if event.kind == "wandering":
        each = (f"{move.name}, in segments from {move.values[0]} to {move.values[1]}" for move in event.moves)
        return f"a random walk explains it better than steps: {'; '.join(each)}"
    parts = []
    for move in event.moves:
        text = f"{move.name} from {move.values[0]} to {move.values[1]}"
        if move.instead:
            text += f" (or {' or '.join(move.instead)}: a change of it explains the record as well)"
        parts.append(text)
    moved = ", ".join(parts)
    if event.kind == "temporary":
        return f"from {event.when} to {event.ended} {moved}, then back"
    if event.kind == "gradual":
        return f"gradually from {event.when} to {event.ended} {moved}"
    return f"at {event.when} {moved}"


def rows(found: Sequence[Event]) -> list[tuple[str, ...]]:
    """The table: kind, date, its interval, end, parameter, its values, standard error of their difference."""
    table: list[tuple[str, ...]] = []
    for one in found:
        for move in one.moves:
            std = f"{move.std:.2g}" if np.isfinite(move.std) else ""
            table.append((one.kind, one.when, one.span, one.ended, move.name, *move.values, std))
    return table
