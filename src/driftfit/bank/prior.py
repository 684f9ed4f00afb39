"""Prior probabilities of events: independent, or a Markov chain with P[from, to].

The joint event of a change i and a sensor j is e = i H_m + j. The chains are independent a priori: P = kron(P_c, P_s).

Probabilities of changes that are not given are learned. They have a Dirichlet distribution with the mean

    p_i = c_i / sum c,    c_i <- a_i + (1 - 1 / memory) (c_i - a_i) + p(change i at the oldest remembered level | data)

so that c_i is the expected number of changes i, and all leaves have the same prior. A few changes of sizes that are
powers of ten apart then learn the size, too, as a distribution over these. The sum begins with `memory.SAMPLES`, and
the expectations are those of the leaves, given all samples since, as many as the reduction remembers. A gap counts as
many samples.

Source: Smith and Makov (1978), quasi-Bayes; Krishnamurthy and Moore (1993) for counts at a fixed lag; Jilkov and Li
(2004) for Markov jump systems. Departures: forgetting; the sizes. Cost: O(H^2) per sample.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from driftfit.bank.change import RARELY, Change
from driftfit.bank.sensor import Sensor
from driftfit.engine.kernel import Array

TOLERANCE = 1e-10


def open_prior(changes: Sequence[Change], transition: Any, Hm: int) -> bool:
    """Whether the probabilities of the changes are to be learned: neither they nor a chain of changes are given."""
    if len(changes) == 1 or any(one.prob is not None for one in changes):
        return False
    found = _chains("Bank", transition, len(changes), Hm)
    return not isinstance(found, np.ndarray) and found[0] is None


def shares(owner: str, what: str, given: Sequence[Any]) -> Array:
    """Prior probabilities (k,) as given; one None is replaced by the remainder. Changes that are all None are learned,
    and begin with `RARELY` for all but the first.
    """
    if what == "changes" and len(given) > 1 and all(one.prob is None for one in given):
        return np.asarray([1.0 - RARELY, *[RARELY / (len(given) - 1)] * (len(given) - 1)])
    open_ones = [i for i, one in enumerate(given) if one.prob is None]
    p = np.array([0.0 if one.prob is None else one.prob for one in given])
    if len(open_ones) > 1:
        raise ValueError(f"{owner}: only one of the {what} may leave prob= open; {len(open_ones)} do.")
    if open_ones:
        p[open_ones[0]] = 1.0 - p.sum()
    if p.min() < -TOLERANCE or abs(p.sum() - 1.0) > TOLERANCE:
        listed = ", ".join("open" if one.prob is None else f"{one.prob:g}" for one in given)
        raise ValueError(f"{owner}: prior probabilities of {what} must sum to 1; got {listed}. Leave one of them open.")
    p = np.maximum(p, 0.0)
    return np.asarray(p / p.sum())


def rows(owner: str, P: Any, size: int, what: str) -> Array:
    """A transition matrix P[from, to], checked."""
    matrix = np.asarray(P, dtype=float)
    if matrix.shape != (size, size):
        raise ValueError(f"{owner}: transition of {what} must be ({size}, {size}); got shape {matrix.shape}.")
    inside = np.isfinite(matrix).all() and matrix.min() >= 0.0 and matrix.max() <= 1.0
    if not inside:
        raise ValueError(f"{owner}: transition probabilities must be within [0, 1]; got {P!r}.")
    if np.abs(matrix.sum(axis=1) - 1.0).max() > TOLERANCE:
        columns = np.abs(matrix.sum(axis=0) - 1.0).max() <= TOLERANCE
        hint = "its columns do: it is P[to, from], give its transpose" if columns else f"got {matrix.sum(axis=1)}"
        raise ValueError(f"{owner}: rows of the transition of {what}, P[from, to], must sum to 1; {hint}.")
    return np.asarray(matrix / matrix.sum(axis=1, keepdims=True))


def stationary(P: Array) -> Array:
    """The stationary distribution of P."""
    size = len(P)
    system = np.vstack([P.T - np.eye(size), np.ones(size)])
    p: Array = np.linalg.lstsq(system, np.r_[np.zeros(size), 1.0], rcond=None)[0]
    p = np.maximum(p, 0.0)
    return np.asarray(p / p.sum())


def events(
    owner: str, changes: Sequence[Change], sensors: Sequence[Sensor], transition: Any, initial: Any
) -> tuple[Array, Array]:
    """(P, initial) of the joint events.

    ``transition`` is None (independent), the matrix of the changes, of the sensors if there is only one change, of
    the joint events, or a pair (changes, sensors) in which None is independent.
    """
    found = _chains(owner, transition, len(changes), len(sensors))
    if isinstance(found, np.ndarray):
        return found, _initial(owner, initial, found)
    parts, starts = [], []
    given: Sequence[Any]
    for what, given, chain in zip(("changes", "sensors"), (changes, sensors), found, strict=True):
        if chain is None:
            starts.append(shares(owner, what, given))
            parts.append(np.tile(starts[-1], (len(given), 1)))
        else:
            parts.append(rows(owner, chain, len(given), what))
            starts.append(stationary(parts[-1]))
    P = np.kron(*parts)
    return P, np.kron(*starts) if initial is None else _initial(owner, initial, P)


def _chains(owner: str, transition: Any, Hd: int, Hm: int) -> Any:
    """The joint matrix, or a pair of matrices in which None is independent."""
    if transition is None:
        return None, None
    pair = isinstance(transition, tuple | list) and len(transition) == 2 and (
        any(part is None for part in transition) or all(np.ndim(part) == 2 for part in transition)
    )  # fmt: skip
    if pair:
        return tuple(transition)
    try:
        shape = np.shape(transition)
    except ValueError:
        shape = ()
    sizes = {(Hd, Hd): (transition, None), (Hm, Hm): (None, transition)} if Hd == 1 else {(Hd, Hd): (transition, None)}
    if shape == (Hd * Hm, Hd * Hm) and Hm > 1 and Hd > 1:
        return rows(owner, transition, Hd * Hm, "joint events")
    if shape in sizes:
        return sizes[shape]
    raise ValueError(
        f"{owner}: transition has shape {shape}; give ({Hd}, {Hd}) for the changes, ({Hd * Hm}, {Hd * Hm}) for the "
        f"joint events, or a pair of ({Hd}, {Hd}) and ({Hm}, {Hm})."
    )


def _initial(owner: str, initial: Any, P: Array) -> Array:
    if initial is None:
        return stationary(P)
    p = np.asarray(initial, dtype=float)
    if p.shape != (len(P),) or p.min() < 0.0 or abs(p.sum() - 1.0) > TOLERANCE:
        raise ValueError(f"{owner}: initial must be {len(P)} probabilities that sum to 1; got {initial!r}.")
    return np.asarray(p / p.sum())


def chains(owner: str, P: Array, T: int, Hd: int) -> Array:
    """Chains of the changes P[t, from, to], (T, H_d H_d), checked; where one is NaN the bank's own prior applies."""
    if P.shape != (T, Hd, Hd):
        raise ValueError(f"{owner}: prob of a chain must be ({T}, {Hd}, {Hd}), P[sample, from, to]; got {P.shape}.")
    return _probabilities(owner, "rows of a chain", P).reshape(T, Hd * Hd)


