"""The memory of a bank: its arrays before the first sample, and their places in one field."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from driftfit.bank.layout import (
    HEAD,
    MEMORY_AT,
    MOST_REPORTED,
    OUTSIDE,
    PACKED,
    REPORT_AT,
    REPORTED,
    ROW,
    ROWS,
    SAMPLE_HEAD,
)
from driftfit.bank.leaves import forget
from driftfit.bank.leaves.forecast import FROZEN, VALUE
from driftfit.bank.leaves.leaf_matrix import FIRST
from driftfit.bank.machine.ancestry import news_of
from driftfit.bank.machine.gap import SINCE
from driftfit.bank.reducing import selection
from driftfit.bank.sensor import table_of
from driftfit.bank.table import VECTOR
from driftfit.engine.kernel import Array
from driftfit.engine.simd import WIDTH
from driftfit.trackers.forms.diffuse import NOW, WORK

SINGLE = ("evidence", "window", "kept", "leaves")
"""Entries of the head of a report, in its order."""
ANSWERS = 2
"""Rows for the outputs that a likelihood of the user's own returns, and for all that it returns for one leaf."""
SAMPLES = 100.0
"""Samples that the probabilities count for with which a bank that learns them begins."""
RING = 256
"""Samples of which a stream remembers probabilities, for events."""


