"""How a tracker is judged on the held-out scenarios: scores of a run, scores of the oracle, and what is kept of them.

    error    root mean square of theta - truth, in units of y (`Case.weight`)
    step     root mean square of the one-step errors, without codes
    moving   share of the parameters that move within their 95 % bands; ``still``: of those that do not
    output   share of y within the 95 % bands of its prediction
    ahead    the same of forecasts 1 .. 20 samples ahead, from every 50th sample
    width    median of their standard deviations over the half-width that holds 68 % of their errors: 1 for normal
             errors, and above 1 for bands wider than most errors need, however large rare ones are
    wrong    share of |theta - truth| > 5 std: certain and wrong
    seconds  time of the run; of several the least

A method is a function of a `Case` that returns an `Outcome`.
"""

from __future__ import annotations

import hashlib
import json
import os
import warnings
from collections.abc import Callable, Iterable
from pathlib import Path
from time import perf_counter
from typing import NamedTuple
from zlib import crc32

import numpy as np

from benchmarks.held_out import changes, plants, records
from benchmarks.held_out.case import Case
from benchmarks.held_out.oracle import oracle
from driftfit import Track, track
from driftfit.engine.kernel import Array
from driftfit.trackers.base import Tracker

HALF, CENTRAL, CERTAIN = 1.959963984540054, 0.6826894921370859, 5.0
HORIZON, EVERY = 20, 50
"""Samples of a forecast, and between forecasts."""
Scores = dict[str, float]


class Outcome(NamedTuple):
    """theta (T, n) and its std after each sample, the prediction (T,) of y and its std before it.

    ``ahead`` forecasts y and its std after so many samples, (`HORIZON`,) each.
    """

    theta: Array
    std: Array
    prediction: Array
    prediction_std: Array
    ahead: Callable[[int], tuple[Array, Array]] | None = None


Method = Callable[[Case], Outcome]


def of_tracker(tracker: Tracker) -> Method:
    """A tracker of ours on the signals, gated if it asks for that."""

    def until(case: Case, end: int) -> Track:
        known = {name: value[:end] if np.ndim(value) else value for name, value in case.reading.items()}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return track(case.model, tracker, case.y[:end], case.u[:end] if case.u.size else None, **known)

    def run(case: Case) -> Outcome:
        def ahead(end: int) -> tuple[Array, Array]:
            found = until(case, end).forecast(HORIZON, case.u[end : end + HORIZON] if case.u.size else None)
            return found.y_hat, found.y_std

        out = until(case, len(case.y))
        return Outcome(out.theta, out.std, out.prediction, out.innovation_std, ahead)

    return run


def of_function(function: Callable[[Array, Array], tuple[Array, Array, Array, Array]]) -> Method:
    """A function of regressors (T, n) and y (T,), NaN where missing, to theta, std, prediction and its variance."""

    def run(case: Case) -> Outcome:
        theta, std, prediction, variance = function(case.regressors, case.readings)
        return Outcome(theta, std, prediction, np.sqrt(variance))

    return run


def scenarios() -> dict[str, Callable[[np.random.Generator], Case]]:
    """Every scenario, by name."""
    return {
        name: function
        for module in (changes, records, plants)
        for name, function in vars(module).items()
        if getattr(function, "__annotations__", None) == {"rng": "Generator", "return": "Case"}
    }


def played(name: str, seed: int) -> Case:
    """A scenario with this seed."""
    return scenarios()[name](np.random.default_rng([seed, crc32(name.encode())]))


def distance(case: Case, theta: Array) -> float:
    """Root mean square of theta - truth in units of y; as if it were 0 where there is no estimate."""
    off = (np.nan_to_num(theta, posinf=0.0, neginf=0.0) - case.theta)[case.burn :]
    return float(np.sqrt(np.mean(np.einsum("ti,ij,tj->t", off, case.weight(), off)) + case.least**2))


def step_error(case: Case, prediction: Array) -> float:
    """Root mean square of the one-step errors where y and its regressors are known; no prediction counts as 0."""
    off = np.where(np.isfinite(case.regressors).all(axis=1), case.readings - np.nan_to_num(prediction), np.nan)
    return float(np.sqrt(np.nanmean(off[case.burn :] ** 2) + case.least**2))


def within(off: Array, std: Array) -> float:
    """Share within the band; NaN for none."""
    judged = np.isfinite(off) & np.isfinite(std)
    return float(np.mean(np.abs(off[judged]) <= HALF * std[judged])) if judged.any() else np.nan


