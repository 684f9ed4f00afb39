"""Drivers: the one loop that runs a model's and a tracker's steps, on records, in fleets and live.

For every sample a driver does, in this order,

    read      y, u, dt into the record
    regress   signals -> phi (model)            clean   what is missing becomes 0 (only here is NaN known)
    predict   what time does (tracker)          correct what the data say (tracker)
    report    s.var, the variance of theta      push    the model's lags
    write     theta, var, y_hat, e, s, ok out of the record

The fields of a record are described in `driftfit.engine.tiles`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numba import types

from driftfit.engine.compile_notice import compiling
from driftfit.engine.kernel import Array, Driver, State, Step, kernel, nothing
from driftfit.engine.outlined import outlined
from driftfit.engine.phases import advancing, learning, looking
from driftfit.engine.tiles import as_compiled, kind_of, tile_type
from driftfit.engine.tracker_part import tracker_part, whole_record

LARGEST = 1e38
"""Signals at least this large are not used: it is about the largest number in single precision."""

SMALLEST = 1e-38
"""Signals below this are zero. Between the two the fourth power of any ratio of signals is a number: no product of a
regressor, a covariance that earlier regressors left, and an innovation overflows."""

INTERVAL, NOISE, DRIFT, COMMON = range(4)
"""Columns of what is known of every sample: nominal intervals since the one before, factors of the noise variance and
of the drift; and how many columns every tracker reads."""

ROUNDING = 1e-12
"""A result below this share of the numbers that it was computed from may be rounding: each of a few thousand operations
adds up to 2^-53 of its terms, and decimal readings carry as much."""

INPUTS = types.Array(types.float64, 1, "A", readonly=True)
"""The compiler's type of the inputs of one sample."""

NOWHERE = np.empty((0, 0, 0))
"""The array for theta alone, where all results are kept."""


DOUBLE = np.dtype(np.float64)
"""The numbers that drivers take."""


CONTIGUOUS = 0x0001 | 0x0100
"""NumPy's flags of arrays that are contiguous by rows, and aligned: of these the compiler's type is that of numbers."""


@kernel
def nothing_remembered(s: State, signal: int, age: int, l: int) -> None:
    """Nothing of an input is kept after its sample."""


class ModelSteps(NamedTuple):
    """The steps of a model: ``regress`` writes ``s.phi`` from the signals and lags, ``push`` moves the lags.

    ``foreseeing(forecast)``, where phi contains y, is the step that writes y_hat, e and s before y is seen, for a gate.
    ``apply`` stores the input of a sample, ``s.u``, after the sample, and leaves the record as if it had come with the
    output; None if an output needs the input of its own sample. An input is remembered for ``ages`` samples after its
    own. ``refuse(s, signal, age, l)`` makes column ``signal`` of u, read ``age`` samples ago (0: now), missing: what
    uses it from the next sample on is unusable. ``width`` series share a tile in a fleet, 1 where steps take one lane
    at a time.
    """

    regress: Step
    push: Step
    foreseeing: Callable[[Step], Step] | None = None
    apply: Step | None = None
    ages: int = 0
    refuse: Any = nothing_remembered
    width: int = 32


@kernel
def clean(s: State, l: int) -> None:
    """Decide which data can be used, and make everything that trackers read finite.

    Entries of phi and y are cleaned by themselves: zeroing all of phi when only y is missing would make an ARX model's
    own prediction zero and so bias its lags.
    """
    valid = 1.0
    for i in range(s.phi.shape[0]):
        x = s.phi[i, l]
        finite = abs(x) < LARGEST
        s.phi[i, l] = x if finite & (abs(x) > SMALLEST) else 0.0
        valid = valid if finite else 0.0
    y, noise = s.y[l], s.noise[l]
    finite = abs(y) < LARGEST
    s.y[l] = y if finite & (abs(y) > SMALLEST) else 0.0
    s.valid[l] = valid
    s.observed[l] = 1.0 if finite else 0.0
    s.ok[l] = valid if finite & (noise < np.inf) else 0.0


@kernel
def in_units_of_noise(variance: float, scale: float) -> float:
    """A variance times the estimated noise variance ``scale``; inf while that is NaN, which no residual determines."""
    unknown = np.inf if variance > 0.0 else 0.0
    product = variance * scale
    return product if scale >= 0.0 else unknown


