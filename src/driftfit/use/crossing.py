"""First passage: when will a parameter, or the output, cross a limit?

At time T a parameter that is a random walk has the distribution N(m, P), and its variance grows by q per sample. With c
the distance of m from the limit and V = h q, reflection gives the probability that it has crossed by sample T + h,

    F(h) = Phi(-B) + 2 T(B, sqrt(V / P)),   B = c / sqrt(P + V),   T: Owen's function

At h = 0 this is Phi(-c / sqrt(P)), the probability that it is beyond the limit already, and for P = 0 it is
2 Phi(-c / sqrt(V)). It is exact for a path that also moves between samples (a path that is observed once per sample
crosses a little later, as if the limit were 0.58 sqrt(q) farther away). q is the covariance that the tracker itself
adds in one nominal sample after the end, so an estimated drift (`AdaptiveKalman`) is taken at its last value, and with
a tracker without drift the parameter can only be beyond the limit already.

If the slope is a random walk, ``FLS(differences=2)``, if parameters have laws, and for the output, paths are drawn
from the covariance of the state at T and continued: theta moves, noise is drawn, and each output is fed back as a lag.
F is then the share of paths that have crossed, with a standard error of at most 0.5 / sqrt(DRAWS). The output is the
measured one, including its noise; for the level behind it ask for the parameter.

F grows more and more slowly, so a limit may well not be crossed within the horizon: ``probability`` is F there, and
quantiles beyond it are infinite. Parameters of a `Bank` jump and are not random walks, so an error is raised for them.

Source: Karatzas and Shreve, Brownian Motion and Stochastic Calculus (1991), section 2.8 (reflection); Owen (1956).
Cost: O(horizon), times DRAWS if paths are drawn.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy

from driftfit.data.arguments import inputs_for
from driftfit.data.clock import Clock
from driftfit.data.record import time_text
from driftfit.engine.drivers import one_or_all
from driftfit.engine.kernel import Array
from driftfit.engine.settings import near, of_series, whole
from driftfit.engine.tiles import as_compiled
from driftfit.run.live.conformal import quantile
from driftfit.run.program import state_of
from driftfit.run.result import Track
from driftfit.trackers.laws.law import OWNER, VISIBLE, transition
from driftfit.use.simulate import noise_at, within

if TYPE_CHECKING:
    import polars

DRAWS = 2000


@dataclass(frozen=True)
class Crossing:
    """When something crosses a limit, counted in nominal samples after the end of the record.

    Attributes
    ----------
    name, limit, side
        Which quantity crosses which limit, and whether it is then "below" or "above" it.
    probability : float
        Probability that it crosses within ``horizon`` samples.
    median, low, high : float
        Median of the time of the crossing, and the interval that contains it with probability ``level``: the first
        sample by which its distribution reaches 1/2, (1 - level) / 2, (1 + level) / 2. 0 is the end of the record, and
        inf is beyond the horizon.
    by : (horizon + 1,)
        Probability that it has crossed by the end of the record, by the sample after it, and so on.
    times : (horizon,) or None
        The times of those samples, if the record has times that are not only labels.
    """

    name: str
    limit: float
    side: str
    level: float
    horizon: int
    by: Array
    times: Array | None
    zone: str | None = None

    @property
    def probability(self) -> float:
        return float(self.by[-1])

    @property
    def median(self) -> float:
        return self.quantile(0.5)

    @property
    def low(self) -> float:
        return self.quantile(0.5 - self.level / 2.0)

    @property
    def high(self) -> float:
        return self.quantile(0.5 + self.level / 2.0)

    def quantile(self, p: float) -> float:
        """The first sample by which the probability of having crossed reaches p; inf beyond the horizon."""
        reached = np.flatnonzero(self.by >= p)
        return float(reached[0]) if len(reached) else float("inf")

    def time(self, samples: float) -> Any:
        """The time that many samples after the end; None at the end, beyond the horizon, and without times."""
        within = self.times is not None and 1.0 <= samples <= self.horizon
        return self.times[int(samples) - 1] if within and self.times is not None else None

    def __str__(self) -> str:
        def shown(samples: float) -> str:
            time = self.time(samples)
            text = f"{samples:g}" if np.isfinite(samples) else "later"
            return text if time is None else f"{text} ({time_text(time, self.zone)})"

        when = f"median {shown(self.median)}, {100 * self.level:g} % from {shown(self.low)} to {shown(self.high)}"
        what = f"{self.name} {self.side} {self.limit:g} within {self.horizon} samples"
        return f"{what}: probability {self.probability:.2f}; {when}"


def crossing(
    run: Track, what: str, *, below: float | None = None, above: float | None = None, horizon: int | None = None,
    u: Any = None, level: float = 0.9,
) -> Crossing:  # fmt: skip
    """When a parameter, or the output, crosses a limit after the end of a record.

    Parameters
    ----------
    run : Track
        The record, of a tracker with a covariance.
    what : str
        Name of a parameter, or of the output ("y", or its column) for models that can be run forward.
    below, above : number
        The limit; give one of the two.
    horizon : int or None
        Number of nominal samples to look ahead. None: as many as the record, or ``u``, has.
    u : (horizon,), (horizon, m) or None
        Future inputs, for the output.
    level : number in (0, 1)
        Level of the interval.

    Raises
    ------
    ValueError
        For an unknown name, not exactly one limit, a tracker without a covariance, a `Bank`, a parameter that is not
        determined yet, or missing inputs.
    """
    limit, side = _limit(below, above)
    quantile(level, "crossing")  # whether there is one
    if not run.tracker.covariance or run.tracker.weighs:
        why = "jumps between hypotheses, which is no random walk" if run.tracker.weighs else "carries no covariance"
        raise ValueError(f"crossing: {type(run.tracker).__name__} {why}; track with Kalman, AdaptiveKalman or FLS.")
    sign = -1.0 if side == "below" else 1.0
    if what in run.names:
        h = len(run) if horizon is None else whole("crossing", "horizon", horizon, 1)
        place = run.names.index(what)
        lane = state_of(run.program.resting(run.state))
        if "law" not in lane:
            within("crossing", run)
        way = _along_laws if "law" in lane else _along_slopes if "slope" in lane else _reflected
        by = way(run, lane, place, sign, limit, h)
    elif what in ("y", run.labels.y):
        within("crossing", run)
        h = len(u) if horizon is None and u is not None else len(run) if horizon is None else horizon
        by = _of_output(run, sign, limit, whole("crossing", "horizon", h, 1), u)
    else:
        raise ValueError(f"crossing: there is no {what!r}; {near(str(what), (*run.names, run.labels.y))}")
    return Crossing(what, limit, side, level, h, by, _times(run, h), run.labels.zone)


def _times(run: Track, h: int) -> Array | None:
    """The times of the h samples after a record that has times which are not only labels."""
    return Clock.of(run.labels.dt, run.labels.zone).ahead(run.last, h) if run.timed else None


class UndeterminedError(ValueError):
    """A record that does not determine what a crossing depends on."""


def _limit(below: float | None, above: float | None) -> tuple[float, str]:
    if (below is None) == (above is None):
        raise ValueError("crossing: give one limit, below= or above=.")
    limit, side = (below, "below") if below is not None else (above, "above")
    if limit is None or not np.isfinite(limit):
        raise ValueError(f"crossing: {side}={limit!r} is not finite.")
    return float(limit), side


def _known(run: Track, cov: Array, place: int | None = None) -> Array:
    """A covariance; ValueError if a parameter that it belongs to is not determined yet."""
    if not np.isfinite(cov if place is None else cov[place, place]).all():
        raise UndeterminedError("crossing: a parameter that it needs is not determined yet: its std is infinite.")
    return cov


def _covariances(run: Track) -> tuple[Array, Array]:
    """(covariance of theta at the end, its increase in a nominal sample without an observation), (n, n) each."""
    tile = run.program.resting(run.state)
    lane = state_of(tile)
    update = run.program.drivers().updater(tile, run.model.m)
    now = run.tracker.cov(lane).copy()
    update(as_compiled(tile), np.nan, one_or_all(np.full(run.model.m, np.nan)))
    with np.errstate(invalid="ignore"):
        return now, run.tracker.cov(lane) - now


def _reflected(run: Track, lane: Mapping[str, Array], place: int, sign: float, limit: float, h: int) -> Array:
    """F by reflection, (h + 1,)."""
    P, q = (float(part[place, place]) for part in _covariances(run))
    _known(run, np.array([[P]]))
    V = max(q, 0.0) * np.arange(h + 1)
    c = sign * (limit - float(lane["theta"][place]))
    with np.errstate(divide="ignore", invalid="ignore"):
        B, ratio = c / np.sqrt(P + V), np.sqrt(V / P)
    B = np.where(P + V > 0.0, B, np.inf if c > 0.0 else -np.inf)
    F = scipy.special.ndtr(-B) + 2.0 * scipy.special.owens_t(B, np.where(np.isnan(ratio), 0.0, ratio))
    return np.asarray(np.clip(F, 0.0, 1.0))


def _along_slopes(run: Track, lane: Mapping[str, Array], place: int, sign: float, limit: float, h: int) -> Array:
    """F from paths of level and slope: slope += w, level += slope; (h + 1,)."""
    n, scale = len(run.names), float(lane["scale"])
    both = np.ix_([place, n + place], [place, n + place])
    full = np.tril(lane["P"]) + np.tril(lane["P"], -1).T
    cov = _known(run, full[both] * scale)
    mean = [float(lane["theta"][place]), float(lane["slope"][place])]
    spread = float(lane["q"][place]) * scale
    return _share(mean, cov, np.array([[1.0, 1.0], [0.0, 1.0]]), np.full((2, 2), spread), sign, limit, h)


def _along_laws(run: Track, lane: Mapping[str, Array], place: int, sign: float, limit: float, h: int) -> Array:
    """F from paths of the components of the parameter, (h + 1,)."""
    _known(run, np.array([[run.std[-1, place]]]))
    own = lane["law"][OWNER] == place
    law, move = lane["law"][:, own], np.ix_(own, own)
    F, Q = transition(law, 1.0)
    return _share(lane["x"][own], lane["C"][move], F, Q, sign, limit, h, law[VISIBLE])


def _share(
    mean: Any, cov: Array, F: Array, Q: Array, sign: float, limit: float, h: int, shown: Any = (1.0, 0.0)
) -> Array:
    """The share of paths of shown' x that have crossed by each sample, (h + 1,): x <- F x + w, w ~ N(0, Q)."""
    rng = np.random.default_rng(0)
    x = rng.multivariate_normal(mean, cov, DRAWS, method="eigh")
    values, vectors = np.linalg.eigh(Q)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    beyond, by = np.zeros(DRAWS, dtype=bool), np.empty(h + 1)
    for k in range(h + 1):
        if k:
            x = x @ F.T + rng.normal(size=x.shape) @ root.T
        beyond |= sign * (x @ np.asarray(shown) - limit) >= 0.0
        by[k] = beyond.mean()
    return by


