"""The settings to be estimated: which numbers of a tracker, in which range, and how they are parametrised.

A knob x is the log10 of a positive number, or -inf for zero if zero is allowed. The knobs of a tracker are the settings
that were left out:

    mu           FLS, AugmentedFLS   mu = 10^x s, or by group mu_i = 10^x p_i;    x from -4 to max(5, 2 log10 T)
    q and r      Kalman              q_i = r 10^x / p_i;                          -x in the same range, or zero
    q alone      Kalman(r=...)       the same with the given r
    r alone      Kalman(q=...)       r = 10^x v;                                  x from -9 to 3
    laws         Kalman(laws=...)    variances 10^x v / p_i, deviations 10^x sqrt(v / p_i), times 10^x; r, q
    forgetting   RLS                 forgetting = 1 - 10^-x, 10^x samples of memory; x from log10 2n to log10 100 T
    changes      Bank                q or size^2 of every change times 100^x; x from -3 to 3, of the first also zero;
                                     prior probabilities of the others, where they are given, times 10^x, x from -2

p_i is the mean square of regressor i over the factor of the noise variance, 1 / weight, s their sum, v the residual
variance of a constant theta. A group shares one drift *in terms of the output*, so units do not matter. T samples
cannot distinguish a drift below 1 / T^2 from none (for slopes: 1 / T^4).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from driftfit.bank.bank import Bank
from driftfit.engine.kernel import Array
from driftfit.engine.settings import missing_settings
from driftfit.trackers.base import Tracker
from driftfit.trackers.kalman import Kalman
from driftfit.tune.lanes import Task, score

Bounds = tuple[float, float] | None


@dataclass(frozen=True)
class Knobs:
    """The numbers to be estimated: p knobs that determine k values of settings.

    ``low``, ``high``, ``zero`` (p,): the range of x, and whether -inf is possible. ``run(x)`` is the tracker that
    scores x in lanes; ``profiled`` means that it works relative to the noise variance, which then has a closed form.
    ``build(x, sigma2)`` is the tracker that is returned. ``names`` (k,), ``owner`` (k,) and ``values(x)`` (k,) give the
    names and values of the settings, and the knob to which each belongs.
    """

    low: Array
    high: Array
    zero: Array
    profiled: bool
    run: Callable[[Array], Tracker]
    build: Callable[[Array, float], Tracker]
    names: tuple[str, ...]
    owner: Array
    values: Callable[[Array], Array]
    origin: tuple[Any, ...] = ()

    def __reduce__(self) -> Any:
        """Functions cannot be pickled, but the arguments from which they were made can."""
        return find_knobs, self.origin


def find_knobs(task: Task, tracker: Tracker, groups: Any, bounds: Bounds) -> Knobs:
    """The knobs of a tracker for a record; ValueError if it has none."""
    return replace(_find(task, tracker, groups, bounds), origin=(task, tracker, groups, bounds))


def _find(task: Task, tracker: Tracker, groups: Any, bounds: Bounds) -> Knobs:
    missing = missing_settings(tracker)
    if isinstance(tracker, Bank) and groups is None:
        return _changes(tracker, bounds)
    if groups is not None and missing not in (["mu"], ["q"], ["q", "r"]):
        raise ValueError(f"tune: groups belong to q and mu; settings left out: {', '.join(missing) or 'none'}.")
    if getattr(tracker, "laws", None) is not None and missing:
        return _laws(task, tracker, missing, bounds)
    if missing == ["mu"]:
        return _weight(task, tracker, groups, bounds)
    if missing in (["q"], ["q", "r"]):
        return _drift(task, tracker, groups, bounds)
    if missing == ["r"]:
        return _noise(task, tracker, bounds)
    if missing == ["forgetting"]:
        return _memory(task, tracker, bounds)
    raise ValueError(
        f"tune: settings left out of {tracker!r}: {', '.join(missing) or 'none'}. tune can find mu, q and r, or "
        "forgetting: leave them out, as in FLS(), Kalman(r=0.1) or RLS()."
    )


def members(names: Sequence[str], groups: Any) -> Array:
    """The index of the group of every parameter, (n,)."""
    if groups is None:
        return np.zeros(len(names), int)
    if isinstance(groups, str) and groups == "each":
        return np.arange(len(names))
    labels = [] if isinstance(groups, str) else [str(label) for label in groups]
    if len(labels) != len(names):
        raise ValueError(
            f"tune: groups must be None, 'each', or one label for each of the {len(names)} parameters "
            f"({', '.join(names)}); got {groups!r}."
        )
    unique = list(dict.fromkeys(labels))
    return np.array([unique.index(label) for label in labels])


def still(task: Task, scored_by: Tracker) -> tuple[Array, float]:
    """Mean squares of the regressors (n,), and the residual variance of a constant theta."""
    scores = score(task, [scored_by])
    power, variance = scores.power[:, 0], float(scores.sigma2()[0])
    if not np.any(power > 0.0):
        y, u = (np.concatenate([np.ravel(getattr(record, name)) for record in task.records]) for name in "yu")
        why = (
            f", because all of {len(y)} outputs are missing"
            if not np.isfinite(y).any()
            else ", because all inputs are missing"
            if len(u) and not np.isfinite(u).any()
            else " with a regressor other than zero"
        )
        raise ValueError(f"tune: there is nothing to tune on: the record has no usable sample{why}.")
    return power, variance if 0.0 < variance < np.inf else 1.0


def constant(task: Task, tracker: Any) -> Tracker:
    """The tracker without drift, or with the smallest possible drift."""
    n = task.model.n
    if not tracker.covariance:
        return replace(tracker, mu=1e300)  # type: ignore[no-any-return]
    if "mu" in tracker.required:
        return replace(tracker, mu=(np.inf,) * n, p0=None)  # type: ignore[no-any-return]
    if isinstance(tracker, Kalman) and len(tracker.names_for(task.model)) == n:
        return replace(tracker, q=(0.0,) * n, r=1.0, p0=None, laws=None)
    return Kalman(q=(0.0,) * n, r=1.0)  # other trackers need not know the diffuse start


def _drift_ends(task: Task, tracker: Tracker) -> tuple[float, float]:
    """Ends of log10 mu over the mean square of the regressors; a drift of slopes accumulates twice over the record."""
    return -4.0, max(5.0, (4.0 if tracker.slopes else 2.0) * np.log10(task.longest))


def _range(bounds: Bounds, ends: tuple[float, float], units: Array, group: Array) -> tuple[Array, Array]:
    """Ends of the knobs, (p,) each: those given, or where every setting 10^x unit of a group is within the bounds."""
    p = group.max(initial=-1) + 1
    if bounds is None:
        return np.full(p, ends[0]), np.full(p, ends[1])
    if len(bounds) != 2 or not 0.0 < bounds[0] < bounds[1] < np.inf:
        raise ValueError(f"tune: bounds must be (low, high), both positive, low below high; got {bounds!r}.")
    places = [np.flatnonzero((group == k) & (units > 0.0)) for k in range(p)]
    low, high = (
        np.array([np.log10(end / pick(units[at])) if at.size else x for at in places])
        for end, x, pick in zip(bounds, ends, (np.min, np.max), strict=True)
    )
    if (low >= high).any():
        raise ValueError(
            f"tune: no shared drift keeps the settings of all its parameters within bounds={bounds!r}, because the "
            "sizes of their regressors differ too much; widen the bounds, or use groups='each'."
        )
    return low, high


def _weight(task: Task, tracker: Any, groups: Any, bounds: Bounds) -> Knobs:
    """mu of FLS or AugmentedFLS."""
    names = task.model.names
    if groups is not None and not tracker.covariance:
        raise ValueError(f"tune: {type(tracker).__name__} has one mu for all parameters; leave groups=None.")
    power, _ = still(task, constant(task, tracker))
    ends = _drift_ends(task, tracker)
    if groups is None:
        total = np.array([power.sum()])
        return _single(tracker, "mu", _range(bounds, ends, total, np.zeros(1, int)), lambda x: 10.0**x * total, True)
    group, share = members(names, groups), np.where(power > 0.0, power, power.max())
    low, high = _range(bounds, ends, share, group)

    def each(x: Array) -> Array:
        return np.asarray(10.0 ** x[group] * share)

    def build(x: Array, sigma2: float = 1.0) -> Tracker:
        return replace(tracker, mu=tuple(each(x)))  # type: ignore[no-any-return]

    labels = tuple(f"mu[{name}]" for name in names)
    return Knobs(low, high, np.zeros(len(low), bool), True, build, build, labels, group, each)


def _drift(task: Task, tracker: Any, groups: Any, bounds: Bounds) -> Knobs:
    """q of Kalman; a missing r in closed form, or as a further knob with a given prior or Student's density."""
    names = tracker.names_for(task.model)
    power, variance = still(task, constant(task, tracker))
    if len(names) != len(power):  # the tracker's parameters are not the regression's
        power = np.full(len(names), power.sum())
    group = members(names, groups)
    share = np.where(power > 0.0, 1.0 / np.where(power > 0.0, power, 1.0), 0.0)
    least, most = _drift_ends(task, tracker)
    low, high = _range(bounds, (-most, -least), share if tracker.r is None else share * tracker.r, group)
    own_r = tracker.r is None and (tracker.p0 is not None or bool(tracker.density))
    profiled = tracker.r is None and not own_r
    if own_r:
        low, high = np.append(low, -9.0), np.append(high, 3.0)
    zero = (np.arange(len(low)) <= group.max()) & (bounds is None)

    def ratios(x: Array) -> Array:
        return np.asarray(10.0 ** x[group] * share)

    def noise(x: Array) -> float:
        return variance * 10.0 ** float(x[-1]) if own_r else 1.0 if profiled else float(tracker.r)

    def with_noise(x: Array, r: float) -> Tracker:
        return replace(tracker, q=tuple(r * ratios(x)), r=r)  # type: ignore[no-any-return]

    def values(x: Array) -> Array:
        return np.append(ratios(x), noise(x)) if own_r else ratios(x)

    labels, owner = tuple(f"q[{name}]/r" for name in names), group
    if own_r:
        labels, owner = (*labels, "r"), np.append(group, len(low) - 1)
    return Knobs(
        low, high, zero, profiled,
        run=lambda x: with_noise(x, noise(x)),
        build=lambda x, sigma2: with_noise(x, sigma2 if profiled else noise(x)),
        names=labels, owner=owner, values=values,
    )  # fmt: skip


