"""A bank in the coordinates of its start: for offsets that a covariance cannot represent, and unknown directions.

The compiled routine is given x and z in place of phi and theta (`driftfit.trackers.forms.coordinates`) and needs no
other change. With R = M^-1 on what is determined, and its columns orthogonal to what is not, changes are

    random walk     C + M (Q_i + diag(sizes_i r / c)) M'
    reset           to z0 = M theta0; of some parameters by the map M D R, D with zeros for these
    stabilised      measurements by the rows of W R

while exponential and directional forgetting are the same in z as in theta; a direction without information stays as it
is. A leaf with output lags of its own has x + R' d, d the difference of these lags from those of the record.

A regressor outside the span of the earlier ones, or with far more information on z_j than they had, makes z_j a
coordinate in every leaf; it changes no weight:

    y = sum_{i<j} x_i z_i + z_j + v,     where z_j was sum_{k>=j} x_k z_k / x_j before, or unknown

With the gain K = C x / s of the coordinates as they were, s = x'C x + r, the errors after the sample are those of

    w_i - K_i (x'w + v)  for i != j,        rho = (1 - x'K) x'w - x'K v,  1 - x'K = r / s,  for x'z

and so, with the covariance C of the former, z_j = x'z - sum_{i<j} x_i z_i has

    C_jb = cov(rho, b) - sum_{i<j} x_i C_ib,      C_jj = var(rho) - sum_{i<j} x_i (cov(rho, i) + C_ji)

No difference of large numbers is left in them, however large x_j^2 C_jj is compared with r. If nothing was known of
z_j, s is infinite: K is 0 for the other coordinates, x'K is 1, and x_i z_i with i > j, which leaves with output lags
of their own have, is no part of z_j. The mixture and the covariances of the gap, which leaves share, are updated in the
same way, with the gain of the mixture.

A bank begins this way if its start is not determined well enough for a covariance when the first residuals are
available, and continues this way, M being the identity at first, from a sample with far more information than its
prior; other banks use phi and theta, at lower cost. Cost per sample: O(n^3) for each change.

Source: ours; the limit is that of Durbin and Koopman, Time Series Analysis by State Space Methods (2012), section 5.2.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from driftfit.bank.layout import COUNTER, OUTPUT_LAGS, SAMPLE
from driftfit.bank.leaves.forget import ANCHORS, GROWTH, KIND, MEAN, PARTIAL, PER_CAP
from driftfit.bank.leaves.leaf_matrix import FIRST
from driftfit.engine.kernel import Array, State, kernel, shared
from driftfit.trackers.forms.coordinates import (
    OUTGROWN,
    frame,
    in_units_of_theta,
    located_within,
    unseen_variance,
)
from driftfit.trackers.forms.covariance import LEFT
from driftfit.trackers.forms.diffuse import ENTERING, NOISE, OK, SIZE, STD, Y

K, G = SIZE, STD
"""Rows of ``work`` here: the gain, and a covariance times the regressor."""


@kernel
def place(i: int, j: int) -> int:
    """Where entry (i, j) is in a lower triangle."""
    return i * (i + 1) // 2 + j if j <= i else j * (j + 1) // 2 + i


@shared
def product(C: Array, x: Array, work: Array, row: int) -> float:
    """C x in ``work[row]`` for a lower triangle C; returns x'C x."""
    h = 0.0
    for a in range(len(x)):
        work[row, a] = 0.0
        for b in range(len(x)):
            work[row, a] += C[place(a, b)] * x[b]
        h += x[a] * work[row, a]
    return h


@shared
def gain_of(C: Array, x: Array, noise: float, known: bool, work: Array) -> float:
    """K = C x / s in ``work[K]``; returns 1 - x'K = noise / s. Both are 0 if s is infinite (not ``known``) or only
    rounding.
    """
    h = product(C, x, work, K)
    share = 1.0 / (h + noise) if known and h > 0.0 else 0.0
    for a in range(len(x)):
        work[K, a] *= share
    return noise * share


