"""The runs behind the reproduction: every method on one record of one example, condensed to errors.

Settings are those of the paper where it prints them: P0 = 1e8 I, Q = 10 I, theta0 = 0.01, and r = 0.01, which it only
calls small. Errors are those of the eight minimal parameters, |xi_hat - xi|.
"""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.models.hammerstein_wiener.basis import Legendre, Polynomial
from driftfit.models.hammerstein_wiener.extended_kalman import ExtendedKalman
from driftfit.models.hammerstein_wiener.model import HammersteinWiener
from driftfit.models.hammerstein_wiener.output_curve import Inverse
from driftfit.models.hammerstein_wiener.output_error import OutputError
from driftfit.models.hammerstein_wiener.thresholds import DeadZone
from driftfit.results import Track
from driftfit.smooth.problem import replay
from driftfit.systems.arc_furnace import THRESHOLDS, A, B, Furnace
from driftfit.systems.hammerstein_wiener import CUBIC, WALK, Simulated, example
from driftfit.trackers.kalman import Kalman
from driftfit.tracking import track
from driftfit.use.blocks import free_run
from driftfit.use.output_error import output_error

PAPER = Kalman(q=10.0, r=0.01, p0=1e8, theta0=0.01)
FAST = ExtendedKalman(q=10.0, r=0.01, p0=1e8, theta0=0.01)
STARTS = (0.01, 10.0, 1000.0)
CLOSE, STAY = 0.15, 200
"""An estimate has arrived when its error is below CLOSE for STAY samples on end."""
LAST, BURN = 1000, 200


class Errors(NamedTuple):
    """Median of an error over the last thousand samples, and its root mean square after the first BURN."""

    median: float
    rms: float


def off(xi: Array, s: Simulated, start: int = 0) -> Array:
    """|xi_hat - xi| at every sample, (T,)."""
    return np.asarray(np.linalg.norm(xi - s.xi[start:], axis=1))


def late(error: Array) -> Errors:
    """A path of errors, condensed."""
    return Errors(float(np.median(error[-LAST:])), float(np.sqrt(np.mean(error[BURN:] ** 2))))


def rms(error: Array) -> float:
    """Root mean square of the last four thousand samples."""
    return float(np.sqrt(np.nanmean(error[-4000:] ** 2)))


def one_step(run: Track, s: Simulated) -> Array:
    """Predictions (T,), inverted on the range of the whole record, widened by a fifth at both ends.

    Those of the run itself are inverted on the range until then, and clipped to it.
    """
    phi, late = replay(run)["phi"][1:, :, 0], run.theta[:-1]
    at = s.model.structure.starts[0]
    right = -np.sum(np.delete(phi * late, range(at, at + s.model.out.n - 1), axis=1), axis=1)
    invert = Inverse(s.model, s.model.output_weights(late), (s.y.min(), s.y.max()))
    return np.concatenate([[np.nan], invert(right)])


def separated(run: Track, method: str) -> Array:
    """xi by a method, without the warnings that a user gets."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return run.blocks(method).xi


def printed(theta: Array) -> Array:
    """The separation as the paper prints it: left and right vectors as they come, without a scale."""
    U, S, Vt = np.linalg.svd(np.stack([theta[:, 6:8], theta[:, 8:10]], axis=2))
    b = S[:, :1] * U[:, :, 0]
    c = Vt[:, 0, :]
    U, S, Vt = np.linalg.svd(np.stack([theta[:, 10:12], theta[:, 12:14]], axis=2))
    return np.concatenate([S[:, :1] * U[:, :, 0], b, c, Vt[:, 0, :]], axis=1)


def structured(s: Simulated, q: float, r: float, every: int = 100) -> Array:
    """xi (T, n_x) by a filter whose drift is that of products of walking factors, J q J' at the xi of each piece."""
    xi, run, paths = s.xi[0], None, []
    for first in range(0, len(s.y), every):
        J, part = s.model.structure.jacobian(xi), slice(first, first + every)
        tracker = Kalman(q=q * (J @ J.T + 1e-3 * np.eye(s.model.n)), r=r, p0=1e8, theta0=0.01)
        run = track(s.model, tracker, s.y[part], s.u[part], warm_start=run)
        paths.append(separated(run, "gls"))
        xi = separated(run, "svd-joint")[-1]
    return np.concatenate(paths)


