"""What the claims of the paper come to when they are measured."""

from __future__ import annotations

from textwrap import fill, indent
from typing import NamedTuple

import numpy as np
from rich.console import Console

from driftfit.systems.hammerstein_wiener import WALK, example
from driftfit.track import track
from lab.reproduce.hammerstein_wiener.runs import CLOSE, PAPER
from lab.reproduce.hammerstein_wiener.tables import Found, arrivals, end, gains, total, values


class Claim(NamedTuple):
    """What is claimed, whether it holds, and what was measured."""

    claim: str
    verdict: str
    measured: str


def all_claims(found: Found, times: dict[tuple[int, ...], dict[str, float]]) -> list[Claim]:
    """Every claim, in the order of the paper."""
    return [
        start(found), rivals(found), separation(found), drift(found), noise(found), order(found), bound(),
        effort(times),
    ]  # fmt: skip


def start(found: Found) -> Claim:
    """Example 2."""
    rows = {k: arrivals(found, ("two-stage", k)) for k in (0.01, 10.0, 1000.0)}
    told = ", ".join(f"{samples:.0f} from theta0 = {k:g}" for k, (samples, _) in rows.items())
    whole = all(share == 1.0 for _, share in rows.values())
    return Claim(
        "Estimates reach a small error from any start",
        "holds without noise and with P0 = 1e8 I" if whole else "not in all runs",
        f"samples until the error is below {CLOSE:g} for good: {told}, for 14 unknowns.",
    )


def rivals(found: Found) -> Claim:
    """Example 2, against the extended Kalman filter."""
    rows = {k: arrivals(found, ("ekf", k)) for k in (0.01, 10.0, 1000.0)}
    told = ", ".join(
        f"{samples:.0f} ({100 * share:.0f} % arrive) from {k:g}" if share else f"no run arrives from {k:g}"
        for k, (samples, share) in rows.items()
    )
    return Claim(
        "The extended Kalman filter is slower from 0.01 and fails from 1000", "holds", f"samples it needs: {told}."
    )


def separation(found: Found) -> Claim:
    """Example 1."""
    (ave, spikes), (svd, worst), (joint, _), (gls, _) = (
        values(found, "1", m) for m in ("average", "svd", "svd-joint", "gls")
    )
    return Claim(
        "SVD is more accurate than AVE",
        "only through the spikes of AVE" if spikes > 3.0 * worst else "not in these runs",
        f"medians {svd:.4f} and {ave:.4f}, worst rms {worst:.3f} and {spikes:.3g}; svd-joint has {joint:.4f}, gls "
        f"{gls:.4f}. The SVD as printed, without a scale, has {values(found, '1', 'printed')[0]:.2g}.",
    )


def drift(found: Found) -> Claim:
    """Equation 60."""
    fast, slow = values(found, "3", "noisy svd-joint")[0], values(found, "3", "slow svd-joint")[0]
    return Claim(
        "A larger Q reduces the error (60)",
        "only without noise",
        f"at 20 dB the error goes from {slow:.3f} with Q/R = 1e-3 to {fast:.2f} with 1e3. The bounds of P depend on Q, "
        "so that (60) is no argument.",
    )


def noise(found: Found) -> Claim:
    """Example 3."""
    fast, kept = values(found, "3", "noisy svd-joint")[0], values(found, "3", "noisy start")[0]
    aware, oe = values(found, "3", "aware gls")[0], values(found, "3", "output error")[0]
    return Claim(
        "Measurement noise has no obvious effect (example 3)",
        "we could not reproduce it with a small R",
        f"at 20 dB the error is {fast:.2f}; keeping the initial values for ever has {kept:.2f}. A noise-aware R has "
        f"{aware:.3f}, the output-error filter {oe:.3f}. Least squares on a constant system is off by "
        f"{found.bias['20 dB']:.3f} at 20 dB, however long the record.",
    )


def order(found: Found) -> Claim:
    """Example 4."""
    raw = ", ".join(f"{total(paths):.2f} (q = {q})" for q, paths in found.raw.items())
    share = max(end([r.b for r in paths]) / total(paths) for paths in found.raw.values())
    return Claim(
        "A higher order is more accurate (example 4)",
        "we could not reproduce it with raw powers",
        f"Er of (67) is {raw}; its b part is {100 * share:.1f} % of that, and with d_1 = 1 b_1 is not 0.0378. "
        f"Legendre polynomials of order 4 have squared errors of a of {end([r.a for r in found.legendre]):.0e} and of "
        f"p of {end([r.p for r in found.legendre]):.0e}, and the local gain is {gains(found)[-1]:.2f} of the true one.",
    )


def bound() -> Claim:
    """Theorem 1: the bound of the mean square against what it bounds."""
    s = example(1, 0, T=2000)
    run = track(s.model, PAPER, s.y, s.u, keep="cov")
    sizes = np.array([np.linalg.eigvalsh(run.cov(t))[[0, -1]] for t in range(1000, 2000, 50)])
    low, high = max(float(sizes[:, 0].min()), 1e-12), float(sizes[:, 1].max())
    a, b, c, d = s.model.structure.groups(s.xi[-1])
    left, right = np.r_[np.repeat(b, 2), np.repeat(a, 2)], np.r_[np.repeat(c[1:], 2), np.repeat(d[1:], 2)]
    drift = (left @ left + right @ right + 6.0) * WALK**2 + 8.0 * WALK**4
    q = float(PAPER.q)
    limit = high * drift / low * (high + q) / q
    actual = float(np.mean(np.sum((run.theta - s.model.structure.products(s.xi))[1000:] ** 2, axis=1)))
    return Claim(
        "The error is bounded (theorem 1)",
        "correct, and no error bar",
        f"eigenvalues of P between {low:.1g} and {high:.3g} give a mean square of at most {limit:.2g}; it is "
        f"{actual:.1g}, {limit / actual:.0e} times less. Theorem 2 needs c away from 0 and bounds estimates, not "
        "errors.",
    )


def effort(times: dict[tuple[int, ...], dict[str, float]]) -> Claim:
    """Remark 4."""
    row = times[(2, 2, 3, 3)]
    return Claim(
        "AVE needs less computation than SVD, which still can run on line (remark 4)",
        "holds",
        f"for the orders of the examples {row['average']:.0f} and {row['svd']:.0f} ns a sample, beside "
        f"{row['filter']:.0f} ns of the filter.",
    )


def show(out: Console, claims: list[Claim]) -> None:
    """Print claims, verdicts and numbers."""
    for claim, verdict, measured in claims:
        out.print(f"[bold]{claim}:[/bold] {verdict}")
        out.print(indent(fill(measured, 116), "    "), markup=False)
