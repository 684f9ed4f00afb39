"""Judgement of a structure: predictions of the tracker and of constants mixed as they go, and effects in plain units.

With p_1 and p_2 the densities of a reading under the tracker and under recursive least squares on the same regressors,

    w_t  proportional to  (1 - s) w_(t-1) p_k(y_(t-1)) + s / 2,        y_hat = sum_k w_k y_hat_k

so that a record of constants costs no more than a few nats, and a change is followed (Herbster and Warmuth, 1998). All
predictions are made before the sample, one step or h steps ahead; those h ahead are given the inputs.
"""

from __future__ import annotations

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.identify.result import Effect, Errors, Memory, Move
from driftfit.identify.structure import Structure, filled, lagged
from driftfit.identify.working_point import regressors
from driftfit.judge.compare import persistence
from driftfit.judge.verdict import Verdict
from driftfit.run.result import Track, burn_in, root_mean_square

SHARED = 0.01
"""Share of the weight that the other prediction gets before each sample."""
FOUND = 6.7
"""Standard errors of a coefficient that a change half-way must have to be found in four of five records: the error of
the difference of both halves is twice as large, times 2.8 for a test at 5 %, times 1.2 since the date is not known."""
NAMES = ("driftfit", "tracked", "constants", "constant ARX", "persistence")


def recursive(phi: Array, y: Array, used: Array) -> Array:
    """(T, n): least squares of y (T,) on phi (T, n) from the ``used`` samples before each one."""
    n, scale = phi.shape[1], np.sqrt(np.nanmean(phi**2, axis=0))
    scale[~(scale > 0.0)] = 1.0
    Z = np.where(used[:, None], phi / scale, 0.0)
    A = np.cumsum(Z[:, :, None] * Z[:, None, :], axis=0)
    b = np.cumsum(Z * np.where(used, y, 0.0)[:, None], axis=0)
    theta = np.full(phi.shape, np.nan)
    theta[1:] = np.linalg.solve(A[:-1] + 1e-8 * np.eye(n), b[:-1, :, None])[..., 0] / scale
    theta[np.cumsum(used) - used < n] = np.nan
    return theta


def mixed(first: Array, second: Array, y: Array, std: Array | None, late: int) -> Array:
    """The weight (T,) of the first of two predictions of y, from readings at least ``late`` samples before.

    ``std``: standard deviation of the first; None, and for the second: that of its errors so far.
    """
    e1, e2 = y - first, y - second
    known = np.isfinite(e1) & np.isfinite(e2)
    spread = [np.where(known, e, 0.0) ** 2 for e in (e1, e2)]
    v1, v2 = ((np.cumsum(one) - one + 1e-300) / np.maximum(np.cumsum(known) - known, 1) for one in spread)
    v1 = v1 if std is None else np.where(np.isfinite(std) & (std > 0.0), std, np.nan) ** 2
    with np.errstate(over="ignore", invalid="ignore"):
        gain = 0.5 * (e2**2 / v2 + np.log(v2) - e1**2 / v1 - np.log(v1))
    usable = known & np.isfinite(gain) & (np.cumsum(known) > 10)
    weight, w = np.full(len(y), 0.5), 0.5
    for t, ratio in enumerate(np.exp(np.clip(np.where(usable, gain, 0.0), -50.0, 50.0)).tolist()):
        weight[t] = w
        w = (1.0 - SHARED) * w * ratio / (w * ratio + 1.0 - w) + 0.5 * SHARED
    return np.concatenate([np.full(late - 1, 0.5), weight[: len(y) - late + 1]])


def ahead(theta: Array, y: Array, drive: Array, na: int, h: int) -> Array:
    """Predictions (T,) of every output from theta (T, n) known h samples before; ``drive`` (T, n - 1 - na) is given.

    theta[t] is what is known before sample t, so sample t + h - 1 is predicted from it.
    """
    past, T = filled(y), len(y)
    made: list[Array] = []
    for s in range(h):
        lags = [made[s - i] if s >= i else lagged(past, i - s) for i in range(1, na + 1)]
        ahead_drive = np.concatenate([drive[s:], np.full((s, drive.shape[1]), np.nan)])
        columns = np.column_stack([np.ones(T), *lags, ahead_drive])
        made.append(np.einsum("tn,tn->t", theta, columns))
    return lagged(made[-1], h - 1)


