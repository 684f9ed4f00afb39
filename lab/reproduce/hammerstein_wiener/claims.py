"""The claims of the paper, measured."""

from __future__ import annotations

import numpy as np
from rich.console import Console

from driftfit.systems.hammerstein_wiener import WALK, example
from driftfit.tracking import track
from lab.reproduce import Claim
from lab.reproduce.hammerstein_wiener import verdicts
from lab.reproduce.hammerstein_wiener.runs import PAPER
from lab.reproduce.hammerstein_wiener.tables import Found, arrivals, end, gains, total, values

STARTS = (0.01, 10.0, 1000.0)


def all_claims(found: Found, times: dict[tuple[int, ...], dict[str, float]]) -> list[Claim]:
    """Every claim, in the order of the paper."""
    two_stage = {k: arrivals(found, ("two-stage", k)) for k in STARTS}
    third = {name: values(found, "3", name)[0] for name in ("clean svd-joint", "noisy svd-joint", "slow svd-joint")}
    return [
        verdicts.start(two_stage),
        verdicts.rivals({k: arrivals(found, ("ekf", k)) for k in STARTS}, two_stage[0.01][0]),
        verdicts.separation(
            {m: values(found, "1", m) for m in ("average", "svd", "svd-joint", "gls")},
            values(found, "1", "printed")[0],
        ),
        verdicts.drift(third["noisy svd-joint"], third["slow svd-joint"]),
        verdicts.noise(
            {"fast": third["noisy svd-joint"], "clean": third["clean svd-joint"]}
            | {"start": values(found, "3", "noisy start")[0], "aware": values(found, "3", "aware gls")[0]}
            | {"output error": values(found, "3", "output error")[0], "bias": found.bias["20 dB"]}
        ),
        order(found),
        bound(),
        verdicts.effort(times[(2, 2, 3, 3)]),
    ]


def order(found: Found) -> Claim:
    """Example 4."""
    raw = {q: total(paths) for q, paths in found.raw.items()}
    share = max(end([r.b for r in paths]) / total(paths) for paths in found.raw.values())
    legendre = end([r.a for r in found.legendre]), end([r.p for r in found.legendre]), gains(found)[-1]
    return verdicts.order(raw, share, legendre)


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
    return verdicts.bound(low, high, limit, actual)


def show(out: Console, claims: list[Claim]) -> None:
    """Print claims, verdicts, numbers and rules."""
    for claim in claims:
        out.print(f"[bold]{claim.claim}:[/bold] {claim.verdict}")
        out.print(claim.text(116, "    "), markup=False)
