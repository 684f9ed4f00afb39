"""Alarms on a frozen reference model: real rates of false alarms, and delays compared with other detectors.

    y_t = 2 u_t + 1 + v_t,    u_t ~ N(0, 1), v_t of standard deviation 1

The first table has faults that begin 200 samples after the reference of 1000: the median delay in samples, "-" if
fewer than half are found within 1000, at one false alarm in 1000 samples for all. The second has records without a
fault: the share of the set rate that "glr" and "cusum" have, one alarm in EVERY samples being set, with two standard
errors. The third has the same under GARCH noise as estimated, and where alpha and beta are known beforehand. The fourth
has inputs that are far from zero, or after the reference beyond those in it.
The rivals get what they need: the residuals of least squares on the reference, times the regressor that changes
(squared for the noise), and limits that were fitted to records without a fault. "GLR, textbook" is the likelihood ratio
of that regressor over the last 8, 16, .., 256 samples, which does not allow for the errors of the reference. "GLR of
all" watches what "glr" does: over the same windows the largest of the likelihood ratios of every parameter, of all
together and of the noise, as normal deviates with one limit.

river and ruptures are compared if they are installed (ruptures is given the whole record and has no delay: the share of
faults that it dates within 50 samples). Run: python benchmarks/frozen_alarms.py [records, 24 by default; eight times
as many for rates and for the delays of likelihood ratios and CUSUM] [--quick]
"""

import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import lru_cache, partial
from importlib.util import find_spec
from typing import Any
from unittest.mock import patch

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from scipy import signal

from driftfit import ARX, Kalman, Regression, Track, track
from driftfit.engine.settings import plain
from driftfit.judge.alarms import frozen
from driftfit.judge.alarms.bootstrap import limits, simulated
from driftfit.judge.alarms.detect import asked_for, judged
from driftfit.judge.alarms.onsets import onsets
from driftfit.judge.alarms.statistics import modelled
from driftfit.run.live.rule import AlarmRule

Array = np.ndarray[Any, Any]
HELD = Kalman(q=0.0, r=1.0)
EVERY, LATER = 300.0, 5000
NORMAL, START, FAULT = 1000, 200, 1000
"""Samples of the reference, before the fault, and of the fault."""
MORE = 8
"""Times as many records for rates, and for the delays of what is quick."""
NOISES = ("normal", "t3", "GARCH(.1, .85)", "AR(.6)", "input regimes", "8 regressors", "ARX(2, 2)")
CHANGING = ("normal", "GARCH(.1, .85)", "GARCH(.15, .8)", "GARCH(.06, .92)", "GARCH(.2, .6)")
FAULTS = ("jump .3", "jump .6", "jump 1.2", "ramp to 1", "noise x 1.5", "1 of 8, .6")


def noise(kind: str, T: int, rng: np.random.Generator) -> Array:
    """Noise (T,) of standard deviation 1."""
    z = rng.standard_t(3, size=T) / np.sqrt(3.0) if kind == "t3" else rng.normal(size=T)
    if kind == "AR(.6)":
        return signal.lfilter([0.8], [1.0, -0.6], z)
    if "GARCH" in kind:
        (alpha, beta), h = reaction_and_memory(kind), 1.0
        for t in range(T):
            z[t] *= np.sqrt(h)
            h = 1.0 - alpha - beta + alpha * z[t] ** 2 + beta * h
    return z


def reaction_and_memory(kind: str) -> tuple[float, float]:
    """alpha and beta of a noise by its name; both 0 if its variance is constant."""
    alpha, beta = kind[6:-1].split(", ") if "GARCH" in kind else ("0", "0")
    return float(alpha), float(beta)