def arrays_of(bank: Any, n: int, na: int, unit: float, theta0: Array) -> dict[str, Array]:
    """The arrays of `driftfit.bank.layout` before the first sample, but for fields of the state and
    windows of the scratch; covariances are multiplied by ``unit``.
    """
    Hd, Hm, twice = len(bank.all_changes), len(bank.all_sensors), 2 if bank.chained else 1
    shape, H = bank.reduction.shape(Hd, Hm), Hd * Hm
    tri, K, W = n * (n + 1) // 2, shape.children * twice, shape.levels
    rows = FIRST + n + tri + na + (na * (na + 1) // 2 if bank.lag_variance else 0)
    forgets = any(one.forgets for one in bank.all_changes)
    more = 2 * na + (tri + n if forgets else 0)
    square = n * n if any(one.resets_some for one in bank.all_changes) else 0
    parents, children = _room(max(shape.parents * twice, K // H), Hd, Hm)
    more += ANSWERS if any(sensor.kind == "own" for sensor in bank.all_sensors) else 0
    remembered, links = _whole_vectors(W * (H + 1)), _whole_vectors(K + 1)
    refilters, waits = shape.knobs[selection.KIND] == selection.REFILTER, shape.knobs[selection.WAIT] > 0.0
    return _of_changes(bank, n, unit, theta0) | {
        "parents": np.zeros((rows, parents)), "leaves": np.zeros((rows, children + WIDTH)),
        "history": np.zeros((K + 1, remembered)), "history_2": np.zeros((K + 1, remembered)),
        "scratch": np.zeros((_named_rows(n) + 5 + max(H, Hm) + more, children)),
        **{name: np.zeros(links, int) for name in ("parent", "event", "start", "order")}, "group": np.zeros(K, int),
        "slots": np.zeros(max(2 * K, int(shape.bases[0])) + 1, int), "prior": np.zeros((H, children)),
        "sensors": table_of(bank.all_sensors), "given": np.full(H, np.nan),
        "row": np.zeros(H), "loss": bank.reduction.losses(H), "reduction": shape.knobs,
        "bases": shape.bases, "stamps": np.zeros(shape.held),
        "components": np.zeros((4, K * H if waits else 1)), "root": np.zeros((rows, WIDTH)),
        "samples": np.zeros((int(shape.knobs[selection.DEPTH]) + 1 if refilters or waits else 1, 3 + n)),
        "path": np.zeros((3 * H + Hd + 1 if bank.chained else 0, max(H, _whole_vectors(tri)) + 1)),
        "spare_square": np.zeros((square, children)), "lag_rows": np.eye(na, n + 1),
        "ring": np.zeros((RING, SAMPLE_HEAD + H)), "new_events": news_of(H, Hm, remembered),
        "lag_prob": np.zeros((W, H)), "newest": np.zeros((min(W, MOST_REPORTED), H)),
        "decided": np.full((shape.held, 3), -1.0),
    }  # fmt: skip


def _of_changes(bank: Any, n: int, unit: float, theta0: Array) -> dict[str, Array]:
    """The arrays of the changes of theta."""
    changes, Hd, tri = bank.all_changes, len(bank.all_changes), n * (n + 1) // 2
    steps, lower, wide = [one.increments(n) for one in changes], np.tril_indices(n), _whole_vectors(tri)
    scaled, forgets = any(sizes.any() for _, sizes in steps), any(one.forgets for one in changes)
    places = np.zeros((forget.ANCHORS + (Hd * n if forgets else 0), n))
    places[forget.MEAN] = theta0
    if forgets:
        places[forget.ANCHORS :] = np.vstack([one.anchors(n, unit) for one in changes])
    transition, initial = bank.event_probabilities
    counts = np.tile(SAMPLES * initial.reshape(Hd, -1).sum(axis=1), (2 if bank.learns else 0, 1))
    maps, gap = np.array([change.mapping() for change in changes]), np.zeros((Hd, wide + WIDTH))
    gap[0, wide + SINCE] = 1.0
    walks = np.array([np.pad(Q[lower] * unit, (0, wide - tri)) for Q, _ in steps])
    return {
        "walks": walks, "fixed_walks": walks,
        "relative_walks": np.array([sizes if scaled else sizes[:0] for _, sizes in steps]), "drift": np.ones(Hd),
        "Q": np.zeros((Hd + 1, wide)), "maps": maps, "maps_nominal": maps, "places": places, "fixed_places": places,
        "transition": transition, "chain": transition.copy(), "initial": initial, "counts": counts,
        "given_chain": np.full(Hd * Hd, np.nan), "gap": gap,
    }  # fmt: skip


def outside(n: int) -> dict[str, tuple[int, int]]:
    """Rows and columns of the fields of the state that the routine reads itself, but for the report."""
    shapes = {name: (1, n) if kind == VECTOR else (n, n) for name, kind in OUTSIDE.items() if name != "report"}
    return shapes | {"work": (WORK, n), "at_start": (1, NOW)}


def _named_rows(n: int) -> int:
    """Rows of the scratch before its scores."""
    return n * (n + 1) // 2 + 3 * n + 2


def windows(n: int, na: int, rows: int) -> dict[str, tuple[int, int]]:
    """First rows, and numbers of rows, of the windows of the scratch."""
    tri = n * (n + 1) // 2
    g, scores = tri + 2 * n, _named_rows(n)
    return {
        "z": (0, n), "from_C": (n, rows - n), "C": (n, tri), "m": (tri + n, n), "g": (g, n), "from_g": (g, rows - g),
        "expected": (g + n, 2), "scores": (scores, 3), "spare": (scores + 1, rows - scores - 1),
        "spare_lags": (rows - na, na), "lag_coefficients": (rows - 2 * na, na),
        "answers": (rows - 2 * na - ANSWERS, ANSWERS),
    }  # fmt: skip


def packed(arrays: Mapping[str, Array], numbers: Mapping[str, int]) -> dict[str, Any]:
    """The fields memory, report and table; sizes are rounded up, so that records of many banks have one type.

    ``numbers`` are those of the table (`layout.NUMBERS`) but for two that the arrays say.
    """
    n, na, table = numbers["n"], numbers["output_lags"], np.zeros((ROWS, 3), int)
    flat: list[list[Array]] = [[], [np.zeros(HEAD)]]
    for name in PACKED:
        array, into = np.ascontiguousarray(arrays[name]), flat[name in REPORTED]
        if into is flat[0]:
            into.append(np.zeros(-sum(part.size for part in into) % WIDTH))  # a cache line begins
        table[ROW[name]] = 8 * sum(part.size for part in into), *(1, *array.shape)[-2:]
        into.append(array.ravel().view(np.float64))
    start, rows, columns = table[ROW["scratch"]]
    for name, (first, count) in windows(n, na, rows).items():
        table[ROW[name]] = start + 8 * first * columns, count, columns
    for name, shape in {**outside(n), "packed": (1, n * n), "report": (1, HEAD)}.items():
        table[ROW[name]] = 0, *shape
    walks = (arrays["maps"][:, (forget.KEEP, forget.RESET, forget.KIND)] == (1.0, 0.0, 0.0)).all()
    noises = not arrays["sensors"][:, (VALUE, FROZEN)].any()
    memory, report = (_padded(np.concatenate(parts), least) for parts, least in zip(flat, (8192, 32), strict=True))
    table[MEMORY_AT], table[REPORT_AT] = (0, 1, len(memory)), (0, 1, len(report))
    for name, value in {**numbers, "walks_only": walks, "plain": numbers["plain"] and walks and noises}.items():
        table[ROW[name], 0] = value
    return {"memory": memory, "report": report, "table": table, "flat": np.zeros(1)}


def _room(parents: int, Hd: int, Hm: int) -> tuple[int, int]:
    """Columns for leaves and for their children, with room for SIMD vectors that begin at every block of them."""
    blocks = (parents, parents * Hd, parents * Hd * Hm)
    up = [_whole_vectors(size) for size in blocks]
    most = max(blocks[2] - size + room for size, room in zip(blocks, up, strict=True))
    return up[0], _whole_vectors(most)


def _whole_vectors(size: int) -> int:
    """The next multiple of the width of a SIMD vector."""
    return -(-size // WIDTH) * WIDTH


def _padded(x: Array, least: int) -> Array:
    """The array, extended with zeros to one of a few sizes."""
    size = least
    while size < len(x):
        size *= 2
    return np.concatenate([x, np.zeros(size - len(x))])
