"""Dynamic model averaging: one prediction from several structures, with weights that change over time.

    w_k(t | t-1)  proportional to  w_k(t-1)^a                        forgetting: structures may change, a just below 1
    w_k(t)        proportional to  w_k(t | t-1) p_k(y_t)              the density of the sample under structure k

so that log w_k(t) = a log w_k(t-1) + log p_k(y_t) up to a constant that is common to all: an exponentially weighted sum
of log-likelihoods. The averaged prediction is the mean of the mixture, and its variance that of the mixture. A sample
that one structure cannot predict changes no weights: nothing is learned or forgotten. The weight of a
regressor is that of all structures that contain it.

Source: Raftery, Karny and Ettler (2010), Technometrics 52(1), equations 15 to 17. Cost: O(T K).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy import signal, special

from driftfit.engine.kernel import Array

if TYPE_CHECKING:
    from driftfit.judge.structures.candidates import Candidate, Predicted


class Average(NamedTuple):
    """The average of K structures over T samples."""

    y_hat: Array
    """(T,): NaN if a structure has no prediction."""
    std: Array
    """(T,): standard deviation of the prediction error."""
    weights: Array
    """(T, K): before each sample; they add up to 1."""
    names: tuple[str, ...]
    """(K,): the structures."""
    inclusion: Array
    """(T, N): weight of the structures that contain a regressor."""
    regressors: tuple[str, ...]
    """(N,): the regressors; empty if structures are not made of the same regressors."""
    loglik: float
    """Log-likelihood of the mixture, on the scored samples."""
    rms: float
    """Root mean square error on the scored samples."""


def averaged(
    structures: list[Candidate], predictions: list[Predicted], y: Array, scored: Array, forgetting: float,
    regressors: tuple[str, ...],
) -> Average:  # fmt: skip
    """Average predictions; ``scored`` (T,) marks the samples that count."""
    terms = np.stack([p.loglik for p in predictions], axis=1)
    known = np.isfinite(terms).all(axis=1)
    counted = terms[known]
    steps = counted - counted.max(axis=1, keepdims=True)
    total = np.concatenate([np.zeros((1, terms.shape[1])), signal.lfilter([1.0], [1.0, -forgetting], steps, axis=0)])
    before = forgetting * total[np.cumsum(known) - known]
    log_weights = special.log_softmax(before, axis=1)
    weights = np.exp(log_weights)
    y_k, s_k = (np.stack([getattr(p, name) for p in predictions], axis=1) for name in ("y_hat", "s"))
    y_hat = np.sum(weights * y_k, axis=1)
    var = np.sum(weights * (s_k + (y_k - y_hat[:, None]) ** 2), axis=1)
    mixture = special.logsumexp(log_weights + np.where(known[:, None], terms, 0.0), axis=1)
    has = np.zeros((len(structures), len(regressors)))
    for k, structure in enumerate(structures):
        has[k, list(structure.columns or ())] = 1.0
    judged = scored & known
    error = (y - y_hat)[judged]
    return Average(
        y_hat, np.sqrt(var), weights, tuple(s.name for s in structures), weights @ has, regressors,
        float(np.sum(mixture[judged])), float(np.sqrt(np.mean(error * error))) if len(error) else float("nan"),
    )  # fmt: skip