def handed_over(
    model: HammersteinWiener, first: Kalman, then: ExtendedKalman | OutputError, s: Simulated, at: int
) -> Track:
    """A filter of minimal parameters that goes on from the separation of stage one after sample ``at``."""
    found, after = track(model, first, s.y, s.u).blocks("gls"), (np.arange(len(s.y)) > at).astype(float)
    assert found.xi_cov is not None
    tracker = replace(then, theta0=found.xi[at], p0=found.xi_cov[at])
    return track(model, tracker, s.y, s.u, weights=after, drift=after)


def first_example(seed: int, quick: bool = False) -> dict[str, Errors | float]:
    """Example 1, or what costs little of it."""
    s = example(1, seed)
    run = track(s.model, PAPER, s.y, s.u)
    methods = ("average", "svd", "svd-joint", "gls")[: 3 if quick else 4]
    found: dict[str, Errors | float] = {m: late(off(separated(run, m), s)) for m in methods}
    found["printed"] = late(off(printed(run.theta), s))
    found["one-step"] = rms(s.y - one_step(run, s))
    if quick:
        return found
    found["structured"] = late(off(structured(s, WALK**2, 1e-6), s))
    found["ekf"] = late(off(track(s.model, FAST, s.y, s.u).theta, s))
    found["free run"] = rms(s.y - free_run(run, "gls").y)
    return found


def arrival(error: Array) -> float:
    """The sample from which on the error is small for STAY samples, counted from 0; inf where there is none."""
    small = np.convolve(error < CLOSE, np.ones(STAY), "valid") >= STAY - 0.5
    return float(np.argmax(small)) if small.any() else float("inf")


def second_example(seed: int, quick: bool = False, T: int = 1500) -> dict[tuple[str, float], float]:
    """Example 2: samples to arrive from each start, of the two stages alone if it is to be quick."""
    s = example(2, seed, T=T)
    found = {}
    for start in STARTS:
        run = track(s.model, replace(PAPER, theta0=start), s.y, s.u)
        found["two-stage", start] = arrival(off(separated(run, "svd-joint"), s))
        for name, inflation in () if quick else (("ekf", 0.0), ("inflated", 1.0)):
            ekf = replace(FAST, theta0=start, inflation=inflation)
            found[name, start] = arrival(np.nan_to_num(off(track(s.model, ekf, s.y, s.u).theta, s), nan=np.inf))
    return found


def third_example(seed: int) -> dict[str, Errors | float]:
    """Example 3, without noise and at 20 dB."""
    s = example(3, seed)
    run = track(s.model, PAPER, s.y, s.u)
    found: dict[str, Errors | float] = {"clean svd-joint": late(off(separated(run, "svd-joint"), s))}
    clean = ExtendedKalman(q=4e-6, r=1e-6, p0=1e8, theta0=0.01)
    found["clean ekf"] = late(off(track(s.model, clean, s.y, s.u).theta, s))
    s = example(3, seed, snr_db=20.0)
    run = track(s.model, PAPER, s.y, s.u)
    found |= {f"noisy {m}": late(off(separated(run, m), s)) for m in ("average", "svd-joint")}
    found["noisy start"] = late(off(np.repeat(s.xi[:1], len(s.y), axis=0), s))
    found["noisy one-step"] = rms(s.y0 - one_step(run, s))
    slow = track(s.model, Kalman(q=1e-3, r=1.0, p0=1e8, theta0=0.01), s.y, s.u)
    found["slow svd-joint"] = late(off(separated(slow, "svd-joint"), s))
    found["slow one-step"] = rms(s.y0 - one_step(slow, s))
    found["slow free run"] = rms(s.y0 - free_run(slow).y)
    aware = replace(CUBIC, output_noise=s.sigma)
    stage = Kalman(q=4e-6, r=1.0, p0=1e4, theta0=0.01)
    found["aware gls"] = late(off(separated(track(aware, stage, s.y, s.u), "gls"), s))
    found["aware ekf"] = late(off(track(aware, ExtendedKalman(q=4e-6, r=1.0, p0=1.0), s.y, s.u).theta, s))
    handed = handed_over(aware, stage, OutputError(q=4e-6, r=s.sigma**2), s, 300)
    found["output error"] = late(off(handed.theta[301:], s, 301))
    found["nis"] = float(np.nanmean((handed.innovation / handed.innovation_std)[401:] ** 2))
    return found


