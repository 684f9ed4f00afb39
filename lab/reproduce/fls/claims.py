"""The claims of the paper, measured."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from rich.console import Console

from driftfit.engine.kernel import Array
from driftfit.models.regression import Regression
from driftfit.run.result import root_mean_square as rms
from driftfit.smooth.augmented import augmented
from driftfit.smooth.smoothed import Smoothed
from driftfit.systems.time_varying import MU, Simulated, example, hammerstein, sinusoids, switching
from driftfit.trackers.augmented_fls import AugmentedFLS
from driftfit.trackers.fls import FLS
from driftfit.tracking import track
from driftfit.tune.tune import tune
from driftfit.tune.tuned import Tuned
from lab.reproduce import Claim
from lab.reproduce.fls import METHODS
from lab.reproduce.fls.selectors import choose
from lab.reproduce.fls.verdicts import (
    Accuracy,
    judge_accuracy,
    judge_convergence,
    judge_cost,
    judge_count,
    judge_iteration,
    judge_lag,
    judge_limits,
    judge_output_fit,
    judge_structure,
    judge_weights,
)

ONLINE, SWEPT, FILTERED, EXACT = METHODS[:4]


def share(found: dict[str, Array], name: str, better: str, than: str, kind: int = 0) -> float:
    """Percentage of seeds in which one method has the smaller error."""
    a, b = METHODS.index(better), METHODS.index(than)
    return float(100.0 * np.mean(found[name][:, a, kind] < found[name][:, b, kind]))


def accuracy(found: dict[str, Array], seeds: Sequence[int]) -> Claim:
    """Section 6.2."""
    a = share(found, "rational", ONLINE, FILTERED)
    b = share(found, "rational", ONLINE, EXACT)
    c = share(found, "rational", ONLINE, FILTERED, 1)
    others = {n: share(found, n, ONLINE, FILTERED) for n in ("sinusoids", "switching", "exp-ar")}
    exact = {n: share(found, n, EXACT, ONLINE) for n in ("sinusoids", "switching", "exp-ar")}
    fair = [
        np.median([_error(example("rational", s), FLS(mu, 1e-6, 1.0 / mu), smooth=True) for s in seeds])
        for mu in (3.2, 10.0, 32.0)
    ]
    online = [np.median([_error(example("rational", s), AugmentedFLS(mu)) for s in seeds]) for mu in (1.0, 3.2, 10.0)]
    return judge_accuracy(Accuracy(a, b, c, float(min(online)), float(min(fair)), others, exact))


def _error(d: Simulated, tracker: AugmentedFLS | FLS, smooth: bool = False) -> float:
    run = track(d.model, tracker, d.y, d.u)
    theta = run.smooth().theta if smooth else run.theta
    after = max(2, len(d.y) // 5)
    return rms((theta - d.theta)[after:])


def lag(found: dict[str, Array]) -> Claim:
    """Example 1."""
    error = float(np.median(found["sinusoids"][:, METHODS.index(ONLINE), 0]))
    d = sinusoids(std=0.0, rng=np.random.default_rng(0))
    clean = _error(d, AugmentedFLS(MU["sinusoids"]))
    after = max(2, len(d.y) // 5)
    theta = track(d.model, AugmentedFLS(MU["sinusoids"]), d.y, d.u).theta
    shifts = [rms(theta[after:] - d.theta[after - k : len(d.y) - k]) for k in range(6)]
    signal = rms(d.theta[after:])
    return judge_lag(error, clean, signal, int(np.argmin(shifts)))


def output_fit(found: dict[str, Array], seeds: Sequence[int]) -> Claim:
    """Prior or posterior."""
    medians = {name: np.median(values[:, METHODS.index(ONLINE)], axis=0) for name, values in found.items()}
    signal, after, before = np.median([_blind(s) for s in seeds], axis=0)
    return judge_output_fit({name: float(m[2] / m[1]) for name, m in medians.items()}, signal, after, before)


def _blind(s: int) -> tuple[float, float, float]:
    """Rms of the switching output, and of its a-posteriori and one-step errors on regressors that are pure noise."""
    d = example("switching", s)
    noise = np.random.default_rng(s).normal(size=d.phi.shape)
    run = track(Regression(2), AugmentedFLS(MU["switching"]), d.y, noise)
    after = d.y - np.sum(noise * run.theta, axis=1)
    return rms(d.y[40:]), rms(after[40:]), rms(run.innovation[40:])


def convergence() -> Claim:
    """Section 5.3: 3000 samples of one mode, with and without noise."""
    floors = []
    for std in (0.2, 0.0):
        d = switching(3000, std, rng=np.random.default_rng(3), at=())
        theta = track(d.model, AugmentedFLS(MU["switching"]), d.y, d.u).theta
        floors.append(rms((theta - d.theta)[1000:]))
    return judge_convergence(*floors)


def weights(seeds: Sequence[int]) -> Claim:
    """Section 6, end."""
    chosen, noise = {}, {}
    for name in MU:
        tuned = [choose(example(name, s), "ml") for s in seeds]
        chosen[name] = float(np.median([t.chosen["mu"] for t in tuned]))
        noise[name] = float(np.median([t.noise for t in tuned]))
    return judge_weights(chosen, noise["sinusoids"])


def structure() -> Claim:
    """Feature 1 and section 2.1."""
    found = []
    for along in (False, True):
        rng = np.random.default_rng(5)
        d = hammerstein(rng.uniform(-1.5, 1.5, 300), np.square, rng=rng)
        lagged = d.phi[:, 1]
        order = lagged if along else None
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            tuned = tune(d.model, FLS(), d.y, d.u, method="loo", groups="each", order_by=order)
        assert isinstance(tuned, Tuned)  # one output
        path = track(d.model, tuned.tracker, d.y, d.u).smooth(order_by=order)
        found.append(rms((path.theta[:, 1] * lagged - lagged**2)[1:]))
    return judge_structure(*found)


def limits() -> Claim:
    """Section 5.2."""
    d = example("sinusoids")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        path = Smoothed.of(track(d.model, FLS(1e-9), d.y, d.u))
    frozen = track(d.model, AugmentedFLS(1e12), d.y, d.u).theta
    constant = np.linalg.lstsq(d.phi, d.y, rcond=None)[0]
    apart = np.abs(track(d.model, FLS(1e12), d.y, d.u).smooth().theta - constant).max()
    largest, gone = float(np.abs(path.theta).max()), float(np.abs(frozen - 1e-6).max())
    return judge_limits(largest, path.measurement_cost, gone, float(apart))


def iteration(seeds: Sequence[int]) -> Claim:
    """Section 4.3."""
    names: dict[float, list[float]] = {0.5: [], 0.01: [], 0.001: []}
    exact, corrected = [], []
    for s in seeds:
        d = example("sinusoids", s)
        after = max(2, len(d.y) // 5)
        run = track(d.model, AugmentedFLS(MU["sinusoids"]), d.y, d.u)
        path = track(d.model, FLS(MU["sinusoids"]), d.y, d.u).smooth().theta
        exact.append(rms((path - d.theta)[after:]))
        corrected.append(np.abs(augmented(run, schedule="constant").theta - path).max())
        for tol, errors in names.items():
            errors.append(rms((augmented(run, lam=0.9, tol=tol).theta - d.theta)[after:]))
    medians = {tol: float(np.median(e)) for tol, e in names.items()}
    return judge_iteration(medians, float(np.median(exact)), float(max(corrected)))


def count() -> Claim:
    """Example 1 and Remark 6."""
    d = example("sinusoids")
    path = track(d.model, FLS(MU["sinusoids"]), d.y, d.u).smooth()
    return judge_count(len(d.y), d.theta.size, float(path.std.max()))


def cost(times: dict[str, dict[int, float]]) -> Claim:
    """Remarks 7 and 9."""
    L = max(times["dense inverse"])
    return judge_cost(L, {name: row[L] for name, row in times.items() if L in row})


def all_claims(
    found: dict[str, Array], seeds: Sequence[int], times: dict[str, dict[int, float]] | None
) -> Iterator[tuple[int, Claim]]:
    """In the order of the paper's sections, with their numbers; without times only those that take little of it."""
    if times is not None:
        yield 1, accuracy(found, seeds)
    yield 2, lag(found)
    if times is not None:
        yield 3, cost(times)
    yield 4, output_fit(found, seeds)
    yield 5, convergence()
    if times is not None:
        yield 6, weights(seeds)
    yield from ((7, structure()), (8, limits()))
    if times is not None:
        yield 9, iteration(seeds)
    yield 10, count()


def show(out: Console, claims: Iterable[tuple[int, Claim]]) -> None:
    """Print claim, verdict and numbers."""
    for number, claim in claims:
        out.print(f"{number}. {claim.claim}: [bold]{claim.verdict}[/bold].")
        out.print(claim.text(100, "   "))