def _of_output(run: Track, sign: float, limit: float, h: int, u: Any) -> Array:
    """F from paths of the output, (h + 1,); at the end of the record itself no output is beyond the limit."""
    model = run.model
    if u is None and model.m:
        raise ValueError(
            f"crossing: the output depends on {model.m} inputs; give their future values, u= ({h}, {model.m})."
        )
    if run.tracker.output_error or "slope" in run.state:
        raise ValueError("crossing: for the output the parameters must be random walks; ask for a parameter.")
    p, rng = model.reach, np.random.default_rng(0)
    r = noise_at(run, -1)
    now, q = _covariances(run)
    later = np.zeros((h, 0)) if u is None else inputs_for(model, u, h)
    inputs = np.concatenate([run.u[len(run) - p :], later])
    past = np.tile(run.y[len(run) - p :], (DRAWS, 1))
    if not np.isfinite(later).all():
        raise ValueError("crossing: the future inputs must be known.")
    if not (np.isfinite(inputs).all() and np.isfinite(past).all()):
        raise UndeterminedError("crossing: the last samples must be known, because lags contain them.")
    zero = np.zeros(len(now))
    theta = run.theta[-1] + rng.multivariate_normal(zero, _known(run, now), DRAWS, method="eigh")
    values, vectors = np.linalg.eigh(q)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    by, beyond = np.zeros(h + 1), np.zeros(DRAWS, dtype=bool)
    for k in range(h):
        theta = theta + rng.normal(size=theta.shape) @ root.T
        noise = np.sqrt(r) * rng.normal(size=(DRAWS, 1))
        with np.errstate(over="ignore", invalid="ignore"):  # an unstable system that was drawn ends in inf
            y = model.play(theta, past, inputs[None, k : k + p + 1], noise, (-np.inf, np.inf))
        past = np.concatenate([past, y], axis=1)[:, 1:]
        beyond |= sign * (y[:, 0] - limit) >= 0.0
        by[k + 1] = beyond.mean()
    return by


