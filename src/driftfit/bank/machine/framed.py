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

from collections import namedtuple
from functools import partial

import numpy as np

from driftfit.bank.layout import COUNTER, MEMORY_AT, ROW, ROWS, SAMPLE, memory_at
from driftfit.bank.leaves.forget import ANCHORS, GROWTH, KIND, MEAN, PARTIAL, PER_CAP
from driftfit.bank.leaves.leaf_matrix import FIRST
from driftfit.engine.kernel import Array, State, cubes, floats, kernel, machine, packed, shared, wholes
from driftfit.trackers.forms.coordinates import (
    OUTGROWN,
    frame,
    in_units_of_theta,
    located_within,
    new_row,
    unseen_variance,
)
from driftfit.trackers.forms.covariance import LEFT
from driftfit.trackers.forms.diffuse import ENTERING, NOISE, NOW, OK, SIZE, STD, WORK, Y

K, G = SIZE, STD
"""Rows of ``work`` here: the gain, and a covariance times the regressor."""
_Rows = namedtuple(
    "_Rows",
    "walks fixed_walks relative_walks leaves gap path prior places fixed_places maps z lag_rows output_lags",
)
AT = _Rows(*(ROW[name] for name in _Rows._fields))
"""Rows of the table."""
_Addresses = namedtuple("_Addresses", "memory table counters S W c x d P work now R H")
ADDRESS = _Addresses(*range(13))
"""Addresses of fields that the routines here are given."""


@kernel
def place(i: int, j: int) -> int:
    """Where entry (i, j) is in a lower triangle."""
    return i * (i + 1) // 2 + j if j <= i else j * (j + 1) // 2 + i


@shared
def product(M: Array, at: int, step: int, x: Array, work: Array, row: int) -> float:
    """C x in ``work[row]`` for the C whose lower triangle begins at ``at`` with stride ``step``; returns x'C x."""
    h = 0.0
    for a in range(len(x)):
        work[row, a] = 0.0
        for b in range(len(x)):
            work[row, a] += M[at + place(a, b) * step] * x[b]
        h += x[a] * work[row, a]
    return h


@shared
def gain_of(M: Array, at: int, step: int, x: Array, noise: float, known: int, work: Array) -> float:
    """K = C x / s in ``work[K]`` for the C whose lower triangle begins at ``at`` with stride ``step``; returns
    1 - x'K = noise / s. Both are 0 if s is infinite (``known`` is 0) or only rounding.
    """
    h = product(M, at, step, x, work, K)
    share = 1.0 / (h + noise) if known > 0 and h > 0.0 else 0.0
    for a in range(len(x)):
        work[K, a] *= share
    return noise * share


@shared
def enter_packed(M: Array, at: int, step: int, x: Array, now: Array, noise: float, left: float, work: Array) -> None:
    """The covariance of (I - K x') w - K v, for w with a covariance whose lower triangle begins at ``at`` with stride
    ``step`` and v with variance ``noise``; x'K = 1 - left. z_j becomes sum_{k>=j} x_k z_k: its error is that of x'z
    without those of z_i, i < j.
    """
    n, j, sign = len(x), int(now[ENTERING]), now[OK]
    others = j if left > 0.0 else n
    h = product(M, at, step, x, work, G)
    k = at
    for a in range(n):
        for b in range(a + 1):
            change = work[K, a] * work[K, b] * (h + noise) - work[K, a] * work[G, b] - work[G, a] * work[K, b]
            M[k] = max(M[k] + change, LEFT * M[k]) if a == b else M[k] + change
            k += step
    own = left * left * h + (1.0 - left) ** 2 * noise
    for b in range(n):
        if b != j:
            shared_error = left * (work[G, b] - work[K, b] * h) + (1.0 - left) * noise * work[K, b]
            row = shared_error
            for i in range(others):
                row -= x[i] * M[at + place(i, b) * step]
            if b < others:
                own -= x[b] * (row + shared_error)
            M[at + place(j, b) * step] = sign * row
    M[at + place(j, j) * step] = own


@shared
def enter_mean(m: Array, at: int, step: int, x: Array, now: Array, left: float, work: Array) -> None:
    """The mean of the same: m + K e, and m_j from the part of the reading that neither z_i, i < j, nor v explains."""
    j, e = int(now[ENTERING]), now[Y]
    for i in range(len(x)):
        e -= x[i] * m[at + i * step]
    rest = now[Y] - left * e
    for i in range(len(x)):
        m[at + i * step] += work[K, i] * e
    for i in range(j if left > 0.0 else len(x)):
        rest -= x[i] * m[at + i * step]
    m[at + j * step] = now[OK] * rest