@shared
def enter_covariance(C: Array, x: Array, now: Array, noise: float, left: float, work: Array) -> None:
    """The covariance of (I - K x') w - K v, for w with the covariance C and v with variance ``noise``; x'K = 1 - left.
    z_j becomes sum_{k>=j} x_k z_k: its error is that of x'z without those of z_i, i < j.
    """
    n, j, sign, k = len(x), int(now[ENTERING]), now[OK], 0
    others = j if left > 0.0 else n
    h = product(C, x, work, G)
    for a in range(n):
        for b in range(a + 1):
            change = work[K, a] * work[K, b] * (h + noise) - work[K, a] * work[G, b] - work[G, a] * work[K, b]
            C[k] = max(C[k] + change, LEFT * C[k]) if a == b else C[k] + change
            k += 1
    own = left * left * h + (1.0 - left) ** 2 * noise
    for b in range(n):
        if b != j:
            shared_error = left * (work[G, b] - work[K, b] * h) + (1.0 - left) * noise * work[K, b]
            row = shared_error
            for i in range(others):
                row -= x[i] * C[place(i, b)]
            if b < others:
                own -= x[b] * (row + shared_error)
            C[place(j, b)] = sign * row
    C[place(j, j)] = own


@shared
def enter_mean(m: Array, x: Array, now: Array, left: float, work: Array) -> None:
    """The mean of the same: m + K e, and m_j from the part of the reading that neither z_i, i < j, nor v explains."""
    j, e = int(now[ENTERING]), now[Y]
    for i in range(len(x)):
        e -= x[i] * m[i]
    rest = now[Y] - left * e
    for i in range(len(x)):
        m[i] += work[K, i] * e
    for i in range(j if left > 0.0 else len(x)):
        rest -= x[i] * m[i]
    m[j] = now[OK] * rest