def _single(
    tracker: Any, name: str, ends: tuple[Array, Array], values: Callable[[Array], Array], profiled: bool
) -> Knobs:
    """The knob of one setting, whose value at x is ``values(x)`` (1,)."""

    def build(x: Array, sigma2: float = 1.0) -> Tracker:
        return replace(tracker, **{name: float(values(x)[0])})  # type: ignore[no-any-return]

    return Knobs(*ends, np.zeros(1, bool), profiled, build, build, (name,), np.zeros(1, int), values)


def _noise(task: Task, tracker: Any, bounds: Bounds) -> Knobs:
    """r of Kalman for a given q."""
    _, variance = still(task, constant(task, tracker))
    ends = _range(bounds, (-9.0, 3.0), np.array([variance]), np.zeros(1, int))
    return _single(tracker, "r", ends, lambda x: np.asarray(variance * 10.0**x), False)


def _laws(task: Task, tracker: Any, missing: list[str], bounds: Bounds) -> Knobs:
    """q, r and the settings of laws that are None, each a knob of its own."""
    if bounds is not None:
        raise ValueError("tune: bounds= are those of one setting; with laws leave them out, or give the settings.")
    power, variance = still(task, constant(task, tracker))
    T, places = np.log10(task.longest), dict(zip(task.model.names, power, strict=True))
    unit, low, high = np.ones(len(missing)), np.empty(len(missing)), np.empty(len(missing))
    for k, name in enumerate(missing):
        setting, parameter = name.rpartition(".")[2], name.partition("[")[2].partition("]")[0]
        own = variance / (places.get(parameter, power.sum()) or power.max())
        if name == "r":
            unit[k], low[k], high[k] = variance, -9.0, 3.0
        elif setting == "time":
            low[k], high[k] = -0.5, T + 1.0
        else:
            half = 0.5 if setting == "std" else 1.0
            unit[k], low[k], high[k] = own**half, -half * max(5.0, 4.0 * T), 2.0 * half

    def values(x: Array) -> Array:
        return np.asarray(10.0**x * unit)

    def build(x: Array, sigma2: float = 1.0) -> Tracker:
        found = iter(values(x).tolist())
        own = {name: next(found) for name in missing if name in ("q", "r")}
        laws = tuple(
            (name, replace(law, **{one: next(found) for one in missing_settings(law)})) for name, law in tracker.laws
        )
        return replace(tracker, **own, laws=laws)  # type: ignore[no-any-return]

    zero = np.array([name.endswith(("q", "level")) for name in missing])
    return Knobs(low, high, zero, False, build, build, tuple(missing), np.arange(len(missing)), values)