def furnace_model(f: Furnace, degree: int, raw: bool, method: str) -> HammersteinWiener:
    """A dead zone and an output block of a degree, in raw powers or on the range of the data.

    Thresholds that the paper's separation gives ("average") are those that it feeds back.
    """
    fed = "average" if method == "average" else "least-squares"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        out = Polynomial(degree) if raw else Legendre(degree, (float(f.R.min()), float(f.R.max())))
        return HammersteinWiener(3, 3, input=DeadZone(float(np.abs(f.u).max()), fed=fed), output=out)


class FurnaceRun(NamedTuple):
    """Squared errors of a, b and the thresholds (T,), local gain over the true one (T,), equation error (T,)."""

    a: Array
    b: Array
    p: Array
    gain: Array
    equation: Array


def fourth_example(f: Furnace, degree: int, raw: bool, method: str) -> FurnaceRun:
    """Example 4."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        model = furnace_model(f, degree, raw, method)
        run = track(model, Kalman(q=1.0, r=0.01, p0=1e8, theta0=0.01), f.R, f.u)
        found = run.blocks(method)
    a, b, p = (
        np.sum((part - np.array(truth)) ** 2, axis=1)
        for part, truth in ((found.a, A), (found.b, B), (found.c[:, 1:], THRESHOLDS))
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        gain = found.b[:, 0] / found.slope(f.R) / (B[0] / f.length_per_resistance)
    return FurnaceRun(a, b, p, gain, run.innovation)


def misfit(snr_db: float | None, equation_noise: float, seed: int, T: int = 5000) -> Array:
    """xi_hat - xi (8,) of batch least squares on a constant system; its mean over seeds is the bias."""
    from driftfit.systems.hammerstein_wiener import START, simulate

    rng = np.random.default_rng(seed)
    s = simulate(CUBIC, *(START[name] for name in "abcd"), T=T, rng=rng, snr_db=snr_db, equation_noise=equation_noise)
    return np.asarray(separated(constant(s), "svd-joint")[-1] - s.xi[-1])


def constant(s: Simulated) -> Track:
    """Least squares with constant parameters."""
    return track(CUBIC, Kalman(q=0.0, r=1.0, p0=1e8), s.y, s.u)


FIXES = ("least squares", "output_error")


def fixes(seed: int, T: int = 20_000) -> dict[str, float]:
    """|xi_hat - xi| on a constant system at 20 dB, by least squares and by the method that removes the bias."""
    from driftfit.systems.hammerstein_wiener import START, simulate

    groups = (START[name] for name in "abcd")
    s = simulate(CUBIC, *groups, T=T, rng=np.random.default_rng(seed), snr_db=20.0)
    run = constant(s)
    fits = separated(run, "svd-joint")[-1], output_error(run, q=0.0, q_w=0.0).theta[-1]
    return {name: float(np.linalg.norm(xi - s.xi[0])) for name, xi in zip(FIXES, fits, strict=True)}


def choice(name: str, seed: int, T: int = 5000) -> float:
    """The ratio q / r of the largest likelihood of y over a record: without noise, at 30 or 20 dB."""
    s = example(1, seed, T=T) if name == "noise-free" else example(3, seed, T=T, snr_db=float(name.split()[0]))
    ratios = [10.0**k for k in range(-4, 3)]
    runs = track(s.model, [Kalman(q=ratio, r=1.0, p0=1e8, theta0=0.01) for ratio in ratios], s.y, s.u)
    return ratios[int(np.argmax([concentrated(s.model, runs[k]) for k in range(len(ratios))]))]


def concentrated(model: HammersteinWiener, run: Track) -> float:
    """Log-likelihood of y after the first BURN samples, with the scale of noise and drift that maximises it."""
    e, s = run.innovation[BURN:], run.innovation_std[BURN:] ** 2
    variance = np.mean(e * e / s)
    jacobian = model.log_jacobian(run.theta, run.y)[BURN:]
    return float(np.sum(jacobian - 0.5 * np.log(variance * s)))