def errors_of(run: Track, place: Array, y: Array, U: Array, structure: Structure, horizon: int) -> tuple[Errors, ...]:
    """Errors one step and ``horizon`` steps ahead on the grid; ``place``: where the samples of the run are in it."""
    T, n, y = len(y), run.model.n, np.where(np.isfinite(y), y, np.nan)
    phi, order = regressors(y, U, structure), [n - 1, *range(n - 1)]
    prediction, std, tracked = np.full(T, np.nan), np.full(T, np.nan), np.full((T, n), np.nan)
    prediction[place], std[place] = run.prediction, run.innovation_std
    tracked[place] = run.theta[:, order]
    last = np.maximum.accumulate(np.where(np.isfinite(tracked[:, 0]), np.arange(T), 0))
    before = np.concatenate([np.full((1, n), np.nan), tracked[last][:-1]])
    used = np.zeros(T, bool)
    used[place] = run.ok
    used &= np.isfinite(phi).all(axis=1) & np.isfinite(y)
    steady = recursive(phi, y, used)
    small = Structure(2, {j: (1, 1) for j in structure.lags})
    lags = regressors(y, U, small)
    arx = recursive(lags, y, used & np.isfinite(lags).all(axis=1))
    found = []
    for h in sorted({1, horizon}):
        own = prediction if h == 1 else ahead(before, y, phi[:, 1 + structure.na :], structure.na, h)
        rest = ahead(steady, y, phi[:, 1 + structure.na :], structure.na, h)
        share = mixed(own, rest, np.where(used, y, np.nan), std if h == 1 else None, h)
        each = [share * own + (1.0 - share) * rest, own, rest, ahead(arx, y, lags[:, 3:], 2, h)]
        errors = [y - one for one in (*each, lagged(persistence(y), h - 1))]
        scored = used & (np.cumsum(used) > min(burn_in(n), used.sum() // 4)) & np.isfinite(errors).all(axis=0)
        rms = {name: root_mean_square(e[scored]) for name, e in zip(NAMES, errors, strict=True)}
        found.append(Errors(h, rms, int(scored.sum())))
    return tuple(found)


def least_squares(phi: Array, y: Array) -> tuple[Array, Array]:
    """Coefficients (n,) and their covariance (n, n), from the complete rows."""
    rows = np.isfinite(phi).all(axis=1) & np.isfinite(y)
    X, z = phi[rows], y[rows]
    theta = np.linalg.lstsq(X, z, rcond=None)[0]
    e = z - X @ theta
    variance = float(e @ e) / max(len(z) - len(theta), 1)
    return theta, variance * np.linalg.pinv(X.T @ X)


def effects(
    phi: Array, y: Array, structure: Structure, names: tuple[str, ...]
) -> tuple[Array, Memory, tuple[Effect, ...]]:
    """Constants theta (n,), the intercept first; the memory of y; the effects of the inputs."""
    theta, cov = least_squares(phi, y)
    na, at, found = structure.na, 1 + structure.na, []
    memory = Memory(float(theta[1:at].sum()), float(np.sqrt(cov[1:at, 1:at].sum())))
    rest = 1.0 if memory.root else 1.0 - memory.value
    for j, nb, _ in structure.shape[1]:
        own = np.zeros(len(theta))
        own[at : at + nb], at = 1.0, at + nb
        slope, b, least = own / rest, float(own @ theta), FOUND * float(np.sqrt(own @ cov @ own)) / abs(rest)
        slope[1 : 1 + na] = 0.0 if memory.root else b / rest**2
        found.append(Effect(names[j], b / rest, float(np.sqrt(slope @ cov @ slope)), least))
    return theta, memory, tuple(found)


def moves(verdict: Verdict, run: Track, theta: Array, root: bool) -> tuple[Move, ...]:
    """The events of a verdict as changes of effects; ``theta`` (n,) are constants, the intercept first.

    The level is that at mean inputs, and is left out where it moves with others by less than an error of predictions:
    an effect that changes turns the plane about the origin. With a ``root`` effects are those in a sample.
    """
    names, text, found = run.model.names, run.time_text, []
    mean = dict(zip(run.model.input_names, np.nanmean(run.u, axis=0), strict=True)) if run.model.input_names else {}

    def value(what: str, of: dict[str, float]) -> float:
        memory = sum(of[name] for name in names if _what(name) == "memory")
        if what == "memory":
            return memory
        inputs = sum(of[name] * mean[_what(name)] for name in names if _what(name) in mean)
        own = of["intercept"] + inputs if what == "level" else sum(of[name] for name in names if _what(name) == what)
        return float(own if root or memory >= 1.0 else own / (1.0 - memory))

    now = dict(zip(names, [*theta[1:], theta[0]], strict=True))
    for event in reversed(verdict.events):
        now |= {move.name: move.before for move in event.moves}
    for event in verdict.events:
        after = now | {move.name: move.after for move in event.moves}
        instead = tuple(dict.fromkeys(_what(name) for move in event.moves for name in move.instead))
        ends = (event.when, event.ended) if event.until is not None else (text(event.earliest), text(event.latest))
        touched = {_what(move.name) for move in event.moves}
        for what in sorted(touched, key=lambda what: (what in ("memory", "level"), what)):
            values = value(what, now), value(what, after)
            if what != "level" or len(touched) == 1 or abs(values[1] - values[0]) > verdict.rms:
                found.append(Move(what, event.kind, *values, *ends, event.at, instead))
        now = now if event.kind == "temporary" else after
    return tuple(found)


def _what(name: str) -> str:
    """The effect that a parameter belongs to: the name of an input, "memory" or "level"."""
    return name.split("[", 1)[1][:-1] if "[" in name else "level" if name == "intercept" else "memory"


def feedback(y: Array, u: Array) -> float:
    """F statistic of three lags of y in a regression of u on three lags of itself and of y: over 5 is feedback."""
    own = [lagged(filled(u), k) for k in (1, 2, 3)]
    past = [lagged(filled(y), k) for k in (1, 2, 3)]
    X = np.column_stack([np.ones(len(y)), *own, *past])
    rows = np.isfinite(X).all(axis=1) & np.isfinite(u)
    X, z = X[rows], u[rows]
    if len(z) < 60 or np.ptp(z) == 0.0:
        return 0.0
    full, less = (z - A @ np.linalg.lstsq(A, z, rcond=None)[0] for A in (X, X[:, :4]))
    return float((less @ less - full @ full) / 3.0 / max(full @ full / (len(z) - 7), 1e-300))