@shared
def enter_leaves(t: Any, known: bool) -> None:
    """The sample in all leaves; each has its own gain, and its own regressor if it has output lags of its own."""
    n, x, now, work, noise = t.n, t.phi[::1], t.at_start, t.work, t.at_start[NOISE]
    for l in range(t.many_leaves):
        own = t.z[:, l] if t.output_lags > 0 else x
        m, C = t.leaves[FIRST : FIRST + n, l], t.leaves[FIRST + n : FIRST + n + n * (n + 1) // 2, l]
        left = gain_of(C, own, noise, known, work)
        enter_mean(m, own, now, left, work)
        enter_covariance(C, own, now, noise, left, work)
    t.places[PER_CAP, int(now[ENTERING])] = 1.0 / (GROWTH * noise)


@shared
def enter_gap(t: Any, left: float) -> None:
    """The covariances of the gap, with the gain that is in ``work``: leaves share them."""
    x, now, work = t.phi[::1], t.at_start, t.work
    for i in range(1, len(t.gap)):
        enter_covariance(t.gap[i, ::1], x, now, 0.0, left, work)
    for i in range(2 * len(t.prior), len(t.path) - 1):
        enter_covariance(t.path[i, ::1], x, now, 0.0, left, work)


@shared
def enter_mixture(t: Any, known: bool) -> float:
    """The sample in the mixture, whose covariance is packed meanwhile; its gain stays in ``work``."""
    n, P, C, x, now, work, noise = t.n, t.cov, t.packed[::1], t.phi[::1], t.at_start, t.work, t.at_start[NOISE] * t.unit
    for i in range(n):
        for j in range(i + 1):
            C[place(i, j)] = P[i, j]
    left = gain_of(C, x, noise, known, work)
    enter_mean(t.theta[::1], x, now, left, work)
    enter_covariance(C, x, now, noise, left, work)
    for i in range(n):
        for j in range(i + 1):
            P[i, j] = C[place(i, j)]
    return float(left)


@shared
def enter(t: Any, known: bool) -> None:
    """A sample with which a coordinate enters, of which nothing was known before if not ``known``."""
    enter_gap(t, enter_mixture(t, known))
    enter_leaves(t, known)


@shared
def walk(t: Any, i: int) -> None:
    """M (Q + diag(sizes unit / c)) M' of change i, in the unit of covariances."""
    n, S, W, c, fixed, sizes, unit = t.n, t.S, t.W, t.c, t.fixed_walks, t.relative_walks, 1.0 if t.unknown > 0 else t.r
    for a in range(n):
        for b in range(n):
            total = 0.0
            for k in range(a, n):
                q = fixed[i, place(k, b)]
                if k == b and sizes.shape[1] > 0 and c[k] > 0.0:
                    q += sizes[i, k] * unit / c[k]
                total += S[a, k] * q
            W[a, b] = total
    for a in range(n):
        for b in range(a + 1):
            total = 0.0
            for k in range(b, n):
                total += W[a, k] * S[b, k]
            t.walks[i, place(a, b)] = total


@shared
def seen_inverse(S: Array, R: Array, H: Array, W: Array) -> None:
    """W = R without the directions H that no sample has determined: the theta nearest to theta0 for each z."""
    n = len(S)
    for k in range(n):
        for i in range(n):
            W[i, k] = R[i, k] if S[k, k] > 0.0 and i <= k else 0.0
        for j in range(n):
            dot = 0.0
            for i in range(n if S[j, j] == 0.0 else 0):
                dot += H[i, j] * W[i, k]
            for i in range(n if dot != 0.0 else 0):
                W[i, k] -= dot * H[i, j]


@shared
def pulled(t: Any) -> None:
    """theta0 and the matrices of resets and of stabilised forgetting in these coordinates; W is `seen_inverse`."""
    n, S, W, to, fixed = t.n, t.S, t.W, t.places, t.fixed_places
    for i in range(n):
        to[MEAN, i] = 0.0
        for j in range(i, n):
            to[MEAN, i] += S[i, j] * fixed[MEAN, j]
    for c in range(len(t.maps) if len(to) > ANCHORS else 0):
        at = ANCHORS + c * n
        for i in range(n):
            for k in range(n):
                to[at + i, k] = 0.0
                for j in range(n):
                    to[at + i, k] += fixed[at + i, j] * W[j, k]
        for i in range(n if int(t.maps[c, KIND]) == PARTIAL else 0):  # the rows from i on are still there
            for k in range(n):
                total = 0.0
                for j in range(i, n):
                    total += S[i, j] * to[at + j, k]
                to[at + i, k] = total


@shared
def write_changes(t: Any) -> None:
    """The changes at the next sample in these coordinates, and the rows of R of the output lags."""
    for i in range(len(t.walks)):
        walk(t, i)
    if t.output_lags > 0 or len(t.places) > ANCHORS:
        seen_inverse(t.S, t.R, t.H, t.W)
    pulled(t)
    for k in range(t.output_lags):
        for i in range(t.n):
            t.lag_rows[k, i] = t.W[k, i]


@kernel
def spans_lags(s: State, l: int) -> bool:
    """Whether what no sample has determined has no part in the output lags that leaves have of their own."""
    n, spans = s.theta.shape[0], True
    for j in range(n):
        for i in range(s.table[OUTPUT_LAGS, 0, l] if s.S[j, j, l] == 0.0 else 0):
            spans = spans and s.R[i, j, l] == 0.0
    return spans


@kernel
def begin_framed(s: State, l: int) -> None:
    """The single leaf with which the bank begins: z ~ N(d, I), in units of the noise variance if that is unknown."""
    n = s.theta.shape[0]
    s.counters[COUNTER.framed, l] = 1
    frame(s, l)
    for i in range(n):
        for j in range(i + 1):
            s.Pz[i, j, l] = 1.0 if i == j and s.S[i, i, l] > 0.0 else 0.0


@kernel
def frame_theta(s: State, l: int) -> None:
    """Continue in coordinates that are theta itself, before a sample with far more information than all earlier."""
    n = s.theta.shape[0]
    for i in range(n):
        s.d[i, l], s.x[i, l] = s.theta[i, l], s.phi[i, l]
        for j in range(n):
            s.S[i, j, l], s.Pz[i, j, l] = 1.0 if i == j else 0.0, s.P[i, j, l]
    s.counters[COUNTER.framed, l] = 1
    frame(s, l)


@kernel
def outgrown(s: State, l: int) -> int:
    """The coordinate whose earlier information a covariance would lose next to that of this sample, or -1: the first
    about which it has `OUTGROWN` times the information of all earlier ones.
    """
    framed, others = s.counters[COUNTER.framed, l] > 0, s.sample[SAMPLE.unit, l] * s.r[l] * s.noise[l]
    for j in range(s.theta.shape[0]):
        x, var = (s.x[j, l], s.Pz[j, j, l]) if framed else (s.phi[j, l], s.P[j, j, l])
        own = x * x * var
        if own > OUTGROWN * others:
            return j
        others += own
    return -1


@kernel
def read_framed(s: State, l: int) -> None:
    """theta and its covariance from the mixture."""
    n = s.theta.shape[0]
    for i in range(n):
        for j in range(i + 1):
            s.P[i, j, l] = s.Pz[i, j, l]
    in_units_of_theta(s, l)
    if s.ok[l] > 0.0:
        located_within(s, l)
    for i in range(n):
        s.var[i, l] = s.P[i, i, l]
    unseen_variance(s, l)


def in_theta(lane: dict[str, Array], means: Array, covs: Array) -> tuple[Array, Array]:
    """Convert means (L, n) and covs (L, n, n) of z to theta; without these coordinates they are returned unchanged."""
    if not lane["counters"][COUNTER.framed]:
        return means, covs
    R = lane["R"]
    return lane["theta"] + (means - lane["d"]) @ R.T, np.asarray(R @ covs @ R.T)