def constant(kind: str, T: int, rng: np.random.Generator) -> Track:
    """A run over a record without a fault."""
    v = noise(kind, T, rng)
    if kind == "ARX(2, 2)":
        u = rng.normal(size=T)
        y = signal.lfilter([0.0, 1.0, 0.4], [1.0, -1.2, 0.5], u) + signal.lfilter([0.3], [1.0, -1.2, 0.5], v)
        return track(ARX(2, 2), HELD, y, u)
    u = rng.normal(size=(T, 7 if kind == "8 regressors" else 1))
    if kind == "input regimes":
        u *= np.where(np.arange(T) // 300 % 2, 3.0, 1.0)[:, None]
    return track(Regression(u.shape[1], intercept=True), HELD, 2.0 * u.sum(axis=1) + 1.0 + v, u)


def begun(run: Track, N: int, seed: int) -> list[float]:
    """Measured over set rate of "glr" and "cusum", whose limits come from the same simulated records."""
    rule, rows, start, _ = modelled(run, asked_for("glr", EVERY), N)
    made, shares = simulated(rule.reference, rows, seed), []
    for alarm in ("glr", "cusum"):
        rule, *_ = modelled(run, asked_for(alarm, EVERY), N)
        found, growth, _ = limits(made, alarm == "cusum", EVERY)
        alarms = judged(run, replace(rule, limits=plain(found), growth=plain(growth)), start)
        shares.append(len(alarms.onsets) * EVERY / LATER)
    return shares


def rate(kind: str, N: int, records: int) -> list[str]:
    """The same as means over records, with two standard errors."""
    each = np.array(
        [begun(constant(kind, N + LATER, np.random.default_rng([seed, N])), N, seed) for seed in fresh(records)]
    )
    return [f"{np.mean(one):.2f} +- {2.0 * np.std(one) / np.sqrt(records):.2f}" for one in each.T]


def fresh(records: int) -> range:
    """Seeds of records on which nothing was chosen."""
    return range(60_000, 60_000 + records)


def rates(lengths: dict[int, int], kinds: tuple[str, ...] = NOISES) -> Table:
    """For references of N samples and so many records."""
    many = ", ".join(f"{records} records for {N}" for N, records in lengths.items())
    title = f"Measured over set rate of false alarms, {LATER} samples after the reference, {many}"
    table = Table(box=SIMPLE_HEAD, show_edge=False, title=title)
    table.add_column("noise")
    for N in lengths:
        for alarm in ("glr", "cusum"):
            table.add_column(f"{alarm}, {N}", justify="right")
    for kind in kinds:
        table.add_row(kind, *(cell for N, records in lengths.items() for cell in rate(kind, N, records)))
    return table


def known(kind: str) -> Array:
    """The prior that leaves only the true alpha and beta."""
    alpha, beta = reaction_and_memory(kind)
    prior = np.isclose(frozen.GARCH[0], alpha) & np.isclose(frozen.GARCH[1], beta)
    assert prior.any(), "only a candidate can be known"
    return np.asarray(prior, float)


def identified(N: int, records: int, kinds: tuple[str, ...]) -> Table:
    title = f"glr, {N}: measured over set rate, {records} records"
    table = Table(box=SIMPLE_HEAD, show_edge=False, title=title)
    for name in ("noise", "alpha, beta estimated", "alpha, beta known"):
        table.add_column(name, justify="left" if name == "noise" else "right")
    for kind in kinds:
        estimated = rate(kind, N, records)[0]
        with patch.object(frozen, "PRIOR", known(kind)):
            table.add_row(kind, estimated, rate(kind, N, records)[0])
    return table


def faulty(fault: str, seed: int) -> tuple[Array, Array]:
    """y (T,) and regressors (T, n) with a fault; with "none" without one."""
    rng = np.random.default_rng([seed, 99])
    T, at = NORMAL + START + FAULT, NORMAL + START
    phi = np.column_stack([rng.normal(size=(T, 7 if "1 of 8" in fault else 1)), np.ones(T)])
    v, theta, after = rng.normal(size=T), np.ones(T), np.arange(T) - at
    size = {"jump .3": 0.3, "jump .6": 0.6, "jump 1.2": 1.2, "1 of 8, .6": 0.6}.get(fault, 0.0)
    theta += size * (after >= 0) if "ramp" not in fault else np.clip(after / 500.0, 0.0, 1.0)
    v *= np.where((after >= 0) & ("noise x" in fault), 1.5, 1.0)
    return phi[:, 0] * theta + phi[:, 1:].sum(axis=1) + v, phi


@lru_cache(maxsize=1000)
def rule(alarm: str, seed: int, n: int) -> AlarmRule:
    """The rule of the reference, which is the same for all faults of n regressors."""
    y, phi = faulty("1 of 8, none" if n > 2 else "none", seed)
    run = track(Regression(n), HELD, y, phi)
    return run.detect(alarm, every=1000.0, reference=NORMAL, seed=seed).rule


def ours(alarm: str, fault: str, seed: int) -> tuple[float, int]:
    """(delay, onsets before the fault)."""
    y, phi = faulty(fault, seed)
    detected = track(Regression(phi.shape[1]), HELD, y, phi).detect(rule(alarm, seed, phi.shape[1]), start=NORMAL)
    return first_of(detected.onsets[detected.onsets >= NORMAL + START]), int(np.sum(detected.onsets < NORMAL + START))


def first_of(places: Array) -> float:
    return float(places[0] - NORMAL - START) if len(places) else np.inf


def stream(fault: str, seed: int) -> tuple[Array, Array]:
    """(scores, their squared regressors) after the reference, as rivals get them, of unit variance in the reference."""
    y, phi = faulty(fault, seed)
    e = y - phi @ np.linalg.lstsq(phi[:NORMAL], y[:NORMAL], rcond=None)[0]
    e /= e[:NORMAL].std()
    x, power = (e * e, np.ones(len(e))) if "noise" in fault else (e * phi[:, 0], phi[:, 0] ** 2)
    mean = x[:NORMAL].mean() if "noise" in fault else 0.0
    return ((x - mean) / x[:NORMAL].std())[NORMAL:], power[NORMAL:]


def textbook(x: Array, power: Array, limit: float) -> Iterator[int]:
    """Onsets of the windowed likelihood ratio."""
    S, G = (np.concatenate([[0.0], np.cumsum(part)]) for part in (x, power))
    best = np.zeros(len(x))
    for L in (8, 16, 32, 64, 128, 256):
        best[L - 1 :] = np.maximum(best[L - 1 :], (S[L:] - S[:-L]) ** 2 / np.maximum(G[L:] - G[:-L], 1e-9))
    return iter(onsets(best > limit))


@lru_cache(maxsize=1000)
def of_all(fault: str, seed: int) -> Array:
    """The largest deviate (T,) over parameters, all together and the noise, and over windows, after the reference."""
    y, phi = faulty(fault, seed)
    e = y - phi @ np.linalg.lstsq(phi[:NORMAL], y[:NORMAL], rcond=None)[0]
    e, phi, n = e[NORMAL:] / e[:NORMAL].std(), phi[NORMAL:], phi.shape[1]
    S, G, Q = (
        np.concatenate([np.zeros((1, *part.shape[1:])), np.cumsum(part, axis=0)])
        for part in (phi * e[:, None], phi[:, :, None] * phi[:, None], e * e)
    )
    best = np.zeros(len(e))
    for L in (8, 16, 32, 64, 128, 256):
        s, g, q = (part[L:] - part[:-L] for part in (S, G, Q))
        one = np.max(np.abs(s) / np.sqrt(np.maximum(np.einsum("tii->ti", g), 1e-9)), axis=1)
        together = np.einsum("ti,tij,tj->t", s, np.linalg.pinv(g, hermitian=True), s)
        every = (one, wilson_hilferty(together / n, n), np.abs(wilson_hilferty(q / L, L)))
        best[L - 1 :] = np.maximum(best[L - 1 :], np.max(every, axis=0))
    return best


def wilson_hilferty(ratio: Array, k: int) -> Array:
    """A chi-square variable with k degrees of freedom, over k, as a normal deviate."""
    return np.asarray((np.cbrt(ratio) - 1.0 + 2.0 / (9.0 * k)) / np.sqrt(2.0 / (9.0 * k)))


def found_by_all(fault: str, records: int) -> str:
    """Delays of the textbook ratio that watches everything."""
    null = [of_all(without(fault), 10_000 + seed) for seed in range(300 if records > 5 else 2)]
    low, high = 1.0, 10.0
    for _ in range(12):
        middle = 0.5 * (low + high)
        often = sum(len(onsets(one > middle)) for one in null) > sum(map(len, null)) / 1000.0
        low, high = (middle, high) if often else (low, middle)
    found = [onsets(of_all(fault, seed) > high) for seed in fresh(records)]
    return told([first_of(one[one >= START] + NORMAL) for one in found])


def of_river(make: Callable[[float], Any], x: Array, power: Array, limit: float) -> Iterator[int]:
    """Drifts that a detector of river reports."""
    detector = make(limit)
    for t, value in enumerate(x):
        detector.update(value)
        if detector.drift_detected:
            yield t


Rival = Callable[[Array, Array, float], Iterator[int]]


def rivals() -> dict[str, tuple[Rival, float, float, int]]:
    """Onsets at a limit, the range of limits, and records for its calibration."""
    found: dict[str, tuple[Rival, float, float, int]] = {"GLR, textbook": (textbook, 3.0, 500.0, 100)}
    if find_spec("river"):
        from river import drift

        found["Page-Hinkley (river)"] = (
            partial(of_river, lambda limit: drift.PageHinkley(delta=0.1, threshold=limit)), 2.0, 300.0, 40
        )  # fmt: skip
        found["ADWIN (river)"] = (partial(of_river, lambda limit: drift.ADWIN(delta=10.0**-limit)), 0.1, 8.0, 30)
        found["KSWIN (river)"] = (partial(of_river, lambda limit: drift.KSWIN(alpha=10.0**-limit, seed=1)), 1.5, 8.0, 4)
    return found


def without(fault: str) -> str:
    """The record without a fault that belongs to one."""
    return "noise, none" if "noise" in fault else "none, 1 of 8" if "1 of 8" in fault else "none"


@lru_cache
def calibrated(rival: Rival, kind: str, low: float, high: float, records: int) -> float:
    """The limit with one onset in 1000 samples, by bisection over records without a fault."""
    made = [stream(kind, 10_000 + seed) for seed in range(records)]
    allowed = sum(len(x) for x, _ in made) / 1000.0
    for _ in range(7 if records > 2 else 1):  # two records are no calibration: to see that it works
        middle = np.sqrt(low * high)
        begun = sum(len(list(rival(x, power, middle))) for x, power in made)
        low, high = (middle, high) if begun > allowed else (low, middle)
    return float(high)


def breaks(x: Array, power: Array, limit: float) -> Iterator[int]:
    """Dates of ruptures, which is given the whole record."""
    import ruptures

    return iter(ruptures.Pelt(model="l2", min_size=8, jump=8).fit(x).predict(pen=limit)[:-1])


def dated(fault: str, records: int) -> str:
    """Share of the faults that ruptures dates within 50 samples."""
    limit = calibrated(breaks, without(fault), 3.0, 60.0, 8 if records > 5 else 2)
    dates = [np.array(list(breaks(*stream(fault, seed), limit))) for seed in range(records)]
    return f"{100.0 * np.mean([(np.abs(one - START) < 50).any() for one in dates]):.0f} %"


INPUTS = {
    "as in the reference": (0.0, 1.0, 1.0),
    "50 from zero": (50.0, 1.0, 1.0),
    "0 before": (0.0, 0.0, 1.0),
    "hardly moved before": (0.0, 0.01, 1.0),
    "5 times as large": (0.0, 1.0, 5.0),
    "20 times as large": (0.0, 1.0, 20.0),
}
"""Mean of the second input, and its standard deviations in the reference and later."""


def unlike(which: str, seed: int, T: int) -> tuple[Array, Array]:
    """y (T,) without a fault and inputs (T, 2), the second of which is as ``which`` says, in standard deviations."""
    rng = np.random.default_rng([seed, 7])
    u, v, later = rng.normal(size=(T, 2)), rng.normal(size=T), np.arange(T) >= NORMAL
    mean, before, since = INPUTS[which]
    u[:, 1] = mean + u[:, 1] * np.where(later, since, before)
    return 2.0 * u.sum(axis=1) + 1.0 + v, u


def unlike_cells(alarm: str, which: str, seed: int) -> tuple[float, ...]:
    """False alarms over those set; delays of steps of 0.6 of the first gain, the level, and the second gain, which is
    that about the mean and in units of the second input's later variation.
    """
    y, u = unlike(which, seed, NORMAL + LATER)
    model = Regression(2, intercept=True)
    rule = track(model, HELD, y, u).detect(alarm, every=1000.0, reference=NORMAL, seed=seed).rule
    false = len(track(model, HELD, y, u).detect(rule, start=NORMAL).onsets) * 1000.0 / LATER
    T = NORMAL + START + FAULT
    after, second = np.arange(T) >= NORMAL + START, u[:T, 1] - u[NORMAL:T, 1].mean()
    found = [false]
    for step in (u[:T, 0], np.ones(T), second / second[NORMAL:].std()):
        onsets = track(model, HELD, y[:T] + 0.6 * step * after, u[:T]).detect(rule, start=NORMAL).onsets
        found.append(first_of(onsets[onsets >= NORMAL + START]))
    return tuple(found)


def beyond(records: int, inputs: Iterable[str]) -> Table:
    title = f"Median delay (share found) of steps of 0.6, {records} records"
    table = Table(box=SIMPLE_HEAD, show_edge=False, title=title)
    for name in ("second input", "alarm", "first gain", "level", "second gain", "measured over set rate"):
        table.add_column(name, justify="left" if name in ("second input", "alarm") else "right")
    for which in inputs:
        for alarm in ("glr", "cusum"):
            false, *late = zip(*(unlike_cells(alarm, which, seed) for seed in fresh(records)), strict=True)
            spread = 2.0 * np.std(false) / np.sqrt(records)
            table.add_row(which, alarm, *(told(list(one)) for one in late), f"{np.mean(false):.2f} +- {spread:.2f}")
    return table


def told(delays: list[float]) -> str:
    middle, share = np.median(delays), np.mean(np.isfinite(delays))
    return (f"{middle:.0f}" if np.isfinite(middle) else "-") + (f" ({100.0 * share:.0f} %)" if share < 1.0 else "")


def delays(records: int, faults: tuple[str, ...]) -> Table:
    """Those of likelihood ratios and CUSUM on eight times as many records: the median of few is off by a fifth."""
    many = MORE * records if records > 5 else records
    title = f"Median delay in samples (share found), one false alarm in 1000: {many} records, * {records}"
    table = Table(box=SIMPLE_HEAD, show_edge=False, title=title)
    table.add_column("alarm")
    for fault in faults:
        table.add_column(fault, justify="right")
    false, count = {"glr": 0, "cusum": 0}, many * START * len(faults) / 1000.0
    for alarm in false:
        cells = []
        for fault in faults:
            found = [ours(alarm, fault, seed) for seed in fresh(many)]
            false[alarm] += sum(before for _, before in found)
            cells.append(told([delay for delay, _ in found]))
        table.add_row(alarm, *cells)
    table.add_row("GLR of all", *(found_by_all(fault, many) for fault in faults))
    for name, (rival, low, high, made) in rivals().items():
        cells, some = [], many if rival is textbook else records
        for fault in faults:
            limit = calibrated(rival, without(fault), low, high, made if records > 5 else 2)
            found = [np.array(list(rival(*stream(fault, seed), limit)), int) for seed in fresh(some)]
            cells.append(told([first_of(one[one >= START] + NORMAL) for one in found]))
        table.add_row(name + (" *" if some < many else ""), *cells)
    if find_spec("ruptures"):
        table.add_row("ruptures, off line *", *(dated(fault, min(records, 12)) for fault in faults))
    table.caption = ", ".join(f"{name}: {n} false alarms, {count:.0f} expected" for name, n in false.items())
    return table


def main(records: int = 24, quick: bool = False) -> None:
    lengths = {300: MORE * records, 1000: MORE * records // 2}
    Console(width=120).print(delays(records, FAULTS[1:2] if quick else FAULTS))
    Console(width=120).print(rates({300: 4} if quick else lengths, NOISES[::6] if quick else NOISES))
    Console(width=120).print(identified(300, 4 * records, CHANGING[:1] if quick else CHANGING))
    Console(width=120).print(beyond(records, ("50 from zero",) if quick else INPUTS))


if __name__ == "__main__":
    if "--quick" in sys.argv:
        main(2, quick=True)
    else:
        main(*map(int, sys.argv[1:2]))
