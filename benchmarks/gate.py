"""What the gate does to records with and without faults, for three trackers, and what each of its rules pays.

    python -m benchmarks.gate                 # the table of cases
    python -m benchmarks.gate --rules         # what leaving out each rule costs
    python -m benchmarks.gate --runs 20 --only jump,code
    python -m benchmarks.gate --quick         # one record of each

Columns of a case, for each tracker: good readings refused and codes let in (the most of all records), and the error of
theta (root mean square from 20 samples after the event on, median over records) as a multiple of that of the same
tracker without a gate which is given the codes as missing; then that multiple for the tracker without a gate on the
record as it is.
The trackers are Kalman(q, r) with given numbers, RLS(0.98) with estimated noise, and a mixture of three drifts.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.gate_cases import CODES, MODELS, REAL, STARTS, Case
from driftfit.engine.kernel import Driver, kernel
from driftfit.readings.gate import AT_START, USED, Gate, gate_step, start
from driftfit.run.gating import replayed

KALMAN, RLS, MIXTURE = range(3)
NAMES = ("Kalman", "RLS", "mixture")
DRIFTS = np.array([0.0, 1e-4, 1e-1])


def fields(n: int, m: int, na: int, nb: int, kind: int, gate: Gate, q: float, r: float) -> dict[str, Any]:
    """The record of one lane, by field."""
    modes, wide = (3 if kind == MIXTURE else 1), (1e4 if kind == KALMAN else 1e6)
    return {
        "phi": np.zeros(n), "y": 0.0, "u": np.zeros(max(m, 1)), "dt": 1.0, "noise": 1.0, "drift": 1.0,
        "valid": 0.0, "observed": 0.0, "ok": 0.0, "y_hat": 0.0, "e": 0.0, "s": np.inf, "scale": 1.0, "r": 1.0,
        "lags": np.full(max(na, 1), np.nan), "filled": 0, "past": np.full((max(m, 1), max(nb, 1)), np.nan),
        "theta": np.zeros((3, n)), "P": np.stack([wide * np.eye(n)] * 3), "w": np.ones(3) / modes, "at": np.zeros(3),
        "h": np.zeros(3), "gain": np.zeros((3, n)), "mean": np.zeros(n), "kind": kind, "modes": modes,
        "q": np.array([q / r] * 3) if kind == KALMAN else DRIFTS, "R": r, "squares": 0.0, "count": 0.0,
        **start(gate, n, m),
    }  # fmt: skip


def tile_of(given: dict[str, Any]) -> np.ndarray:
    """A tile of one lane."""
    kinds = [
        (k, np.int64 if np.asarray(v).dtype.kind in "iu" else np.float64, (*np.shape(v), 1)) for k, v in given.items()
    ]
    tile = np.zeros(1, np.dtype(kinds, align=True))
    for name, value in given.items():
        tile[name][0] = np.asarray(value)[..., None]
    return tile


@kernel
def forecast(s, l):
    """y_hat, e and s of all modes together."""
    n, s.y_hat[l] = s.phi.shape[0], 0.0
    for k in range(s.modes[l]):
        s.at[k, l] = s.h[k, l] = 0.0
        for i in range(n):
            s.at[k, l] += s.phi[i, l] * s.theta[k, i, l]
            s.gain[k, i, l] = 0.0
            for j in range(n):
                s.gain[k, i, l] += s.P[k, i, j, l] * s.phi[j, l]
            s.h[k, l] += s.gain[k, i, l] * s.phi[i, l]
        s.y_hat[l] += s.w[k, l] * s.at[k, l]
    s.e[l] = s.y[l] - s.y_hat[l]


@kernel
def variance(s, l):
    """s from h and the noise."""
    h = 0.0
    for k in range(s.modes[l]):
        h += s.w[k, l] * (s.h[k, l] + (s.at[k, l] - s.y_hat[l]) ** 2 / s.scale[l])
    s.s[l] = s.scale[l] * (h + s.noise[l])
    if (s.kind[l] != KALMAN) & (s.count[l] < 4):
        s.s[l] = np.inf


@kernel
def predict(s, l):
    n = s.phi.shape[0]
    if s.kind[l] == RLS:
        for i in range(n):
            for j in range(n):
                s.P[0, i, j, l] = min(s.P[0, i, j, l] / 0.98, 1e8)
    else:
        for k in range(s.modes[l]):
            for i in range(n):
                s.P[k, i, i, l] += s.q[k, l]
    if s.kind[l] == MIXTURE:
        for k in range(3):
            s.w[k, l] = 0.97 * s.w[k, l] + 0.01


@kernel
def correct(s, l):
    n, total = s.phi.shape[0], 0.0
    if s.ok[l] <= 0.0:
        return
    for k in range(s.modes[l]):
        v, e = s.h[k, l] + s.noise[l], s.y[l] - s.at[k, l]
        s.w[k, l] *= np.exp(-0.5 * min(e * e / v / s.scale[l], 600.0)) / np.sqrt(v) + 1e-290
        total += s.w[k, l]
        for i in range(n):
            s.theta[k, i, l] += s.gain[k, i, l] * e / v
            for j in range(n):
                s.P[k, i, j, l] -= s.gain[k, i, l] * s.gain[k, j, l] / v
    for i in range(n):
        s.mean[i, l] = 0.0
        for k in range(s.modes[l]):
            s.mean[i, l] += s.w[k, l] / total * s.theta[k, i, l]
    for k in range(s.modes[l]):
        s.w[k, l] /= total
    if s.kind[l] != KALMAN:
        x = s.e[l] * s.e[l] / (s.s[l] / s.scale[l] if s.s[l] < np.inf else s.h[0, l] + s.noise[l])
        s.count[l] += 1.0
        if s.count[l] > n:
            share = 1.0 / min(s.count[l] - n, 50.0 if s.kind[l] == RLS else 200.0)
            x = min(x, 9.0 * s.scale[l]) if (s.kind[l] == MIXTURE) & (s.count[l] > n + 4) else x
            s.squares[l] += share * (x - s.squares[l])
            s.scale[l] = max(max(s.squares[l], s.floor[l]), 1e-30)


def model_of(na: int, nb: int, m: int, intercept: bool) -> tuple[Callable, Callable, Callable, int, int]:
    """regress, push, refuse, n and how many samples ago an input may have been read; nb = 0 uses the present inputs."""
    present = nb == 0
    n = na + m * max(nb, 1) + intercept

    @kernel
    def regress(s, l):
        for i in range(na):
            s.phi[i, l] = s.lags[i, l]
        for j in range(m):
            for i in range(max(nb, 1)):
                s.phi[na + j * max(nb, 1) + i, l] = s.u[j, l] if present else s.past[j, i, l]
        if intercept:
            s.phi[n - 1, l] = 1.0
        s.observed[l] = 1.0 if abs(s.y[l]) < np.inf else 0.0
        s.y[l] = s.y[l] if s.observed[l] > 0.0 else 0.0
        s.valid[l] = 1.0
        for i in range(n):
            if not abs(s.phi[i, l]) < np.inf:
                s.phi[i, l], s.valid[l] = 0.0, 0.0
        s.ok[l] = s.valid[l] * s.observed[l]

    @kernel
    def push(s, l):
        fills = (s.observed[l] <= 0.0) & (s.valid[l] > 0.0) & (s.filled[l] < na)
        s.filled[l] = s.filled[l] + 1 if fills else (0 if s.observed[l] > 0.0 else s.filled[l])
        newest = s.y[l] if s.observed[l] > 0.0 else (s.y_hat[l] if fills else np.nan)
        for i in range(na - 1, 0, -1):
            s.lags[i, l] = s.lags[i - 1, l]
        s.lags[0, l] = newest
        for j in range(m):
            for i in range(nb - 1, 0, -1):
                s.past[j, i, l] = s.past[j, i - 1, l]
            s.past[j, 0, l] = s.u[j, l]

    @kernel
    def refuse(s, signal, age, l):
        if age == 0:
            s.u[signal, l] = np.nan
        else:
            s.past[signal, age - 1, l] = np.nan

    return regress, push, refuse, n, nb


@kernel
def nothing(s):
    s.reason[0] = 0


def loop_of(regress: Callable, push: Callable, gate: Callable) -> Callable:
    def loop(tile, Y, U, first, theta, reason, errors):
        """Samples from ``first`` on; returns the number of those that are done."""
        s, l = tile[0], 0
        for t in range(first, len(Y)):
            s.y[l], s.raw_y[l], s.noise[l], s.dt[l] = Y[t], Y[t], 1.0, 1.0
            for j in range(U.shape[1]):
                s.u[j, l] = U[t, j]
            regress(s, l)
            predict(s, l)
            forecast(s, l)
            variance(s, l)
            errors[t, 0], errors[t, 1] = s.e[l], s.s[l]
            gate(s)
            variance(s, l)
            correct(s, l)
            push(s, l)
            theta[t], reason[t] = s.mean[:, l], s.reason[l]
            if s.gate_replay[l] > 0:
                return t + 1
        return len(Y)

    return Driver(loop)


@dataclass
class Result:
    """What a run gave."""

    theta: np.ndarray
    """Estimates (T, n)."""
    reason: np.ndarray
    """What the gate decided of each sample (T,)."""
    errors: np.ndarray
    """e and s (T, 2) as the gate found them."""
    tile: np.ndarray
    """The state at the end."""


@dataclass
class Bench:
    """A model with a gate and without."""

    na: int
    nb: int
    m: int
    intercept: bool
    gate: Gate

    def __post_init__(self) -> None:
        regress, push, refuse, self.n, ages = model_of(self.na, self.nb, self.m, self.intercept)
        self.gated = loop_of(regress, push, gate_step(self.gate, ages, refuse))
        self.plain = loop_of(regress, push, nothing)

    def run(self, kind: int, y: np.ndarray, u: np.ndarray, gated: bool, q: float, r: float) -> Result:
        """The whole record, and first samples once more if they had codes."""
        own = fields(self.n, self.m, self.na, self.nb, kind, self.gate, q, r)
        own["scale"], own["raw_e"] = r if kind == KALMAN else 1.0, np.nan
        tile, loop = tile_of(own), self.gated if gated else self.plain
        result = Result(np.zeros((len(y), self.n)), np.zeros(len(y), np.int64), np.zeros((len(y), 2)), tile)
        out = result.theta, result.reason, result.errors
        done = loop(tile, y, u, 0, *out)
        if tile["gate_replay"][0, 0] > 0:
            first = replayed(tile, self.m)
            result.tile, k = tile_of(own | {"gate_decided": 1}), len(first.y)
            signals = (np.ascontiguousarray(one[..., 0]) for one in first.without_codes())
            loop(result.tile, *signals, 0, *(np.zeros_like(one[:k]) for one in out))
            result.reason[done - k + np.flatnonzero(first.codes[..., 0].any(1))] = AT_START
            loop(result.tile, y, u, done, *out)
        return result


def measured(bench: Bench, case: Case, kind: int) -> tuple[float, float, float, float]:
    """Good readings refused, codes let in, and errors of theta with the gate and without, as multiples of what the same
    tracker has without the codes."""
    settings = {"q": case.q, "r": case.r}
    one = bench.run(kind, case.y, case.u, True, **settings)
    plain = bench.run(kind, case.y, case.u, False, **settings)
    whole = bench.run(kind, *case.without_codes(), False, **settings)
    bad = case.bad | case.bad_u
    ends = np.flatnonzero(np.diff(np.r_[bad, False][case.at :].astype(int)) < 0)
    later = slice(max(case.at + (ends[0] if len(ends) else 0) + 20, 60), None)
    gated, ungated, least = (np.sqrt(np.mean((run.theta - case.theta)[later] ** 2)) for run in (one, plain, whole))
    refused = one.reason != USED
    spoilt = np.convolve(case.bad_u, np.ones(bench.nb + 1))[: len(bad)] > 0.0  # samples that remember an input code
    lost, let_in = refused & ~case.bad & ~spoilt, ~refused & case.bad
    return float(lost.sum()), float(let_in.sum()), gated / least, ungated / least


def table(benches: dict[str, Bench], cases: dict[str, Callable], runs: int, show: bool = True) -> dict[str, np.ndarray]:
    """The medians (trackers, 4) of each case; refused and let in are the largest of all runs."""
    found = {}
    for name, make in cases.items():
        rows = np.array([
            [measured(benches[case.model], case, kind) for kind in range(3)]
            for case in (make(np.random.default_rng(seed)) for seed in range(runs))
        ])  # fmt: skip
        found[name] = np.median(rows, 0)
        found[name][:, :2] = rows.max(0)[:, :2]
        if show:
            cells = " | ".join(f"{a:4.0f} {b:3.0f} {c:8.2f} {d:9.3g}" for a, b, c, d in found[name])
            print(f"{name:32} {cells}", flush=True)
    return found


RULES = {
    "outputs": {"far": np.inf}, "repeats": {"hold": 3},
    "unusual forecasts": {"rare": np.inf}, "inputs": {"away": np.inf}, "six samples": {"trust": 50},
    "frozen": {"frozen": 0.0}, "first samples": {"first": 0},
}  # fmt: skip


def ablation(cases: dict[str, Callable], runs: int, rules: dict[str, dict[str, Any]]) -> None:
    """For every rule the cases that it changes: lost, let in and the error, with it and without, of the tracker for
    which the errors differ most."""
    whole = table({name: Bench(*sizes, Gate()) for name, sizes in MODELS.items()}, cases, runs, False)
    for rule, off in rules.items():
        found = table({name: Bench(*sizes, Gate(**off)) for name, sizes in MODELS.items()}, cases, runs, False)
        print(rule, flush=True)
        for name in cases:
            ratio = found[name][:, 2] / whole[name][:, 2]
            k = int(np.argmax(np.abs(np.log(ratio))))
            if abs(ratio[k] - 1.0) > 0.01 or np.abs(found[name][:, :2] - whole[name][:, :2]).max() >= 1.0:
                one, other = (f"{a:3.0f} {b:3.0f} {c:9.4g}" for a, b, c in (whole[name][k, :3], found[name][k, :3]))
                print(f"  {name:32} {NAMES[k]:8} {one}   without {other}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--runs", type=int, default=10)
    parser.add_argument("--only", default="")
    parser.add_argument("--rules", action="store_true")
    parser.add_argument("--quick", action="store_true")
    given = parser.parse_args()
    runs = 1 if given.quick else given.runs
    words = given.only.split(",")
    cases = {k: v for k, v in (REAL | CODES | STARTS).items() if any(word in k for word in words)}
    if given.rules:
        return ablation(cases, runs, RULES)
    benches = {name: Bench(*sizes, Gate()) for name, sizes in MODELS.items()}
    print(" " * 32, " | ".join(f"{name:>8}: lost in gated   ungated" for name in NAMES))
    table(benches, cases, runs)
    return None


if __name__ == "__main__":
    main()
