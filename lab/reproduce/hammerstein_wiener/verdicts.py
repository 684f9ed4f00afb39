"""The verdict on each claim of the paper: functions of numbers, each with its rule.

Arrivals are (samples until the error is small for good, median over the runs that arrive; share of runs that do).
"""

from __future__ import annotations

from collections.abc import Mapping

from lab.reproduce import Claim
from lab.reproduce.hammerstein_wiener.runs import CLOSE

UNKNOWNS = 14
Arrivals = Mapping[float, tuple[float, float]]


def start(rows: Arrivals) -> Claim:
    """Example 2: arrivals of stage one and separation by the start."""
    text = ", ".join(f"{samples:.0f} from theta0 = {k:g}" for k, (samples, _) in rows.items())
    whole = all(share == 1.0 and samples <= 2 * UNKNOWNS for samples, share in rows.values())
    return Claim(
        "Estimates reach a small error from any start",
        "holds without noise and with P0 = 1e8 I" if whole else "not in all runs",
        f"all runs arrive, in the median within twice as many samples as there are unknowns, {UNKNOWNS}.",
        f"samples until the error is below {CLOSE:g} for good: {text}, for {UNKNOWNS} unknowns.",
    )


def rivals(rows: Arrivals, two_stage: float) -> Claim:
    """Example 2: arrivals of the extended Kalman filter, and the samples that stage one needs from 0.01."""
    text = ", ".join(
        f"{samples:.0f} ({100 * share:.0f} % arrive) from {k:g}" if share else f"no run arrives from {k:g}"
        for k, (samples, share) in rows.items()
    )
    slower, fails = rows[0.01][0] > 1.5 * two_stage, rows[1000.0][1] < 0.5
    return Claim(
        "The extended Kalman filter is slower from 0.01 and fails from 1000",
        {(True, True): "holds", (True, False): "it is slower, and does not fail",
         (False, True): "it fails, and is not slower", (False, False): "does not hold"}[slower, fails],
        "it needs half as many samples again from 0.01, and fewer than half of the runs arrive from 1000.",
        f"samples it needs: {text}.",
    )  # fmt: skip


def separation(found: Mapping[str, tuple[float, float]], printed: float) -> Claim:
    """Example 1: (median error, worst rms) by the method, and the median of the SVD as printed."""
    (ave, spikes), (svd, worst), (joint, _), (gls, _) = (found[m] for m in ("average", "svd", "svd-joint", "gls"))
    through = "only through the spikes of AVE" if spikes > 3.0 * worst else "not in these runs"
    return Claim(
        "SVD is more accurate than AVE",
        "holds" if svd < 0.9 * ave else through,
        "its median error is a tenth smaller; or, through spikes, only its worst rms is a third.",
        f"medians {svd:.4f} and {ave:.4f}, worst rms {worst:.3f} and {spikes:.3g}; svd-joint has {joint:.4f}, gls "
        f"{gls:.4f}. The SVD as printed, without a scale, has {printed:.2g}.",
    )


def drift(fast: float, slow: float) -> Claim:
    """Equation 60: errors at 20 dB with Q/R = 1e3 and 1e-3."""
    return Claim(
        "A larger Q reduces the error (60)",
        "holds" if fast < slow else "only without noise",
        "the error at 20 dB is smaller with the larger Q.",
        f"at 20 dB the error goes from {slow:.3f} with Q/R = 1e-3 to {fast:.2f} with 1e3. The bounds of P depend on Q, "
        "so that (60) is no argument.",
    )


def noise(n: Mapping[str, float]) -> Claim:
    """Example 3: errors at 20 dB with the paper's Q and R ("fast") and otherwise, without noise ("clean"), and bias."""
    return Claim(
        "Measurement noise has no obvious effect (example 3)",
        "holds" if n["fast"] <= 2.0 * n["clean"] else "we could not reproduce it with a small R",
        "the error at 20 dB is at most twice that without noise.",
        f"at 20 dB the error is {n['fast']:.2f}, without noise {n['clean']:.3f}; keeping the initial values for ever "
        f"has {n['start']:.2f}. A noise-aware R has {n['aware']:.3f}, the output-error filter {n['output error']:.3f}. "
        f"Least squares on a constant system is off by {n['bias']:.3f} at 20 dB, however long the record.",
    )


def order(raw: Mapping[int, float], share: float, legendre: tuple[float, float, float]) -> Claim:
    """Example 4: Er by the order of raw powers, the share of b in it; of Legendre polynomials the squared errors of a
    and of p, and the local gain over the true one.
    """
    text = ", ".join(f"{error:.2f} (q = {q})" for q, error in raw.items())
    fails = "we could not reproduce it with raw powers" if len(raw) > 1 else "not judged with one order"
    a, p, gain = legendre
    return Claim(
        "A higher order is more accurate (example 4)",
        "holds" if len(raw) > 1 and raw[max(raw)] < raw[min(raw)] else fails,
        "Er is smaller with the highest order than with the lowest.",
        f"Er of (67) is {text}; its b part is {100 * share:.1f} % of that, and with d_1 = 1 b_1 is not 0.0378. "
        f"Legendre polynomials of order 4 have squared errors of a of {a:.0e} and of p of {p:.0e}, and the local gain "
        f"is {gain:.2f} of the true one.",
    )


def bound(low: float, high: float, limit: float, actual: float) -> Claim:
    """Theorem 1: eigenvalues of P, the bound of the mean square that they give, and the mean square."""
    useful = "correct, and an error bar" if limit <= 10.0 * actual else "correct, and no error bar"
    return Claim(
        "The error is bounded (theorem 1)",
        useful if actual <= limit else "does not hold",
        "the mean square is below the bound, which is an error bar if it is at most ten times as large.",
        f"eigenvalues of P between {low:.1g} and {high:.3g} give a mean square of at most {limit:.2g}; it is "
        f"{actual:.1g}, {limit / actual:.0e} times less. Theorem 2 needs c away from 0 and bounds estimates, not "
        "errors.",
    )


def effort(row: Mapping[str, float]) -> Claim:
    """Remark 4: nanoseconds per sample of the filter and of both separations."""
    less, able = row["average"] < row["svd"], row["svd"] <= 10.0 * row["filter"]
    return Claim(
        "AVE needs less computation than SVD, which still can run on line (remark 4)",
        "holds" if less and able else "AVE is not faster" if able else "SVD is too slow",
        "AVE takes less time, and SVD at most ten times that of a step of the filter.",
        "the table of nanoseconds compares them, here for the orders of the examples.",
    )
