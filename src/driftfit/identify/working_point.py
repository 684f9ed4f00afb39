"""Time or working point: do the parameters depend on when, or on where the plant is operated?

Four regressions predict the record, each block from those that its memory holds (`driftfit.identify.scores`):

    constants            y = phi' theta
    tracked              y = phi' theta_t
    a curve, constant    y = phi' theta + sum c_i z_i
    both                 y = phi' theta_t + sum c_it z_i

z_i are regressors times signals, x w, and hinges, (x - q)+ and x (w - q)+, at quartiles q. The signals w are the
inputs, chosen or not, the last output, and the mean of the last twenty. They are added one by one while the score rises
by more than one nat and the logarithm of their number. A curve that the plant passes through once cannot be told from
time: both then predict as well.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.identify.scores import MEMORIES, Scores, lead
from driftfit.identify.structure import Structure, filled
from driftfit.use.simulate import moved

SLOW = 20
"""Samples in the mean of the last outputs."""
CLEAR = 3.0
"""Nats by which one description must lead another: -log of a level of 5 %."""


@dataclass(frozen=True)
class Cause:
    """What explains the record: leads over constants in nats, less the logarithm of the number of products for each
    that is used, with their standard errors.

    ``products``: what the curve is made of, in words; none where no curve leads. ``of``: a name for each column that
    ends with the input that it bends, in brackets.
    """

    tracked: tuple[float, float]
    curve: tuple[float, float]
    joint: tuple[float, float]
    products: tuple[str, ...]
    of: tuple[str, ...]
    columns: Array
    """(N, k): the products."""

    def kind(self, moves: bool) -> str:
        """ "time", "working point", "both" or "": ``moves`` is whether constants, with the curve, are rejected."""
        if not self.products:
            return "time" if moves else ""
        if not moves:
            return "working point" if self.joint[0] - self.curve[0] <= CLEAR else "time"
        return "both" if self.joint[0] - self.tracked[0] > CLEAR else "time"


def cause(phi: Array, y: Array, Z: Array, made: list[tuple[str, str]]) -> Cause:
    """Compare the four descriptions of y (N,) on phi (N, n), the constant last, and `products` Z (N, q)."""
    X = np.column_stack([phi[:, -1], phi[:, :-1], Z])
    rows, base = np.isfinite(X).all(axis=1), list(range(phi.shape[1]))
    steady, moving = (Scores(X[rows], y[rows], memories) for memories in (MEMORIES[:1], MEMORIES))
    moving.refer(base)
    steady.floor = moving.floor
    price, bent = float(np.log(max(len(made), 1))), list(base)
    while len(bent) < X.shape[1] and (added := steady.added(bent)).max() > steady.score(bent) + price + 1.0:
        bent.append(int(np.argmax(added)))
    constants, chosen = steady.terms(base), [one - len(base) for one in bent[len(base) :]]
    (curve, one), (joint, other) = (lead(scores.terms(bent), constants) for scores in (steady, moving))
    price *= len(chosen)
    leads = lead(moving.terms(base), constants), (curve - price, one), (joint - price, other)
    words = tuple(dict.fromkeys(made[one][0] for one in chosen))
    of = tuple(f"{k}{made[one][1]}" for k, one in enumerate(chosen))
    return Cause(*leads, words, of, Z[:, chosen])


def products(
    y: Array, U: Array, structure: Structure, names: tuple[str, ...], output: str, first: int
) -> tuple[Array, list[tuple[str, str]]]:
    """(T, q) products of signals on a grid; for each its words, and "[input]", or "" for a lag of the output."""
    past, inputs = filled(y), [filled(u) for u in U.T]
    slow = np.convolve(np.where(np.isfinite(past), past, np.nanmean(past)), np.full(SLOW, 1.0 / SLOW))[: len(y)]
    slow[: SLOW - 1] = np.nan
    signals = [(f"{output}, the last", moved(past, 1)), (f"the level of {output}", moved(slow, 1))]
    signals += [(names[i], moved(x, first)) for i, x in enumerate(inputs)]
    xs = [(names[j], f"[{names[j]}]", moved(inputs[j], k))
          for j, nb, nk in structure.shape[1] for k in range(nk, nk + nb)]  # fmt: skip
    xs += [(output, "", moved(past, 1))] if structure.na else []
    made = [(f"a bend of {name} at {q:.3g}", of, np.maximum(x - q, 0.0))
            for name, of, x in xs for q in np.nanquantile(x, (0.25, 0.5, 0.75))]  # fmt: skip
    made += [(f"{name} times {other}", of, x * bend)
             for name, of, x in xs for other, w in signals if not np.array_equal(w, x, equal_nan=True)
             for bend in (w - np.nanmedian(w), np.maximum(w - np.nanmedian(w), 0.0))]  # fmt: skip
    return np.stack([np.zeros(len(y)), *(z for *_, z in made)], axis=1)[:, 1:], [(text, of) for text, of, _ in made]
