"""The random walk that the bank has estimated, given the whole record.

    w_t(i) = f_t(i) sum_j T_ij w_{t+1}(j) / sum_h f_t(h) T_hj         probability of mode i at t, given all samples
    q_t    = sum_k w_t(k) q_tk,    1 / r_t = sum_j nu_tj / v_tj

with f_t the probabilities after sample t, T their transitions, and nu_tj those of the states of the noise after the
sample. A smoother of that random walk (`driftfit.smooth.exact`) estimates theta from all samples, on the regressors
and outputs from which coloured noise was taken. Of learned drift in one direction the variances count, not the
covariances. Before the filters start nothing drifts.

Source: the backward pass is Kim's (1994), eq. 2.20; smoothing one random walk given its result, instead of one for each
mode, is ours.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from driftfit.engine.kernel import Array, State, kernel
from driftfit.trackers.parts.mixture.filters import FLOOR
from driftfit.trackers.parts.mixture.modes import FIRST_ALONE, FIRST_LEARNED

SMOOTHER_FIELDS = (
    "mu", "prior", "kappa", "r", "certainty", "ratio", "c", "drift_unit", "offset", "weight", "direction", "white",
    "explained", "settled", "constant",
)  # fmt: skip
"""Fields that are stored at every sample."""


@kernel
def store_for_smoother(o: State, s: State, l: int) -> None:
    """Store the fields of the smoother."""
    for k in range(s.mu.shape[0]):
        o.mu[k, l], o.prior[k, l], o.ratio[k, l] = s.mu[k, l], s.prior[k, l], s.ratio[k, l]
    for i in range(s.c.shape[0]):
        o.c[i, l], o.drift_unit[i, l], o.offset[i, l] = s.c[i, l], s.drift_unit[i, l], s.offset[i, l]
        o.weight[i, l], o.direction[i, l], o.white[i, l] = s.weight[i, l], s.direction[i, l], s.white[i, l]
    o.kappa[l], o.r[l], o.certainty[l], o.explained[l] = s.kappa[l], s.r[l], s.certainty[l], s.explained[l]
    o.settled[l], o.constant[l] = s.settled[l], s.constant[l]


def transitions(state: Mapping[str, Any]) -> tuple[Array, Array]:
    """Transitions (K, K) of the modes as A + kappa B, from the fields of a bank."""
    up, down, foot, arrive = state["up"], state["down"], state["foot"], state["arrive"]
    A = np.diag(1.0 - down - foot) + np.diag(down[1:], -1)
    A[:, 0] += foot
    B = np.diag(-arrive.sum() - up) + np.diag(up[:-1], 1) + arrive
    return A, B


def modes_given_all(fields: Mapping[str, Array], used: Array, state: Mapping[str, Any]) -> Array:
    """Probabilities (T, K) of the modes, given all samples; ``used`` (T,) are those that changed them."""
    after, ahead = np.where(used[:, None], fields["mu"], fields["prior"]), fields["prior"]
    (A, B), found = transitions(state), after.copy()
    for t in range(len(found) - 2, -1, -1):
        later = found[t + 1] / np.maximum(ahead[t], 1e-300)
        found[t] = after[t] * (A @ later + fields["kappa"][t] * (B @ later)) if used[t] else found[t + 1]
        found[t] /= max(found[t].sum(), 1e-300)
    return found


def estimated_variances(
    fields: Mapping[str, Array], phi: Array, time: Array, state: Mapping[str, Any]
) -> tuple[Array, Array, Array, Array]:
    """q (T, n), that of the drift about the means, the matrix A (n, n) for which phi A are the regressors less their
    means, and r (T,) of every sample, from the stored fields (T, ..), the regressors (N, n) of used samples and the
    intervals of drift.
    """
    running = fields["settled"] > 0
    used = running & (fields["certainty"] > 0.0)
    r = np.where(running, fields["r"], fields["r"][np.argmax(running)])
    size = modes_given_all(fields, used, state) * fields["ratio"] * (r * time)[:, None]
    centred = fields["offset"] != 0.0
    learned = size[:, FIRST_LEARNED:FIRST_ALONE].sum(axis=1)
    common = (size[:, :FIRST_LEARNED].sum(axis=1) + FLOOR * learned)[:, None] * fields["drift_unit"]
    own = learned[:, None] * (fields["weight"] + fields["direction"] ** 2)
    for i, first in enumerate(state["alone"]):
        if first >= 0:
            own[:, i] += size[:, first : first + state["rungs"]].sum(axis=1)
    c = np.where(fields["c"] > 0.0, fields["c"], np.inf)
    drifts = (running & (time > 0.0))[:, None]
    q = np.where(drifts, own / c + np.where(centred, 0.0, common), 0.0)
    about = np.where(drifts & centred, common, 0.0)
    A, constant = np.eye(phi.shape[1]), int(fields["constant"][-1])
    if constant >= 0 and centred.any():
        mean = phi.mean(axis=0)
        A[constant] = np.where(centred.any(axis=0), -mean / mean[constant], 0.0)
        A[constant, constant] = 1.0
    return q, about, A, 1.0 / np.where(used, fields["certainty"], 1.0 / r)