def forecast(case: Case, ahead: Callable[[int], tuple[Array, Array]] | None) -> Scores:
    """The scores of forecasts."""
    ends = range(case.burn, len(case.y) - HORIZON, EVERY) if ahead is not None else ()
    found = [(case.readings[end : end + HORIZON], *ahead(end)) for end in ends] if ahead is not None else []
    y, mean, std = np.array(found or np.full((1, 3, 1), np.nan)).swapaxes(0, 1)
    judged = np.isfinite(y - mean) & np.isfinite(std)
    size = max(float(np.quantile(np.abs(y - mean)[judged], CENTRAL)), case.least) if judged.any() else 0.0
    return {"ahead": within(y - mean, std), "width": float(np.median(std[judged])) / size if size > 0.0 else np.nan}


def scored(case: Case, method: Method) -> Scores:
    """The scores of a method on a case."""
    begun = perf_counter()
    out = method(case)
    seconds = perf_counter() - begun
    late, moves = slice(case.burn, None), np.ptp(case.theta, axis=0) > 0.0
    off, std = (out.theta - case.theta)[late], out.std[late]
    # errors that rounding makes, or that are small beside the least that matters, are not wrong
    matters = np.abs(off) * np.sqrt(np.diag(case.weight())) > max(1e-9 * float(np.nanstd(case.readings)), case.least)
    judged = np.isfinite(off) & np.isfinite(std)
    y = (case.readings - out.prediction)[late]
    return {
        "error": distance(case, out.theta),
        "step": step_error(case, out.prediction),
        "moving": within(off[:, moves], std[:, moves]),
        "still": within(off[:, ~moves], std[:, ~moves]),
        "output": within(y, out.prediction_std[late]),
        "wrong": float(np.mean((np.abs(off) > CERTAIN * std)[judged] & matters[judged])) if judged.any() else 0.0,
        "seconds": seconds,
        **forecast(case, out.ahead),
    }


class Kept:
    """Scores by method, scenario and seed in a file, without which they are computed; None: in memory.

    What was computed on another version of a scenario is not used.
    """

    def __init__(self, path: Path | None) -> None:
        self.path = path
        self.scores: dict[str, Scores] = {}
        self.read()

    def read(self) -> None:
        """What the file has."""
        if self.path is not None and self.path.exists():
            self.scores |= json.loads(self.path.read_text())

    def of(self, name: str, seed: int, label: str, method: Method | None) -> Scores | None:
        """Scores under a label, computed by the method if they are not there; None if there is no method either.

        The label "oracle" needs no method.
        """
        case = played(name, seed)
        digest = hashlib.sha256(case.y.tobytes() + case.u.tobytes() + case.theta.tobytes()).hexdigest()[:12]
        key = f"{label}/{name}/{seed}/{digest}"
        if key not in self.scores:
            if label == "oracle":
                theta, prediction = oracle(case)
                self.scores[key] = {"error": distance(case, theta), "step": step_error(case, prediction)}
            elif method is None:
                return None
            else:
                self.scores[key] = scored(case, method)
        return self.scores[key]

    def real(self, name: str, label: str, compute: Callable[[], Scores] | None) -> Scores | None:
        """Scores on a real record, computed if they are not there; None if there is nothing to compute them."""
        key = f"{label}/record {name}"
        if key not in self.scores and compute is not None:
            self.scores[key] = compute()
        return self.scores.get(key)

    def forget(self, label: str, names: Iterable[str]) -> None:
        """Compute what has this label, of these scenarios and records, anew."""
        begins = tuple(f"{label}/{name}" for name in names)
        self.scores = {key: value for key, value in self.scores.items() if not key.startswith(begins)}

    def write(self) -> None:
        if self.path is not None:
            unfinished = self.path.with_suffix(f".{os.getpid()}")
            unfinished.write_text(json.dumps(self.scores, indent=0))
            unfinished.replace(self.path)


def means(kept: Kept, name: str, seeds: Iterable[int], label: str, method: Method | None = None) -> Scores | None:
    """Mean scores over seeds; ``ratio`` is that of the error to the oracle's, ``step`` that of one-step errors."""
    rows = []
    for seed in seeds:
        best, row = kept.of(name, seed, "oracle", None), kept.of(name, seed, label, method)
        if best is None or row is None:
            return None
        rows.append({**row, "ratio": row["error"] / best["error"], "step": row["step"] / best["step"]})
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Mean of empty slice", RuntimeWarning)
        found = {head: float(np.nanmean([row[head] for row in rows])) for head in rows[0]}
    # the first run compiles
    return {**found, "seconds": min(row["seconds"] for row in rows)}
