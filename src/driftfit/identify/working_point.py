"""Time or working point: do the parameters depend on when, or on where the plant is operated?

Four regressions predict the record, each block from those that its memory holds (`driftfit.identify.scores`):

    constants            y = phi' theta
    tracked              y = phi' theta_t
    a curve, constant    y = phi' theta + sum c_i z_i
    both                 y = phi' theta_t + sum c_it z_i

z_i are regressors times signals, x w, and hinges, (x - q)+ and x (w - q)+, at quartiles q. The signals w are the
inputs, chosen or not, the last output, and the mean of the last twenty. They are added one by one while the score rises
by more than the logarithm of their number. A curve that the plant passes through once cannot be told from time: both
then predict as well.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.identify.scores import MEMORIES, Scores, lead
from driftfit.identify.structure import Structure, filled, lagged

PRODUCTS = 5
"""Products that a curve may have."""
SLOW = 20
"""Samples in the mean of the last outputs."""
CLEAR = 3.0
"""Nats, and `ERRORS` standard errors, by which one description must lead another."""
ERRORS = 2.0

Lead = tuple[float, float]


@dataclass(frozen=True)
class Cause:
    """What explains the record: ``kind`` is "", "time", "working point" or "both".

    Leads over constants in nats with their standard errors: ``tracked``, ``curve``, ``joint``; ``besides``: the lead of
    both over the curve alone; ``further``: over time alone. ``products``: what the curve is made of, in words.
    ``bent``: the input of which the curve is a static one, or -1.
    """

    kind: str
    tracked: Lead
    curve: Lead
    joint: Lead
    besides: Lead
    further: Lead
    products: tuple[str, ...]
    bent: int
    columns: Array
    """(T, k): the products on the grid."""


def clear(one: Lead) -> bool:
    """Whether a lead is more than chance."""
    return one[0] > max(CLEAR, ERRORS * one[1])


def regressors(y: Array, U: Array, structure: Structure) -> Array:
    """phi (T, n) of a structure on the grid, the constant first."""
    past = [lagged(filled(y), k) for k in range(1, structure.na + 1)]
    drive = [lagged(filled(U[:, j]), k) for j, nb, nk in structure.shape[1] for k in range(nk, nk + nb)]
    return np.column_stack([np.ones(len(y)), *past, *drive])


def cause(y: Array, U: Array, structure: Structure, names: tuple[str, ...], output: str, first: int) -> Cause:
    """Compare the four descriptions of a record on a regular grid."""
    phi = regressors(y, U, structure)
    Z, made = _products(y, U, structure, names, output, first)
    X = np.column_stack([phi, Z])
    rows = np.isfinite(X).all(axis=1) & np.isfinite(y)
    base = list(range(phi.shape[1]))
    steady, moving = (Scores(X[rows], y[rows], memories) for memories in (MEMORIES[:1], MEMORIES))
    steady.floor = moving.floor = moving.refer(base) and moving.floor
    bent, jointly = _chosen(steady, base), _chosen(moving, base)
    constants, tracked = steady.terms(base), moving.terms(base)
    curve = steady.terms(bent)
    joint = max((moving.terms(one) for one in (bent, jointly)), key=np.sum)
    leads = lead(tracked, constants), lead(curve, constants), lead(joint, constants)
    besides, further = lead(joint, curve), lead(joint, tracked)
    bends = clear(leads[1])
    kind = ""
    if bends and not clear(besides):
        kind = "working point"
    elif bends and clear(further) and clear(leads[0]):
        kind = "both"
    elif clear(leads[0]):
        kind = "time"
    chosen = [one - len(base) for one in bent[len(base) :]]
    own = {made[one][1] for one in chosen}
    return Cause(
        kind, *leads, besides, further, tuple(dict.fromkeys(made[one][0] for one in chosen)),
        own.pop() if len(own) == 1 else -1, Z[:, chosen],
    )  # fmt: skip


def _chosen(scores: Scores, base: list[int]) -> list[int]:
    """The columns and the products that a curve needs."""
    chosen, score = list(base), scores.score(base)
    price = np.log(max(scores.p - len(base), 1)) + 1.0
    for _ in range(PRODUCTS):
        added = scores.added(chosen)
        best = int(np.argmax(added))
        if not added[best] > score + price:
            break
        chosen.append(best)
        score = float(added[best])
    return chosen


def _products(
    y: Array, U: Array, structure: Structure, names: tuple[str, ...], output: str, first: int
) -> tuple[Array, list[tuple[str, int]]]:
    """(T, q) products, and for each of them words and the input that is bent, -1 if a product is of two signals."""
    past, inputs = filled(y), [filled(u) for u in U.T]
    total = np.cumsum(np.concatenate([[0.0], np.where(np.isfinite(past), past, np.nanmean(past))]))
    slow = np.full(len(y), np.nan)
    slow[SLOW:] = (total[SLOW:-1] - total[: -SLOW - 1]) / SLOW
    signals = [(f"{output}, the last", lagged(past, 1)), (f"the level of {output}", slow)]
    signals += [(names[i], lagged(x, first)) for i, x in enumerate(inputs)]
    xs = [(names[j], j, lagged(inputs[j], k)) for j, nb, nk in structure.shape[1] for k in range(nk, nk + nb)]
    if structure.na:
        xs.append((output, -1, lagged(past, 1)))
    columns, made = [], []
    for name, j, x in xs:
        for q in np.nanquantile(x, (0.25, 0.5, 0.75)):
            columns.append(np.maximum(x - q, 0.0))
            made.append((f"a bend of {name} at {q:.3g}", j))
        for other, w in signals:
            if np.array_equal(w, x, equal_nan=True):
                continue
            middle = np.nanmedian(w)
            columns += [x * (w - middle), x * np.maximum(w - middle, 0.0)]
            made += [(f"{name} times {other}", -1)] * 2
    return (np.column_stack(columns) if columns else np.zeros((len(y), 0))), made
