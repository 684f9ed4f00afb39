"""Judgement of a structure: predictions of the tracker and of constants mixed as they go, and effects in plain units.

With e_1 and e_2 the errors of the tracker and of recursive least squares on the same regressors, and v the mean square
of the better so far,

    p_i = exp(-e_i^2 / 20 v),   w_t = s + (1 - 2 s) w_(t-1) p_1 / (w_(t-1) p_1 + (1 - w_(t-1)) p_2),
    y_hat = w y_hat_1 + (1 - w) y_hat_2

so that a record of constants costs little, and a change is followed (Herbster and Warmuth, 1998). With one v for both,
they are weighed by what is reported, squared errors. exp(-e^2 / 2 B^2) is concave in predictions with errors up to B,
so the average of both may be used (Kivinen and Warmuth, 1999); B^2 = 10 v is three deviations. Errors need a bound, so
each prediction stays within the outputs so far, widened by their range. All predictions are made before the sample;
those h steps ahead are given the inputs, and weighed by what is known then.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from typing import NamedTuple

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.identify.roles import NoAnswerError
from driftfit.identify.structure import Pool, Shape
from driftfit.judge.changes.null import Lags
from driftfit.judge.changes.words import Event
from driftfit.judge.compare import persistence
from driftfit.judge.evidence import Evidence
from driftfit.judge.regressors import Rows
from driftfit.judge.statistics.paired import LEAST
from driftfit.judge.statistics.robust import SMALL, pseudo_inverse
from driftfit.run.result import Track, root_mean_square
from driftfit.use.simulate import moved, steps_ahead

SHARE = 0.001
"""Probability that the other of two predictions is the better one from the next sample on."""
FOUND = 6.7
"""Standard errors of a coefficient that a change half-way must have to be found with 80 % probability: the error of
the difference of both halves is twice as large, times 2.8 for a test at 5 %, times 1.2 since the date is not known."""


class Errors(NamedTuple):
    """Root mean square errors ``steps`` ahead, by method, on ``samples`` samples."""

    steps: int
    rms: dict[str, float]
    samples: int


class Effect(NamedTuple):
    """The effect of an input with constants: in the long run, sum b / (1 - sum a), or in a sample, sum b, with a unit
    root; without inputs the level. Its standard error; the change half-way that is found with 80 % probability.
    """

    name: str
    gain: float
    std: float
    least: float


class Memory(NamedTuple):
    """Sum of the lags of y with its standard error; ``root``: whether it may be 1, which is underestimated: the 5 %
    point of Dickey and Fuller (1979) with an intercept.
    """

    value: float
    std: float

    @property
    def root(self) -> bool:
        return self.value + 2.86 * self.std >= 1.0


class Move(NamedTuple):
    """What an event did to one effect: the static gain of an input, or of a ``bent`` one the standard deviation; the
    ``memory`` (sum of a) or the ``level``. It was over at the sample ``end``.
    """

    what: str
    kind: str
    before: float
    after: float
    first: str
    last: str
    at: int
    end: int
    instead: tuple[str, ...]
    bent: bool = False


def bounded(y: Array, errors: Array, h: int) -> Array:
    """Errors (.., T) of predictions that stay within the outputs up to h steps ago, widened by their range."""
    past = moved(y, h)
    low, high = np.fmin.accumulate(past), np.fmax.accumulate(past)
    return np.asarray(y - np.clip(y - errors, 2.0 * low - high, 2.0 * high - low))


def mixed(errors: Array, h: int) -> Array:
    """Errors (T,) of the mixture of two `bounded` predictions h steps ahead, from their errors (2, T)."""
    known = np.isfinite(errors).all(axis=0).astype(float)
    squares = np.where(known > 0.0, errors**2, 0.0)
    before, count = np.cumsum(squares, axis=1) - squares, np.cumsum(known) - known
    v = np.maximum(before.min(axis=0) / np.maximum(count, 1), SMALL)
    with np.errstate(over="ignore"):
        worse = np.exp(np.where(count > LEAST, (squares[0] - squares[1]) / (20.0 * v), 0.0))
    weights = [0.5] * h
    for ratio in worse.tolist():
        w = weights[-1]
        weights.append(SHARE + (1.0 - 2.0 * SHARE) / (1.0 + (1.0 - w) / w * ratio))
    share = np.array(weights[: errors.shape[1]])
    return np.asarray(share * errors[0] + (1.0 - share) * errors[1])


def errors_of(known: Evidence, horizon: int) -> tuple[Errors, ...]:
    """Errors one step and ``horizon`` steps ahead of a run and of simpler predictions."""
    run, own, steady, found = known.run, known.errors, known.steady, []
    y, na = run.used_record.y, run.model.output_lags or 0
    fits = {
        "tracked": (own.tracked, run.theta, steady, na),
        "constants": (own.constant_ls, steady["theta"][..., 0], steady, na),
        "constant ARX": (own.constant_arx, own.arx["theta"][..., 0], own.arx, 2),
    }
    for h in dict.fromkeys((1, horizon)):
        errors = {}
        for name, (e, theta, fit, lags) in fits.items():
            phi = np.where(fit["valid"] > 0.0, fit["phi"][..., 0], np.nan)
            errors[name] = bounded(y, e if h == 1 else y - steps_ahead(moved(theta, 1), phi, lags, h), h)
        errors["persistence"] = y - moved(persistence(y), h - 1)
        errors = {"driftfit": mixed(np.stack([errors["tracked"], errors["constants"]]), h), **errors}
        at = own.scored & np.isfinite([*errors.values()]).all(axis=0)
        found.append(Errors(h, {name: root_mean_square(e[at]) for name, e in errors.items()}, int(at.sum())))
    return tuple(found)


def _what(name: str) -> str:
    """The effect that a parameter belongs to: the name of an input, "memory" or "level"."""
    return name.split("[", 1)[1][:-1] if "[" in name else "level" if name == "intercept" else "memory"


def parts(run: Track) -> dict[str, Array]:
    """The factors of the parameters (n,) of a run in every effect: an input is the sum of its lags, the memory that of
    the lags of the output, and the level that at mean inputs."""
    of = [_what(name) for name in run.model.names]
    found = {what: np.array([own == what for own in of], float) for what in ("memory", "level", *run.model.input_names)}
    found["level"] += sum(np.nanmean(run.u[:, j]) * found[name] for j, name in enumerate(run.model.input_names))
    return found


def effects(known: Evidence) -> tuple[Memory, tuple[Effect, ...]]:
    """The memory of y, and the effects of the inputs."""
    phi, y, own = known.rows.phi, known.rows.y, parts(known.run)
    inverse = pseudo_inverse(phi)
    theta = inverse @ y
    s2, lags = np.sum((y - phi @ theta) ** 2) / max(len(y) - len(theta), 1), own["memory"]
    cov = inverse @ inverse.T * s2
    memory, found = Memory(float(lags @ theta), float(np.sqrt(lags @ cov @ lags))), []
    rest = 1.0 if memory.root else 1.0 - memory.value
    for name in known.run.model.input_names or ("level",):
        gain = float(own[name] @ theta) / rest
        slope = own[name] / rest + (0.0 if memory.root else gain / rest * lags)
        std, alone = (float(np.sqrt(one @ cov @ one)) for one in (slope, own[name] / rest))
        name, least = (known.run.labels.y, std) if name == "level" else (name, alone)  # a level is that of all lags
        found.append(Effect(name, gain, std, FOUND * least))
    return memory, tuple(found)


def moves(happened: Sequence[Event], run: Track, rows: Rows, curve: Sequence[str], root: bool) -> tuple[Move, ...]:
    """Events of ``rows`` as changes of effects; ``curve`` are the names of columns behind those of the model.

    The level is that at mean inputs, and is left out where it moves with others by less than an error of constants: an
    effect that changes turns the plane about the origin. With a ``root`` effects are those in a sample. Of an effect
    that is a curve this is the standard deviation.
    """
    names, text, found = [*run.model.names, *curve], run.time_text, []
    of, bent = np.array([_what(name) for name in names]), {_what(name) for name in curve}
    means = {"level": np.mean(rows.phi[:, run.model.n :], axis=0)}
    own = {what: np.append(x, means.get(what, 0.0 * means["level"])) for what, x in parts(run).items()}
    theta = pseudo_inverse(rows.phi) @ rows.y
    rms = root_mean_square(rows.y - rows.phi @ theta)

    def value(what: str, theta: Array) -> float:
        memory = own["memory"] @ theta
        rest = 1.0 if what == "memory" or root or memory >= 1.0 else 1.0 - memory
        mine = of == what
        return float((np.std(rows.phi[:, mine] @ theta[mine]) if what in bent else own[what] @ theta) / rest)

    def changed(theta: Array, to: dict[str, float]) -> Array:
        return np.array([to.get(name, theta[i]) for i, name in enumerate(names)])

    for event in reversed(happened):
        theta = changed(theta, {move.name: move.before for move in event.moves})
    for event in happened:
        after = changed(theta, {move.name: move.after for move in event.moves})
        instead = tuple(dict.fromkeys(_what(name) for move in event.moves for name in move.instead))
        ends = (event.when, event.ended) if event.until is not None else (text(event.earliest), text(event.latest))
        touched, end = {_what(move.name) for move in event.moves}, event.until or event.latest
        for what in sorted(touched, key=lambda what: (what in ("memory", "level"), what)):
            values = value(what, theta), value(what, after)
            if what != "level" or len(touched) == 1 or abs(values[1] - values[0]) > rms:
                found.append(Move(what, event.kind, *values, *ends, event.at, end, instead, what in bent))
        theta = theta if event.kind == "temporary" else after
    return tuple(found)


def with_lags(rows: Rows, y: Array, U: Array, place: Array, shape: Shape) -> Rows:
    """Rows of a run with the regressors of another structure, where these are known on the grid; see `Roles.spread`."""
    at, (na, inputs) = place[rows.at], shape
    lags = [moved(y, k + 1) for k in range(na)]
    each = [moved(U[:, j], k) for j, nb, nk in inputs for k in range(nk, nk + nb)]
    phi = np.column_stack([*lags, *each, np.ones(len(y))])[at]
    found = rows._replace(phi=phi, lags=None).only(np.isfinite(phi).all(axis=1), range(phi.shape[1]))
    at, root = place[found.at], np.broadcast_to(np.asarray(found.root, float), found.y.shape)
    row = np.full(len(y), -1)
    row[at] = np.arange(len(at))
    source = row[at[:, None] - np.arange(1, na + 1)]
    lagged = Lags(np.arange(na), source, root[:, None] / np.where(source < 0, 1.0, root[source])) if na else None
    return found._replace(phi=found.phi * root[:, None], lags=lagged)


def feedback(y: Array, u: Array) -> bool:
    """Whether y (T,) acts on an input u (T,): three lags of y beside three of u are worth their price."""
    with suppress(NoAnswerError):  # too few rows to tell
        pool = Pool(u, y[:, None], 3, 1, 3)
        pool.scores.refer(pool.columns((3, ())))
        return pool.value((3, ((0, 3, 1),))) > pool.value((3, ()))
    return False
