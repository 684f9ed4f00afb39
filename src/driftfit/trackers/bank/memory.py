"""The memory of a bank: its arrays before the first sample, and how they lie one after the other in one field."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.engine.simd import WIDTH
from driftfit.trackers.bank.change import Change
from driftfit.trackers.bank.leaves import forget
from driftfit.trackers.bank.leaves.forecast import FROZEN, VALUE
from driftfit.trackers.bank.leaves.leaves import FIRST
from driftfit.trackers.bank.machine import selection
from driftfit.trackers.bank.machine.ancestry import news_of
from driftfit.trackers.bank.machine.gaps.gap import SINCE
from driftfit.trackers.bank.machine.layout import BESIDE, FLAGS, HEAD, PACKED, PLAIN, REPORTED, ROWS, THETA, TOLD
from driftfit.trackers.bank.machine.lookahead import NODES
from driftfit.trackers.bank.reduction import Reduction
from driftfit.trackers.bank.sensor import Sensor, table_of

SINGLE = ("evidence", "window", "kept", "leaves")
"""Entries of the head of a report, in its order."""
RING = 256
"""Samples of which a stream remembers probabilities, for events."""


class Settings(Protocol):
    """The settings of a `Bank`, as far as its memory depends on them."""

    @property
    def all_changes(self) -> tuple[Change, ...]: ...
    @property
    def all_sensors(self) -> tuple[Sensor, ...]: ...
    @property
    def reduction(self) -> Reduction: ...
    @property
    def event_probabilities(self) -> tuple[Array, Array]: ...
    @property
    def chained(self) -> bool: ...
    @property
    def lag_variance(self) -> bool: ...
    @property
    def form(self) -> str: ...


def arrays_of(bank: Settings, n: int, na: int, unit: float, theta0: Array) -> dict[str, Array]:
    """What `driftfit.trackers.bank.machine.advance` works on, before the first sample; covariances are multiplied by
    ``unit``.
    """
    Hd, Hm, chained = len(bank.all_changes), len(bank.all_sensors), bank.chained
    shape, H = bank.reduction.shape(Hd, Hm), Hd * Hm
    tri, K, W = n * (n + 1) // 2, shape.children * (2 if chained else 1), shape.floors
    wide, links = _eights(tri), _eights(K + 1)
    chain, initial = bank.event_probabilities
    rows, lower = FIRST + n + tri + na + (na * (na + 1) // 2 if bank.lag_variance else 0), np.tril_indices(n)
    steps = [one.increments(n) for one in bank.all_changes]
    Q = np.array([np.pad(Q[lower] * unit, (0, wide - tri)) for Q, _ in steps])
    scaled = any(sizes.any() for _, sizes in steps)
    forgets = any(one.forgets for one in bank.all_changes)
    more = na + (tri + 2 * n if forgets else 0)
    places = np.zeros((forget.ANCHORS + (Hd * n if forgets else 0), n))
    places[forget.MEAN], places[forget.CAP] = theta0, np.inf
    if forgets:
        places[forget.ANCHORS :] = np.vstack([one.anchors(n, unit) for one in bank.all_changes])
    parents, children = _room(most := max(shape.parents * (2 if chained else 1), K // H), Hd, Hm)
    if bank.form == "sqrt":
        parents, more = parents + WIDTH, more + n + -(-(2 * tri + 4 * n) * WIDTH // children)
    past = _eights(W * (H + 1))
    refilters, waits = shape.knobs[selection.KIND] == selection.REFILTER, shape.knobs[selection.WAIT] > 0.0
    return {
        "A": np.zeros((rows, parents)), "B": np.zeros((rows, children + WIDTH)), "T": np.zeros((K + 1, past)),
        "T2": np.zeros((K + 1, past)), "X": np.zeros((tri + 3 * n + 8 + max(H, Hm) + more, children)),
        "links": np.zeros((4, links), int), "group": np.zeros(K, int),
        "slots": np.zeros(max(2 * K, int(shape.bases[0])) + 1, int), "prior": np.zeros((H, children)),
        "Q": Q, "fixed": Q,
        "sizes": np.array([sizes if scaled else sizes[:0] for _, sizes in steps]),
        "factors": np.ones(Hd), "theta0": places,
        "maps": np.array([change.mapping() for change in bank.all_changes] * 2),
        "sensors": table_of(bank.all_sensors),
        "chain": chain, "initial": initial, "given": np.full(H + Hd * Hd, np.nan),
        "loss": bank.reduction.losses(H), "knobs": shape.knobs, "bases": shape.bases,
        "stamps": np.zeros(shape.held), "parts": np.zeros((4 + NODES, K * H if waits else 1)),
        "root": np.zeros((rows, WIDTH)), "ring": np.zeros((RING, BESIDE + H)), "Qt": np.zeros((Hd + 1, wide)),
        "samples": np.zeros((int(shape.knobs[selection.DEPTH]) + 1 if refilters or waits else 1, 3 + n)),
        "news": news_of(H, Hm, past), "gap": _closed(Hd, wide),
        "path": path_of(H, Hd, wide, most if chained else 0),
        "lag_prob": np.zeros((W, H)),
        "brief": np.zeros((min(W, TOLD), H)), "moving": np.zeros((H, H)), "decided": np.full((shape.held, 3), -1.0),
    }  # fmt: skip


def packed(
    arrays: Mapping[str, Array], n: int, na: int, unknown: bool, alike: bool, factored: bool, apart: bool
) -> dict[str, Any]:  # fmt: skip
    """The fields memory, report and table; sizes are rounded up, so that banks of many shapes share a driver.

    Where covariances are ``factored`` no forecast comes from that of the mixture; where changes are events ``apart``
    from each other a gap is one floor.
    """
    table = np.zeros((ROWS, 3), int)
    flat: list[list[Array]] = [[], [np.zeros(HEAD)]]
    for k, name in enumerate(PACKED):
        array, into = np.ascontiguousarray(arrays[name]), flat[name in REPORTED]
        if into is flat[0]:
            into.append(np.zeros(-sum(part.size for part in into) % WIDTH))  # a cache line begins
        table[k] = 8 * sum(part.size for part in into), *(1, *array.shape)[-2:]
        into.append(array.ravel().view(np.float64))
    table[THETA, 1] = n
    table[FLAGS] = na, unknown, alike
    walks = (arrays["maps"][:, (forget.KEEP, forget.RESET, forget.KIND)] == (1.0, 0.0, 0.0)).all()
    noises = not arrays["sensors"][:, (VALUE, FROZEN)].any()
    table[PLAIN] = na == 0 and walks and noises and not factored, walks, apart
    memory, report = (np.concatenate(parts) for parts in flat)
    return {"memory": _padded(memory, 8192), "report": _padded(report, 32), "table": table, "flat": np.zeros(1)}


def path_of(H: int, Hd: int, wide: int, room: int) -> Array:
    """The table of `driftfit.trackers.bank.machine.gaps.chain_gap`, with room for so many leaves; empty for none."""
    table = np.zeros((3 * H + Hd + 1 if room else 0, max(H, wide) + 1))
    table[-1:, -1] = room
    return table


def _closed(Hd: int, wide: int) -> Array:
    """The table of a gap (`driftfit.trackers.bank.machine.gaps.gap`) where there is none."""
    table = np.zeros((Hd, wide + WIDTH))
    table[0, wide + SINCE] = 1.0
    return table


def _room(parents: int, Hd: int, Hm: int) -> tuple[int, int]:
    """Columns for leaves and for their children, with room for eights that begin at every block of them."""
    blocks = (parents, parents * Hd, parents * Hd * Hm)
    up = [_eights(size) for size in blocks]
    most = max(blocks[2] - size + room for size, room in zip(blocks, up, strict=True))
    return up[0], _eights(most)


def _eights(size: int) -> int:
    """The next multiple of eight."""
    return -(-size // WIDTH) * WIDTH


def _padded(x: Array, least: int) -> Array:
    """With zeros up to one of few sizes."""
    size = least
    while size < len(x):
        size *= 2
    return np.concatenate([x, np.zeros(size - len(x))])