@kernel
def diagonal(s: State, l: int) -> None:
    """Report the diagonal of P, times the estimated noise variance where the tracker carries one."""
    n, scale = s.theta.shape[0], s.scale[l]
    for i in range(n):
        s.var[i, l] = in_units_of_noise(s.P[i, i, l], scale)


@kernel
def unknown(s: State, l: int) -> None:
    """Report that the tracker carries no covariance."""
    for i in range(s.theta.shape[0]):
        s.var[i, l] = np.nan


@kernel
def variance_of_error(s: State, l: int) -> None:
    """s.s = scale (h + r noise), the variance of e before y is seen; inf in a direction of no knowledge."""
    v = s.h[l] + s.r[l] * s.noise[l]
    s.s[l] = s.scale[l] * v if s.h[l] < np.inf else np.inf


@kernel
def no_variance(s: State, l: int) -> None:
    """s.s is NaN, for trackers that have none."""
    s.s[l] = np.nan


@kernel
def nothing_more(o: State, s: State, l: int) -> None:
    """Store nothing but the common fields."""


@kernel
def nothing_extra(s: State, known: Array, t: int, l: int) -> None:
    """Ignore extra columns."""


class TrackerSteps(NamedTuple):
    """The steps of a tracker, in the order in which a driver runs them.

    ``predict`` is the time update (``s.dt`` nominal intervals have passed; if 0, nothing may change). ``forecast``
    writes ``s.y_hat``, ``s.e = s.y - s.y_hat`` and ``s.h``, the variance of the prediction without the noise, and
    changes nothing of theta. ``variance`` forms ``s.s``, the variance of e, from ``s.h``, the noise and the scale.
    ``correct`` is the measurement update, with ``s.ok`` (0 or 1) as a factor of its gain. ``report`` fills ``s.var``.

    ``start`` are the steps of a lane while ``s.root`` is 1, for trackers that start from no knowledge at all
    (`driftfit.trackers.forms.diffuse`); those with ``take_over``, which makes their state from theta and P, also take a
    sample whose ``h`` is above `WIDE` times its noise. ``machines`` are the routines that steps call by symbol.
    ``store(o, s, l)`` copies what the tracker's ``outputs`` name from the record ``s`` to the stored record ``o``.
    ``read_extra(s, known, t, l)`` reads the extra columns of ``known``, those after interval, noise and drift, for
    trackers that take more factors. ``store_for_smoother(o, s, l)`` copies the tracker's ``smoother_fields`` when a run
    is replayed for a smoother. With ``doubts`` the model weighs lags that the tracker doubts; with ``instruments`` a
    model that has its own writes them to s.zeta (n,), a field of the tracker. Steps see the fields of the tracker and
    those that every record has but for ``u``, so that they are compiled once for all models
    (`driftfit.engine.tracker_part`); with ``reads_model`` they see those of the model too. ``outlined`` steps are
    compiled apart from the drivers, which call them (`driftfit.engine.outlined`): for trackers that take so long that a
    call costs nothing; ``start`` always is. With ``learns_scale`` s.scale is the noise variance that the tracker
    estimates, which a gate keeps above that of rounding. Without a gate ``note(s, l, s, l)`` takes its place.
    """

    predict: Step
    forecast: Step
    correct: Step
    report: Step = diagonal
    variance: Step = variance_of_error
    start: TrackerSteps | None = None
    take_over: Step | None = None
    store: Any = nothing_more
    read_extra: Any = nothing_extra
    store_for_smoother: Any = nothing_more
    machines: tuple[Any, ...] = ()
    doubts: bool = False
    instruments: bool = False
    reads_model: bool = False
    outlined: bool = False
    learns_scale: bool = False
    note: Any = nothing


@kernel
def covariance(o: State, s: State, l: int) -> None:
    """Store both triangles of the covariance."""
    for i in range(s.theta.shape[0]):
        o.P[i, i, l] = s.var[i, l]
        for j in range(i):
            o.P[i, j, l] = s.P[i, j, l] * s.scale[l]
            o.P[j, i, l] = s.P[i, j, l] * s.scale[l]


class Drivers(NamedTuple):
    """The compiled ways to drive one (model, tracker) pair; see `drivers`."""

    run: Any
    update: Any
    update_one: Any

    def updater(self, tile: Array, m: int) -> Any:
        """The entry point of one sample of tiles of this type: ``f(as_compiled(tile), y, u)``, u from `one_or_all`.

        A number is read faster than an array, and a model of one input needs no second routine for arrays.
        """
        update, u = (self.update_one, types.float64) if m == 1 else (self.update, INPUTS)
        return update.entry(tile_type(tile), types.float64, u)