def crossings(
    runs: Mapping[Hashable, Track], by: tuple[str, ...], what: str, below: Any, above: Any, horizon: int | None,
    u: Any, level: float,
) -> polars.DataFrame:  # fmt: skip
    """A table of the crossings of many runs, earliest first; limits and u are the same for all, or given by key.

    A run that does not determine its crossing has NaN, and is the last.
    """
    import polars

    from driftfit.data.instants import in_zone

    for name, given in (("below", below), ("above", above), ("u", u)):
        of_series("crossing", name, given, runs, every=name != "u")
    rows: list[dict[str, Any]] = []
    times: dict[str, list[Any]] = {}
    for key, run in runs.items():
        low, high = (one[key] if isinstance(one, Mapping) else one for one in (below, above))
        future = u.get(key) if isinstance(u, Mapping) else u
        row = dict(zip(by, key if isinstance(key, tuple) else (key,), strict=True))
        try:
            found = crossing(run, what, below=low, above=high, horizon=horizon, u=future, level=level)
        except UndeterminedError:
            found = None
        rows.append(row | {name: getattr(found, name, np.nan) for name in ("probability", "median", "low", "high")})
        if (next_one := _times(run, 1)) is not None:
            nothing = np.array("NaT", next_one.dtype) if next_one.dtype.kind == "M" else np.nan
            for name in ("median", "low", "high"):
                time = None if found is None else found.time(rows[-1][name])
                times.setdefault(f"{name}_time", []).append(nothing if time is None else time)
    table = polars.DataFrame(rows, infer_schema_length=None)
    zone = next((run.labels.zone for run in runs.values()), None)
    for name, values in times.items():
        place = table.columns.index(name.removesuffix("_time")) + 1
        table = in_zone(table.insert_column(place, polars.Series(name, np.array(values))), name, zone)
    return table.sort(["median", "probability"], descending=[False, True])
