"""The random walk that the adaptive filters have estimated, given the whole record.

    w_t(i) = f_t(i) sum_j T_ij w_{t+1}(j) / sum_h f_t(h) T_hj         probability of mode i at t, given all samples
    q_t    = sum_k w_t(k) q_tk,    1 / r_t = (1 - o_t) / sum_j w_t(j) v_tj + o_t / max(f_J r, e_t^2)

with f_t the probabilities after sample t and T their transitions, for drift modes and likewise for noise levels v_tj,
and o_t the probability that sample t was an outlier. A smoother of that random walk (`driftfit.smooth.exact`) estimates
theta from all samples, with the averaged drift and noise, on the regressors and outputs from which coloured noise was
taken (`driftfit.trackers.parts.modes.coloured`). Of drift in one direction the variances count, not the covariances.
Before the filters start nothing drifts.

Source: the backward pass is Kim's (1994), eq. 2.20; smoothing one random walk given its result, instead of one for each
mode, is ours.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from driftfit.engine.kernel import Array, State, kernel
from driftfit.trackers.parts.modes.drifts.about_means import STILL, centring
from driftfit.trackers.parts.modes.drifts.one_direction import BESIDE
from driftfit.trackers.parts.modes.ladder import TOP, chain
from driftfit.trackers.parts.modes.noise_levels import level_chain

SMOOTHER_FIELDS = (
    "joint", "prior", "nu", "r", "c", "leverage", "coarse", "alike", "leapt", "weighed", "settled", "weight", "white",
    "explained", "calm", "shift", "direction", "replaced_by", "busy", "variance", "constant", "jumped",
)  # fmt: skip
"""Fields that are stored at every sample."""


@kernel
def store_for_smoother(o: State, s: State, l: int) -> None:
    """Store the fields of the smoother."""
    for k in range(s.prior.shape[0]):
        o.prior[k, l] = s.prior[k, l]
        for j in range(s.joint.shape[0]):
            o.joint[j, k, l] = s.joint[j, k, l]
    for j in range(s.nu.shape[0]):
        o.nu[j, l] = s.nu[j, l]
    for i in range(s.c.shape[0]):
        o.c[i, l] = s.c[i, l]
        o.weight[i, l] = s.weight[i, l]
        o.direction[i, l] = s.direction[i, l]
        o.white[i, l] = s.white[i, l]
        o.variance[i, l] = s.variance[i, l]
        o.jumped[i, l] = s.jumped[i, l]
    o.r[l], o.leverage[l], o.alike[l] = s.r[l], s.leverage[l], s.alike[l]
    o.coarse[l] = s.coarse[l] / s.noise[l]  # in units of the noise factor, as r is
    o.leapt[l], o.weighed[l], o.settled[l], o.explained[l] = s.leapt[l], s.weighed[l], s.settled[l], s.explained[l]
    o.calm[l], o.shift[l] = s.calm[l], s.shift[l]
    o.replaced_by[l], o.busy[l], o.constant[l] = s.replaced_by[l], s.busy[l], s.constant[l]


def given_all(after: Array, ahead: Array, back: Callable[[int, Array], Array], moves: Array, begins: Array) -> Array:
    """Probabilities (T, K) of states, given all samples, from those after each sample and those ``ahead`` of the next.

    ``back(t, x)`` is T x, with the transitions T at a sample that moves. Where the last state but one ``begins``, it
    says nothing about earlier ones.
    """
    found = after.copy()
    for t in range(len(found) - 2, -1, -1):
        later, new = found[t + 1].copy(), 0.0
        if begins[t + 1]:
            later[-2], new = 0.0, later[-2]
        found[t] = after[t] * back(t, later / np.maximum(ahead[t], 1e-300)) if moves[t] else later
        found[t] *= (1.0 - new) / max(found[t].sum(), 1e-300)
        found[t] += new * after[t]
    return found


def jumps(fields: Mapping[str, Array]) -> Array:
    """The samples (T,) at which a filter begins to take an outlier for a jump."""
    return (fields["weighed"] > 0) & fields["jumped"].any(axis=1)


def modes_given_all(fields: Mapping[str, Array], state: Mapping[str, Any]) -> Array:
    """Probabilities (T, K) of the filters, given all samples.

    Before transitions stay + calm_t change, a share of another filter may replace the last one
    (`driftfit.trackers.parts.modes.drifts.at_rest`), and the last but one may begin
    (`driftfit.trackers.parts.modes.drifts.after_outlier`).
    """
    calm, by, weighed = fields["calm"], fields["replaced_by"].astype(int), fields["weighed"] > 0
    over = state["over"][by] / np.append(1.0, fields["busy"][:-1])
    stay, change = chain(state["moves"], state["arrive"])
    ahead = fields["prior"]  # after the interaction, it is that of the next sample
    after = np.where(weighed[:, None], fields["joint"].sum(axis=1), ahead)

    def back(t: int, x: Array) -> Array:
        x = stay @ x + calm[t] * (change @ x)
        if by[t] >= 0:
            x[by[t]], x[-1] = (1.0 - over[t]) * x[by[t]] + over[t] * x[-1], x[by[t]]
        return x

    return given_all(after, ahead, back, weighed, jumps(fields))


def estimated_variances(
    fields: Mapping[str, Array], phi: Array, e: Array, time: Array, state: Mapping[str, Any]
) -> tuple[Array, Array, Array, Array]:
    """q (T, n), that of the drift about the means, the matrix of `centring` for this drift, and r (T,) of every sample,
    from the stored fields (T, ..), the regressors (N, n) of used samples, the innovations and intervals of drift.

    Which column is constant is what the filters knew after the last sample.
    """
    running, weighed = fields["settled"] > 0, fields["weighed"] > 0
    r = np.where(running, fields["r"], fields["r"][np.argmax(running)])
    w, span, learned = modes_given_all(fields, state), r * time, state["learned"]
    along, first = np.zeros(len(learned)), state["first_along"]
    along[first : first + len(state["along"])] = state["along"]
    ratio = np.where((learned > 0.0) | (along > 0.0), 0.0, state["ratio"])
    square = fields["direction"] ** 2
    share = np.where(np.sum(square, axis=1, keepdims=True) > 0.0, BESIDE + square, 1.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        leapt = np.where(weighed, fields["leapt"] / span, 0.0)
        drift = w @ ratio.T + (w @ learned)[:, None] * fields["weight"] + (w @ along)[:, None] * share
        q = (drift + (w[:, TOP] * leapt)[:, None] * ratio[:, TOP]) * span[:, None] / fields["c"]
        first = state["first_about"]
        constant = int(fields["constant"][-1])
        beside = (constant >= 0) & (np.arange(len(state["theta"])) != constant)
        own = np.where(beside, fields["variance"], fields["c"])
        about = ((w[:, first : first + len(state["about"])] @ state["about"]) * span)[:, None] / own
    drifts = running[:, None] & (span[:, None] > 0.0) & (fields["c"] > 0.0)
    q, about = np.where(drifts, q, 0.0), np.where(drifts & (own > STILL * fields["c"]), about, 0.0)
    began = np.where(jumps(fields), w[:, -2], 0.0)
    q += began[:, None] * fields["jumped"]
    nu, steps = fields["nu"][:, :-1], level_chain()
    levels = given_all(nu, nu @ steps, lambda t, x: steps @ x, weighed, np.zeros(len(r), bool))
    v = np.sum(levels * np.maximum(state["level"][:-1] * r[:, None], fields["coarse"][:, None]), axis=1)
    v = np.where(running, v + fields["coarse"] * fields["alike"] * (fields["alike"] + 2.0), r) * fields["leverage"]
    outlier = np.where(weighed, fields["joint"][:, -1].sum(axis=1), 0.0) * (1.0 - began)
    # where a regressor is out of proportion, half of a code's weight would still be more than all other samples have
    outlier = np.where((fields["leverage"] > 1.0) & (outlier > 0.5), 1.0, outlier)
    far = np.maximum(state["level"][-1] * v, np.where(weighed, e * e, 0.0))
    return q, about, centring(phi, constant), 1.0 / ((1.0 - outlier) / v + outlier / far)