def one_or_all(u: Array) -> Any:
    """The inputs (m,) of a sample as the step of a stream takes them: a number if m is 1, an array otherwise."""
    return u.item() if u.size == 1 else u


@lru_cache(maxsize=256)
def drivers(model: ModelSteps, tracker: TrackerSteps, keep: str = "std", gate: Any = None) -> Drivers:
    """Build the drivers of a (model, tracker) pair, with a ``gate`` between forecast and correction or without.

    ``run(tile, y, u, known, out)`` takes y (T, L), u (T, m, L) and `known` (T, 3, L), or one row of it that holds for
    every sample (extra columns go to ``read_extra``), and fills out (T,) of `output_type`, with keep="own" only with
    what the tracker's ``store`` writes; where theta (T, n, L) is given too, it fills that, and the one row of out holds
    the last sample. It returns the number of samples that were processed: a gate may ask for the first ones again
    (`driftfit.readings.first_samples`). ``update(tile, y, u)`` does one sample of a tile of one lane with u (m,),
    ``update_one`` the same for a single float u (`Drivers.updater`); both take what is known from the fields
    ``interval``, ``noise`` and ``drift`` of the record and return (y_hat, e, s, ok).
    """
    with compiling():
        for machine in tracker.machines:
            machine.load()
    part = whole_record if tracker.reads_model else tracker_part
    phases: tuple[Any, ...] = looking(tracker), learning(tracker)
    phases = tuple(map(outlined, phases)) if tracker.outlined else phases if gate else (advancing(tracker),)
    sample = _sample(model, tracker.note, phases, gate, part)
    keep_more = covariance if keep == "cov" else nothing_more
    store = tracker.store if gate is None or keep == "own" else stored_too(tracker.store, store_decision)
    run = _run(sample, tracker.read_extra, _written(keep != "own", store, keep_more, part), part, gate is not None)

    def checked(tile: Array, y: Array, u: Array, known: Array, out: Array, theta: Array = NOWHERE) -> int:
        # nothing looks at types and bounds after this
        flags = y.flags.num & u.flags.num & known.flags.num & tile.flags.num & out.flags.num
        plain = (flags if theta is NOWHERE else flags & theta.flags.num) & CONTIGUOUS == CONTIGUOUS
        if not (plain and y.dtype is u.dtype is known.dtype is DOUBLE):
            # contiguous, because every layout would be compiled separately
            y = np.ascontiguousarray(y, dtype=np.float64)
            u = np.ascontiguousarray(u, dtype=np.float64)
            known = np.ascontiguousarray(known, dtype=np.float64)
        m, L, opened = kind_of(tile.dtype)
        if theta is NOWHERE:
            _check_shapes(m, L, len(out), y, u, known)
        else:
            _check_shapes(m, L, len(theta), y, u, known)
            if len(out) != 1 or theta.shape[1:] != tile["theta"].shape[1:]:
                raise ValueError(f"run: out must have one row beside theta, which has shape {theta.shape}.")
        given = as_compiled(tile) if opened else tile, y, u, known, out, theta
        done: int = run.of_kind((tile.dtype, out.dtype), given) if plain else run(*given)
        return done

    return Drivers(checked, _updating(sample, False), _updating(sample, True))


GATED = ("reason", "raw_e")
"""Fields that are stored of every sample behind a gate: its decision, and y - y_hat, of refused samples too."""


@kernel
def store_decision(o: State, s: State, l: int) -> None:
    """What a gate decided."""
    o.reason[l], o.raw_e[l] = s.reason[l], s.raw_e[l]


@lru_cache(maxsize=256)
def stored_too(first: Any, then: Any) -> Any:
    """A step that stores what two others store of a sample, which is compiled once for both."""

    @kernel
    def both(o: State, s: State, l: int) -> None:
        first(o, s, l)
        then(o, s, l)

    return both


def _written(common: bool, store: Any, keep_more: Any, part: Any) -> Any:
    """What is kept of a sample: the results of every tracker if they are ``common``, and more."""
    stores, keeps = store is not nothing_more, keep_more is not nothing_more

    @kernel
    def write(o: State, s: State) -> None:
        n, L = s.theta.shape
        if common:  # a constant, as the two below
            for i in range(n):
                for l in range(L):
                    o.theta[i, l] = s.theta[i, l]
            for i in range(n):
                for l in range(L):
                    o.var[i, l] = s.var[i, l]
            for l in range(L):
                o.y_hat[l] = s.y_hat[l]
                o.e[l] = s.e[l]
                o.s[l] = s.s[l]
                o.ok[l] = s.ok[l]
        if stores:
            for l in range(L):
                store(o, part(s), l)
        if keeps:
            for l in range(L):
                keep_more(o, part(s), l)

    return write


