"""The promises of a tracker: `check_tracker`.

Every check runs the tracker on a small simulated record. For each broken promise it returns a sentence that names it
and where to look. This takes about as long as compiling the tracker three times. A tracker that keeps all promises is
not necessarily good: compare its one-step errors with those of others (`Track.summary`).
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator
from dataclasses import FrozenInstanceError, fields
from pathlib import Path

import numpy as np

from driftfit.data.storage import parts_of
from driftfit.engine.drivers import ROUNDING
from driftfit.engine.kernel import Array
from driftfit.models.arx import ARX
from driftfit.models.base import Model
from driftfit.models.regression import Regression
from driftfit.results import Track
from driftfit.run.parallel_lanes import FEWEST_LANES
from driftfit.run.result import root_mean_square
from driftfit.streams import Live
from driftfit.trackers.base import Tracker
from driftfit.tracking import track

T = 200
LONG = 20_000


def check_tracker(tracker: Tracker, model: Model | None = None) -> list[str]:
    """The promises that a tracker breaks, one sentence each; an empty list if it keeps them all.

    Parameters
    ----------
    tracker : Tracker
        With all its settings, as for `track`.
    model : Model or None
        A model with one input on which to try it; ``ARX(1, 1)`` by default, or the tracker's `Tracker.own_model`.
    """
    bound = (model or tracker.own_model(1, 1, 1) or ARX(1, 1)).bind(1)
    broken = list(_settings(tracker))
    try:
        run = track(bound, tracker, *record())
    except Exception as error:  # whatever the error is, the author of the tracker wants to read it
        first = next((line for line in str(error).splitlines() if line.strip()), type(error).__name__)
        return [*broken, f"It does not run: {type(error).__name__}: {first.strip()}"]
    broken += _missing(tracker, bound)
    if broken and "Missing data make" in broken[-1]:  # nothing else can be distinguished
        return broken
    for check in (_live, _lanes, _causal, _unused, _no_time, _each, _variances, _rest, _saving, _learning):
        broken += check(tracker, bound, run)
    return broken


def record(seed: int = 0, length: int = T) -> tuple[Array, Array]:
    """y, u of y_t = 0.7 y_(t-1) + u_(t-1) + noise of standard deviation 0.1."""
    rng = np.random.default_rng(seed)
    u, v = rng.normal(size=length), 0.1 * rng.normal(size=length)
    y = np.zeros(length)
    for t in range(1, length):
        y[t] = 0.7 * y[t - 1] + u[t - 1] + v[t]
    return y, u


def damaged(seed: int = 0, bad: float = np.nan) -> tuple[Array, Array]:
    """The same with a tenth of both signals missing."""
    y, u = record(seed)
    rng = np.random.default_rng(seed + 1)
    y[rng.random(T) < 0.1], u[rng.random(T) < 0.1] = bad, bad
    return y, u


def _differ(one: Track, other: Track, upto: int | None = None) -> str | None:
    """The first result in which two runs differ, and the first sample at which they do."""
    for name in one.stores():
        a, b = one.written(name)[:upto], other.written(name)[:upto]
        wrong = ~((a == b) | (np.isnan(a) & np.isnan(b)))
        if wrong.any():
            return f"{name} differs from sample {int(np.argmax(wrong.reshape(len(a), -1).any(axis=1)))} on"
    return None


def _settings(tracker: Tracker) -> Iterator[str]:
    kind = type(tracker).__name__
    try:
        again = type(tracker).from_settings(json.loads(json.dumps(tracker.settings())))
        if again != tracker or hash(again) != hash(tracker):
            yield f"{kind} is not the same after its settings were written down and read back; make lists tuples."
    except (TypeError, ValueError) as error:
        yield f"The settings of {kind} are not plain, hashable data (numbers, text, None, tuples of these): {error}."
    for field in fields(tracker)[:1]:  # type: ignore[arg-type]
        try:
            setattr(tracker, field.name, getattr(tracker, field.name))
            yield f"{kind} can be changed after construction; make it @dataclass(frozen=True)."
        except FrozenInstanceError:
            pass


def _live(tracker: Tracker, model: Model, _: Track) -> Iterator[str]:
    y, u = damaged()
    run, live = track(model, tracker, y, u), Live(model, tracker)
    for t in range(T):
        y_hat, e, _s, ok = live.update(y[t], u[t])
        reported, expected = (
            (y_hat, e, ok, *live.theta),
            (run.prediction[t], run.innovation[t], run.ok[t], *run.theta[t]),
        )
        if not np.array_equal(reported, expected, equal_nan=True):
            yield (
                f"Live and track differ from sample {t} on: a step may use only its own sample and the state, "
                "so keep whatever must be remembered in fields of the state."
            )
            return


def _lanes(tracker: Tracker, model: Model, _: Track) -> Iterator[str]:
    count = max(FEWEST_LANES, tracker.width) + 1
    y, u = (np.stack(signal) for signal in zip(*(damaged(seed) for seed in range(count)), strict=True))
    fleet = track(model, tracker, y, u, by="row")
    for key in (0, 1, count - 1):
        difference = _differ(fleet[key], track(model, tracker, y[key], u[key]))
        if difference:
            yield (
                f"A series gives other results in a fleet than alone ({difference}): index every field with [..., l], "
                "and take exp and log from driftfit.extend, because others differ with the number of lanes."
            )
            return


def _causal(tracker: Tracker, model: Model, run: Track) -> Iterator[str]:
    y, u = record()
    y[120] += 10.0
    other = track(model, tracker, y, u)
    difference = _differ(run, other, 120)
    if difference:
        yield f"It looks ahead: a change of sample 120 changes earlier results ({difference})."
    elif run.prediction[120] != other.prediction[120]:
        yield "The prediction of an output depends on that output: compute s.y_hat from theta before its update."
    own = tracker.own_model(1, 1, 1) is not None  # its equation may have another sign or scale
    if not own and not np.allclose(run.innovation[run.ok], (run.y - run.prediction)[run.ok]):
        yield "s.e is not s.y[l] - s.y_hat[l] at samples that are used."


def _missing(tracker: Tracker, model: Model) -> Iterator[str]:
    runs = {bad: track(model, tracker, *damaged(bad=bad)) for bad in (np.nan, np.inf, 1e200)}
    for bad, run in runs.items():
        if not np.isfinite(run.theta).all():
            t = int(np.argmax(~np.isfinite(run.theta).all(axis=1)))
            yield f"Missing data make theta not finite ({bad}, at sample {t}): never divide by what may be 0."
            return
    if any(_differ(run, runs[np.nan]) for run in runs.values()):
        yield "Values that are infinite or absurdly large are not treated like missing ones."


def _unused(tracker: Tracker, model: Model, _: Track) -> Iterator[str]:
    y, u = record()
    weights = np.ones(T)
    weights[100:110] = 0.0
    loud = np.where(weights > 0.0, y, y + 5.0)
    memoryless = tracker.own_model(0, 1, 0) or Regression(1)
    runs = [track(memoryless, tracker, signal, u, weights=weights) for signal in (y, loud)]
    if not np.array_equal(runs[0].theta, runs[1].theta):
        yield "It learns from samples that must not be used: s.ok[l], 0 or 1, must be a factor of the gain."


def _no_time(tracker: Tracker, model: Model, _: Track) -> Iterator[str]:
    y, u = record()
    live = Live(model, tracker)
    for t in range(100):
        live.update(y[t], u[t])
    before = live.theta, live.cov
    live.hold()
    for t in range(100, 110):
        live.update(y[t], u[t])
    theta, cov = before
    # a covariance may be computed again from other parts, and is then the same but for the last digits
    size = np.max(np.abs(cov[np.isfinite(cov)]), initial=0.0)
    same = np.allclose(live.cov, cov, rtol=0.0, atol=ROUNDING * size, equal_nan=True)
    if not (np.array_equal(live.theta, theta) and same):
        yield (
            "The state changes although no time passes and no sample is used: "
            "with s.dt[l] = 0 predict must change nothing."
        )


def _each(tracker: Tracker, model: Model, _: Track) -> Iterator[str]:
    if not tracker.drift_per_parameter:
        return
    y, u = record()
    drift = np.where(np.arange(T) % 20 == 0, 100.0, 1.0)
    columns = np.repeat(drift[:, None], len(tracker.names_for(model)), axis=1)
    one, each = (track(model, tracker, y, u, drift=given) for given in (drift, columns))
    if not np.allclose(one.theta, each.theta, rtol=1e-6, atol=1e-9):
        yield (
            "It declares drift_per_parameter = True, but the same drift given for each parameter has another effect "
            "than one drift for all: give its steps read_extra=driftfit.trackers.forms.covariance.read_drift "
            "and multiply q by s.drift_root[i, l] ** 2."
        )


def _variances(tracker: Tracker, model: Model, run: Track) -> Iterator[str]:
    var, cov = run.var[-1], run.cov(-1)
    if not tracker.covariance:
        if not np.isnan(var).all():
            yield (
                "It declares covariance = False, but reports variances; "
                "use driftfit.engine.drivers.unknown as its report."
            )
        return
    if not (np.isfinite(var).all() and (var >= 0.0).all()):
        yield f"Variances of theta are not finite and positive after {T} samples: {var}."
    elif not (
        np.isfinite(cov).all() and np.array_equal(cov, cov.T) and np.linalg.eigvalsh(cov).min() >= -1e-9 * var.max()
    ):
        yield "The covariance of theta is not symmetric, finite and positive; keep its lower triangle in s.P."
    s = run.innovation_var[run.ok]
    if not ((s > 0.0) | ~np.isfinite(s)).all():
        yield "The variance of the innovation, s.s, is not positive."


def _rest(tracker: Tracker, model: Model, _: Track) -> Iterator[str]:
    y, u = record(length=LONG)
    y[T:], u[T:] = 0.0, 0.0
    run = track(model, tracker, y, u)
    if not np.isfinite(run.theta).all() or not (np.isfinite(run.std[-1]).all() or not tracker.covariance):
        yield f"Without excitation it does not stay finite for {LONG} samples."


def _saving(tracker: Tracker, model: Model, run: Track) -> Iterator[str]:
    y, u = record()
    live = Live(model, tracker)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "state.npz"
        try:
            for t in range(T):
                if t == T // 2:
                    live.save(path)
                    live = Live.load(path, parts_of((model, tracker)))
                live.update(y[t], u[t])
        except (ValueError, TypeError) as error:
            yield f"It cannot be saved and loaded: {error}"
            return
    if not np.array_equal(live.theta, run.theta[-1]):
        yield "A run that is saved, loaded and continued differs from one that never stopped."


def _learning(tracker: Tracker, model: Model, run: Track) -> Iterator[str]:
    used = run.ok & (np.arange(T) >= T // 2)
    error, level = root_mean_square(run.innovation[used]), root_mean_square(run.y[used])
    if not error < 0.5 * level:
        yield (
            f"It does not follow a constant system: the rms error of the second half is {error:.3g}, the output's own "
            f"is {level:.3g}."
        )