def per_sample(owner: str, p: Array, usual: Array, Hd: int) -> Array:
    """Priors (T, H) of joint events from those of joint events or from (T, H_d) of changes; rows of NaN are kept.

    ``usual`` (H,) applies where no prior is given.
    """
    Hm = len(usual) // Hd
    if p.shape[1] == Hd and Hm > 1:
        p = np.einsum("ti,j->tij", p, usual.reshape(Hd, Hm).sum(axis=0)).reshape(len(p), -1)
    if p.shape[1] != Hd * Hm:
        raise ValueError(
            f"{owner}: prob must have {Hd} columns (changes) or {Hd * Hm} (joint events); got {p.shape[1]}."
        )
    return _probabilities(owner, "prob", p)


def _probabilities(owner: str, what: str, p: Array) -> Array:
    """p[t, .., k], checked: probabilities over k that sum to 1, or NaN for all of a sample."""
    each = p.reshape(len(p), -1)
    fits = (each >= 0.0).all(axis=1) & (np.abs(p.sum(axis=-1) - 1.0) < 1e-8).reshape(len(p), -1).all(axis=1)
    if (wrong := ~fits & ~np.isnan(each).all(axis=1)).any():
        t = int(np.argmax(wrong))
        raise ValueError(f"{owner}: {what} must be probabilities that sum to 1; at sample {t} it is {p[t]}.")
    return p