def _sample(model: ModelSteps, note: Any, phases: tuple[Any, ...], judge: Any, part: Any) -> Any:
    """One sample of all lanes, whose signals and known factors are in the record. Between the regression and the lags
    are the ``phases`` of the tracker, one or two, and the gate after the first."""
    regress, push, notes, judged = model.regress, model.push, note is not nothing, judge is not None
    first, last, two = phases[0], phases[-1], len(phases) > 1

    @kernel
    def sample(s: State) -> None:
        L = s.theta.shape[1]
        for l in range(L):
            if judged:  # a constant; the model may put a function of the reading in its place
                s.raw_y[l] = s.y[l]
            regress(s, l)
            clean(tracker_part(s), l)
        if two:  # a constant
            first(part(s))
        if judged:
            judge(s)
        if notes:  # a constant
            for l in range(L):
                note(part(s), l, part(s), l)  # as a gate, which has a record and a lane of its own
        last(part(s))
        for l in range(L):
            push(s, l)
        for l in range(L):
            y_hat, v, e, valid = s.y_hat[l], s.s[l], s.e[l], s.valid[l] > 0.0
            s.y_hat[l] = y_hat if valid else np.nan
            s.s[l] = v if valid else np.nan
            s.e[l] = e if s.ok[l] > 0.0 else np.nan

    return sample


def _run(sample: Any, read_extra: Any, write: Any, part: Any, judged: bool) -> Driver:
    """The loop over the samples of a record, which a gate may end early."""
    extra = read_extra is not nothing_extra

    @Driver
    def run(tile: Array, y: Array, u: Array, known: Array, out: Array, theta: Array) -> int:
        s = tile[0]
        L = s.theta.shape[1]
        given = u.shape[1] > 0
        changing = 1 if known.shape[0] > 1 else 0
        alone = theta.shape[0] > 0
        kept, last = 0 if alone else 1, y.shape[0] - 1
        for t in range(y.shape[0]):
            for l in range(L):
                s.y[l] = y[t, l]
            for l in range(L):
                s.dt[l] = known[t * changing, INTERVAL, l]
                s.noise[l] = known[t * changing, NOISE, l]
                s.drift[l] = known[t * changing, DRIFT, l]
            if extra and known.shape[1] > COMMON:
                for l in range(L):
                    read_extra(part(s), known, t, l)
            if given:
                for j in range(s.u.shape[0]):  # a constant, unlike u.shape[1]
                    for l in range(L):
                        s.u[j, l] = u[t, j, l]
            sample(s)
            if alone:
                for i in range(s.theta.shape[0]):
                    for l in range(L):
                        theta[t, i, l] = s.theta[i, l]
            if not alone or t == last:
                write(out[t * kept], s)
            if judged:  # a constant, without which the field would be missing  # noqa: SIM102
                if s.gate_replay[0] > 0:
                    return t + 1
        return int(y.shape[0])

    return run


def _updating(sample: Any, single: bool) -> Driver:
    """One sample of a stream, with an array of inputs or with a single one."""

    @Driver
    def update(tile: Array, y: float, u: Any) -> tuple[float, float, float, bool]:
        s = tile[0]
        s.y[0] = y
        s.dt[0] = s.interval[0]
        if single:  # a constant
            s.u[0, 0] = u
        else:
            for j in range(u.shape[0]):
                s.u[j, 0] = u[j]
        sample(s)
        return s.y_hat[0], s.e[0], s.s[0], s.ok[0] > 0.0

    return update


def _check_shapes(m: int, L: int, T: int, y: Array, u: Array, known: Array) -> None:
    rows, columns, lanes = known.shape
    if y.shape != (T, L) or u.shape not in ((T, m, L), (T, 0, L)) or rows not in (1, T) or columns < 3 or lanes != L:
        given, wanted = (y.shape, u.shape, known.shape), ((T, L), (T, m, L), (T, max(3, columns), L))
        raise ValueError(f"run: y, u and known have shapes {given}, but this tile and {T} samples need {wanted}.")