MOST_PROBABLE = 0.5
"""Upper bound of the sum of the prior probabilities of all changes but the first."""


def _changes(tracker: Bank, bounds: Bounds) -> Knobs:
    """Scales and prior probabilities of the changes of a bank; bounds are those of the factors of the scales."""
    changes = tracker.all_changes
    if all(one.prob is not None for one in changes):  # the first has the remaining probability
        changes = (replace(changes[0], prob=None), *changes[1:])
    moving = [i for i, one in enumerate(changes) if any(part.any() for part in one.scales())]
    given = [] if tracker.transition is not None else [i for i, one in enumerate(changes) if i and one.prob]
    if not moving and not given:
        raise ValueError("tune: no change of this Bank moves anything, and none has a probability to be found.")
    low, high = _range(bounds, (-3.0, 3.0), np.ones(len(moving)), np.arange(len(moving)))
    priors = np.array([changes[i].prob or 0.0 for i in given])
    most = np.log10(MOST_PROBABLE / max(len(given), 1) / priors)
    lows = np.r_[low, np.minimum(-2.0, most - 2.0)]
    highs = np.r_[high, most]

    def build(x: Array, sigma2: float = 1.0) -> Tracker:
        made = list(changes)
        for i, factor in zip(moving, 10.0 ** x[: len(moving)], strict=True):
            made[i] = made[i].scaled(float(factor))
        for i, prob in zip(given, priors * 10.0 ** x[len(moving) :], strict=True):
            made[i] = replace(made[i], prob=float(prob))
        return replace(tracker, changes=tuple(made))

    def values(x: Array) -> Array:
        return np.asarray(10.0**x * np.r_[np.ones(len(moving)), priors])

    names = tuple(f"scale[{tracker.change_names[i]}]" for i in moving)
    names += tuple(f"prob[{tracker.change_names[i]}]" for i in given)
    zero = np.array([i == 0 and bounds is None for i in moving] + [False] * len(given))
    return Knobs(lows, highs, zero, False, build, build, names, np.arange(len(names)), values)


def _memory(task: Task, tracker: Any, bounds: Bounds) -> Knobs:
    """forgetting of RLS, by the logarithm of the samples of memory 1 / (1 - forgetting)."""
    if bounds is not None and not 0.0 < bounds[0] < bounds[1] < 1.0:
        raise ValueError(
            f"tune: bounds of forgetting must be (low, high) between 0 and 1, such as (0.9, 0.999); got {bounds!r}."
        )
    memory = None if bounds is None else (1.0 / (1.0 - bounds[0]), 1.0 / (1.0 - bounds[1]))
    usual = (float(np.log10(2.0 * task.model.n)), float(np.log10(100.0 * task.longest)))
    ends = _range(memory, usual, np.ones(1), np.zeros(1, int))
    return _single(tracker, "forgetting", ends, lambda x: np.asarray(np.maximum(1.0 - 10.0**-x, 0.0)), True)