@shared
def walk(M: Array, places: tuple[int, int, int], S: Array, c: Array, unit: float, W: Array) -> None:
    """M (Q + diag(sizes unit / c)) M' of one change; ``places`` are the offsets of the result, of Q, and of the sizes
    (-1: none).
    """
    n = len(S)
    to, fixed, sizes = places
    for a in range(n):
        for b in range(n):
            total = 0.0
            for k in range(a, n):
                q = M[fixed + place(k, b)]
                if k == b and sizes >= 0 and c[k] > 0.0:
                    q += M[sizes + k] * unit / c[k]
                total += S[a, k] * q
            W[a, b] = total
    for a in range(n):
        for b in range(a + 1):
            total = 0.0
            for k in range(b, n):
                total += W[a, k] * S[b, k]
            M[to + a * (a + 1) // 2 + b] = total


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
def pulled(M: Array, t: Array, S: Array, W: Array) -> None:
    """theta0 and the matrices of resets and of stabilised forgetting in these coordinates; W is `seen_inverse`."""
    n = len(S)
    to, fixed, maps = t[3 * AT.places] // 8, t[3 * AT.fixed_places] // 8, t[3 * AT.maps] // 8
    for i in range(n):
        M[to + MEAN * n + i] = 0.0
        for j in range(i, n):
            M[to + MEAN * n + i] += S[i, j] * M[fixed + MEAN * n + j]
    for c in range(t[3 * AT.maps + 1] if t[3 * AT.places + 1] > ANCHORS else 0):
        at, kind = (ANCHORS + c * n) * n, int(M[maps + c * t[3 * AT.maps + 2] + KIND])
        for i in range(n):
            for k in range(n):
                M[to + at + i * n + k] = 0.0
                for j in range(n):
                    M[to + at + i * n + k] += M[fixed + at + i * n + j] * W[j, k]
        for i in range(n if kind == PARTIAL else 0):  # row i of M times the rows from i on, which are still there
            for k in range(n):
                total = 0.0
                for j in range(i, n):
                    total += S[i, j] * M[to + at + j * n + k]
                M[to + at + i * n + k] = total


@shared
def enter_leaves(M: Array, table: Array, many: Array, x: Array, now: Array, known: int, work: Array) -> None:
    """The sample in all leaves; each has its own gain, and its own regressor if it has output lags of its own."""
    n, noise, lags = len(x), now[NOISE], table[3 * AT.output_lags]
    B, columns, z = table[3 * AT.leaves] // 8, table[3 * AT.leaves + 2], table[3 * AT.z] // 8
    wide = table[3 * AT.z + 2]
    for l in range(many[COUNTER.many_leaves]):
        leaf = B + l
        own = M[z + l : z + l + n * wide : wide] if lags > 0 else x
        m, C = leaf + FIRST * columns, leaf + (FIRST + n) * columns
        left = gain_of(M, C, columns, own, noise, known, work)
        enter_mean(M, m, columns, own, now, left, work)
        enter_packed(M, C, columns, own, now, noise, left, work)
    M[table[3 * AT.places] // 8 + PER_CAP * n + int(now[ENTERING])] = 1.0 / (GROWTH * noise)


@shared
def enter_gap(M: Array, table: Array, x: Array, now: Array, left: float, work: Array) -> None:
    """The covariances of the gap, with the gain that is in ``work``: leaves share them."""
    gap, columns = table[3 * AT.gap] // 8, table[3 * AT.gap + 2]
    for i in range(1, table[3 * AT.gap + 1]):
        enter_packed(M, gap + i * columns, 1, x, now, 0.0, left, work)
    path, columns, H = table[3 * AT.path] // 8, table[3 * AT.path + 2], table[3 * AT.prior + 1]
    for i in range(2 * H, table[3 * AT.path + 1] - 1):
        enter_packed(M, path + i * columns, 1, x, now, 0.0, left, work)


@shared
def enter_mixture(z: Array, P: Array, C: Array, x: Array, now: Array, noise: float, known: int, work: Array) -> float:
    """The sample in the mixture, whose covariance is packed in C meanwhile; its gain stays in ``work``."""
    n, k = len(x), 0
    for i in range(n):
        for j in range(i + 1):
            C[k] = P[i, j]
            k += 1
    left = gain_of(C, 0, 1, x, noise, known, work)
    enter_mean(z, 0, 1, x, now, left, work)
    enter_packed(C, 0, 1, x, now, noise, left, work)
    k = 0
    for i in range(n):
        for j in range(i + 1):
            P[i, j] = C[k]
            k += 1
    return left  # type: ignore[no-any-return]


@shared
def write_changes(m: Array, t: Array, S: Array, R: Array, H: Array, W: Array, c: Array, unit: float) -> None:
    """The changes in these coordinates, and the rows of R of the output lags."""
    n, wide, sizes = len(S), t[3 * AT.walks + 2], t[3 * AT.relative_walks + 2]
    for i in range(t[3 * AT.walks + 1]):
        of = t[3 * AT.relative_walks] // 8 + i * sizes if sizes > 0 else -1
        walk(m, (t[3 * AT.walks] // 8 + i * wide, t[3 * AT.fixed_walks] // 8 + i * wide, of), S, c, unit, W)
    if t[3 * AT.output_lags] > 0 or t[3 * AT.places + 1] > ANCHORS:
        seen_inverse(S, R, H, W)
    pulled(m, t, S, W)
    for k in range(t[3 * AT.output_lags]):
        for i in range(n):
            m[t[3 * AT.lag_rows] // 8 + k * (n + 1) + i] = W[k, i]


@partial(machine, short=True)
def machine_framed(fields: int, known: int, unit: float, size: int, counters: int, n: int, L: int, l: int) -> None:
    """For lane l of L, from the addresses of fields: the changes at the next sample, in the unit of covariances, if
    ``known`` is negative; otherwise a sample with which a coordinate enters, of which nothing was known if it is 0. The
    memory has ``size`` numbers.
    """
    at = wholes(fields, 1, len(ADDRESS))[0]
    t, m = wholes(at[ADDRESS.table], 3 * ROWS, L)[:, l], floats(at[ADDRESS.memory], size, L)[:, l]
    W = cubes(at[ADDRESS.W], n, n, L)[:, :, l]
    if known < 0:
        S, R = cubes(at[ADDRESS.S], n, n, L)[:, :, l], cubes(at[ADDRESS.R], n, n, L)[:, :, l]
        H = cubes(at[ADDRESS.H], n, n, L)[:, :, l]
        write_changes(m, t, S, R, H, W, floats(at[ADDRESS.c], n, L)[:, l], unit)
        return
    many, now = wholes(at[ADDRESS.counters], counters, L)[:, l], floats(at[ADDRESS.now], NOW, L)[:, l]
    x, work = floats(at[ADDRESS.x], n, L)[:, l], cubes(at[ADDRESS.work], WORK, n, L)[:, :, l]
    z, P, C = (
        floats(at[ADDRESS.d], n, L)[:, l], cubes(at[ADDRESS.P], n, n, L)[:, :, l], floats(at[ADDRESS.W], n * n, L)[:, l]
    )  # fmt: skip
    left = enter_mixture(z, P, C, x, now, now[NOISE] * unit, known, work)
    enter_gap(m, t, x, now, left, work)
    enter_leaves(m, t, many, x, now, known, work)


@kernel
def call_framed(s: State, known: int, unit: float, l: int) -> None:
    """Call the routine with this lane."""
    n, L = s.d.shape
    # packed here: what a function packs is gone when it returns
    fields = packed((
        memory_at(s), s.table.ctypes.data, s.counters.ctypes.data, s.S.ctypes.data, s.W.ctypes.data,
        s.c.ctypes.data, s.x.ctypes.data, s.d.ctypes.data, s.Pz.ctypes.data, s.work.ctypes.data, s.at_start.ctypes.data,
        s.R.ctypes.data, s.H.ctypes.data,
    ))  # fmt: skip
    machine_framed(fields, known, unit, s.table[MEMORY_AT, 2, l], s.counters.shape[0], n, L, l)


FRAMED = (machine_framed,)
"""What the steps here call, apart from the routines of the coordinates."""


@kernel
def spans_lags(s: State, l: int) -> bool:
    """Whether what no sample has determined has no part in the output lags that leaves have of their own."""
    n, spans = s.theta.shape[0], True
    for j in range(n):
        for i in range(s.table[AT.output_lags, 0, l] if s.S[j, j, l] == 0.0 else 0):
            spans = spans and s.R[i, j, l] == 0.0
    return spans


@kernel
def begin_framed(s: State, l: int) -> None:
    """The single leaf with which the bank begins: z ~ N(d, I), in units of the noise variance if that is unknown."""
    n = s.theta.shape[0]
    s.framed[l] = 1
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
    s.framed[l] = 1
    frame(s, l)


@kernel
def outgrown(s: State, l: int) -> int:
    """The coordinate whose earlier information a covariance would lose next to that of this sample, or -1: the first
    about which it has `OUTGROWN` times the information of all earlier ones.
    """
    framed, others = s.framed[l] > 0, s.sample[SAMPLE.unit, l] * s.r[l] * s.noise[l]
    for j in range(s.theta.shape[0]):
        x, var = (s.x[j, l], s.Pz[j, j, l]) if framed else (s.phi[j, l], s.P[j, j, l])
        own = x * x * var
        if own > OUTGROWN * others:
            return j
        others += own
    return -1


@kernel
def enter_bank(s: State, column: int, l: int) -> None:
    """Row ``column`` of M becomes the rest of this regressor. The compiled routine has made the time update."""
    n = s.theta.shape[0]
    known = 1 if s.S[column, column, l] != 0.0 else 0
    sign = new_row(s, s.phi, column, l)
    noise = s.noise[l] if s.unknown[l] > 0 else s.r[l] * s.noise[l]
    s.at_start[Y, l], s.at_start[NOISE, l], s.at_start[OK, l], s.at_start[ENTERING, l] = s.y[l], noise, sign, column
    call_framed(s, known, s.sample[SAMPLE.unit, l], l)
    for i in range(column, n):
        s.x[i, l] = 0.0


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
    if not lane["framed"]:
        return means, covs
    R = lane["R"]
    return lane["theta"] + (means - lane["d"]) @ R.T, np.asarray(R @ covs @ R.T)
