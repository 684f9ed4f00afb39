"""The claims made for banks of hypotheses, measured."""

from __future__ import annotations

from collections.abc import Mapping
from textwrap import fill
from typing import NamedTuple

import numpy as np
from rich.console import Console

from driftfit.bank.reduction import Decide
from driftfit.tracking import track
from lab.jumps import MODEL, jumping
from lab.reproduce import Claim
from lab.reproduce.hypotheses.contests import bank
from lab.reproduce.hypotheses.scores import REACH, Measured

Tables = Mapping[str, Mapping[str, Measured]]
Rows = Mapping[str, tuple[float, ...]]
KF, KF_OUTLIERS, RMSE, STEADY, NEES, LEAVES = "KF diag(.004,.004,.04)", "KF tuned Q, r", 0, 3, 8, 9


def value(found: Tables, table: str, row: str, column: int = RMSE) -> float:
    return found[table][row].values[column]


def against(found: Tables, table: str, row: str, other: str, column: int = RMSE) -> float:
    """Difference in percent."""
    return 100.0 * (value(found, table, row, column) / value(found, table, other, column) - 1.0)


def holds(all_of: bool, where: str = "") -> str:
    """The verdict."""
    return f"holds{where}" if all_of else "does not hold"


def sparse(found: Tables) -> Claim:
    """Jumps once in a hundred samples."""
    rows = ("Decide d=2", "Decide d=3", "Decide d=4", "Beam M=9")
    clean = found["clean"]
    wins = [
        ", ".join(f"{row} {100 * np.mean(clean[row].each < clean[other].each):.0f} %" for row in rows)
        for other in (KF, "IMM")
    ]
    gains = [against(found, "clean", row, KF) for row in rows]
    imm = [against(found, "clean", row, "IMM") for row in rows]
    return Claim(
        "Abrupt changes are tracked better than by any filter with forgetting, and than by IMM",
        holds(max(gains + imm) < 0.0, " for sparse jumps of roughly the right scale"),
        "all reductions have a smaller RMSE than both.",
        f"RMSE {max(gains):+.0f} to {min(gains):+.0f} % against the tuned Kalman filter, steady "
        f"{against(found, 'clean', 'Beam M=9', KF, STEADY):+.0f} % (Beam 9); {max(imm):+.0f} to {min(imm):+.0f} % "
        f"against IMM. Of the records the filter is beaten in: {wins[0]}; IMM in: {wins[1]}.",
    )


def persistent(found: Tables) -> Claim:
    """Changes that last."""
    kf = "KF tuned 0.001"
    cut = {row: against(found, "regimes", row, kf) for row in found["regimes"] if row.startswith("Decide")}
    merged = {row: against(found, "regimes", row, kf) for row in ("GPB(2) Markov", "IMM Markov")}
    return Claim(
        "Where changes persist, cutting is worse than one tuned Kalman filter; merging with a Markov prior is better",
        holds(min(cut.values()) > 0.0 and max(merged.values()) < 0.0),
        "every cut bank has a larger RMSE than the filter, every merged one a smaller one.",
        "RMSE against the filter: " + ", ".join(f"{row} {gain:+.0f} %" for row, gain in (cut | merged).items()) + ".",
    )


def outliers(found: Tables) -> Claim:
    """Outliers, modelled or not."""
    kf = KF_OUTLIERS
    without = against(found, "outliers", "Decide d=2, no sensor alternative", kf)
    shallow = against(found, "outliers", "joint Decide d=1", kf)
    rows = ("joint Decide d=2", "joint Decide d=3", "GPB(2) joint", "joint Beam M=32")
    gains = {row: against(found, "outliers", row, kf) for row in rows}
    return Claim(
        "With outliers a bank needs an outlier hypothesis and two samples to tell",
        holds(min(without, shallow) > 0.0 and max(gains.values()) < 0.0),
        "the first two have a larger RMSE than the filter, the others a smaller one.",
        f"RMSE against the Kalman filter tuned for outliers: without the hypothesis {without:+.0f} %, with it and one "
        f"sample {shallow:+.0f} %, " + ", ".join(f"{row} {gain:+.0f} %" for row, gain in gains.items()) + ".",
    )


def cleaning(found: Tables) -> Claim:
    """Additive outliers and a frozen sensor."""
    additive = against(
        found, "additive", "joint Decide d=2, leaf-cleaned regressor", "joint Decide d=2, literal (dirty regressor)"
    )
    stuck = against(
        found, "frozen", "Decide d=2 ok/frozen cleaned, Markov", "Decide d=2 ok/frozen literal (dirty regr.)"
    )
    return Claim(
        "Leaves that keep output lags of their own are better where the sensor alone is at fault",
        holds(max(additive, stuck) < 0.0),
        "the RMSE is smaller with both faults.",
        f"RMSE with Decide(2) against lags as measured: {additive:+.0f} % with additive outliers, {stuck:+.0f} % with "
        "a frozen sensor.",
    )


def scale(found: Tables, wrong: Rows) -> Claim:
    """Prior information."""
    kf = value(found, "clean", KF)
    worse = {
        name: 100.0 * (row[1] / wrong["nominal"][1] - 1.0)
        for name, row in wrong.items()
        if name not in ("nominal", "4 hypotheses: + medium jump 0.05 I")
    }
    lost = [name for name, row in wrong.items() if row[1] > kf]
    noise = max(worse["assumed r x0.25"], worse["assumed r x4"])
    jumps = max(worse["jump covariances x0.1"], worse["jump covariances x10"])
    first = "r above all, then the order of magnitude of the jumps" if noise > jumps else "jumps above all, then r"
    return Claim(
        "Prior information improves tracking",
        f"it is required: {first}" if lost else "holds, and it is not required",
        "required if some wrong setting is worse than the tuned Kalman filter; r above all if a factor of 4 in it "
        "costs more than one of 10 in the jump covariances.",
        "RMSE of Decide(4) against the right settings: "
        + ", ".join(f"{name} {loss:+.0f} %" for name, loss in worse.items())
        + f". Worse than the tuned Kalman filter ({kf:.3f}): {', '.join(lost) or 'none'}.",
    )


def losses(found: Tables) -> Claim:
    """Asymmetric losses."""
    costs = {c: f"Decide d=2, a miss costs {c}" for c in (3, 10, 30, 100)}
    rows = {c: against(found, "clean", name, "Decide d=2") for c, name in costs.items()}
    delay = {c: value(found, "clean", name, 5) for c, name in costs.items()}
    equal = value(found, "clean", "Decide d=2", 5)
    outlying = against(found, "outliers", "joint Decide d=2 asym jump-miss=5", "joint Decide d=2")
    parts = ["it buys delay" if delay[10] < equal - 0.3 else "it buys no delay"]
    parts += ["up to 3 it costs nothing"] if rows[3] < 2.0 else []
    parts += ["from 30 on it costs accuracy"] if rows[30] > 5.0 else []
    return Claim(
        "An asymmetric loss finds more jumps",
        parts[0] + ("; " + ", ".join(parts[1:]) if parts[1:] else ""),
        "it buys delay if a cost of 10 shortens the mean by 0.3 samples; it costs nothing below 2 % of RMSE, and "
        "accuracy above 5 %.",
        "RMSE of Decide(2) on clean records, by what a missed jump costs: "
        + ", ".join(f"{c} {gain:+.0f} %" for c, gain in rows.items())
        + f"; mean delay {equal:.1f} samples with equal costs, "
        + ", ".join(f"{d:.1f} at {c}" for c, d in list(delay.items())[:3])
        + f". Under outliers a miss that costs 5 changes the RMSE by {outlying:+.0f} %.",
    )


def covariances(found: Tables) -> Claim:
    """Cut or merged."""
    cut = {d: value(found, "clean", f"Decide d={d}", NEES) for d in (1, 3, 5)}
    merged = {n: value(found, "clean", f"GPB({n})", NEES) for n in (1, 2, 4)}
    steady = value(found, "clean", "GPB(2)", STEADY) / value(found, "clean", "Decide d=2", STEADY)
    return Claim(
        "Cutting is over-confident, merging is honest and noisier when nothing happens",
        holds(min(cut.values()) > 1.05 and max(merged.values()) < 1.05 and steady > 1.3),
        "NEES/n above 1.05 for all that cut and below for all that merge, and a steady RMSE 30 % larger.",
        "NEES/n: "
        + ", ".join(f"Decide({d}) {v:.2f}" for d, v in cut.items())
        + "; "
        + ", ".join(f"GPB({n}) {v:.2f}" for n, v in merged.items())
        + f". Steady RMSE of GPB(2) over that of Decide(2): {steady:.1f}.",
    )


def wording(found: Tables) -> Claim:
    """The paper's approximation."""
    more = against(found, "clean", "FirstFloor posterior d=2", "GPB(2)")
    return Claim(
        "Replacing the mixture of the first floor by one density is a good approximation",
        "merging leaves is better at the same depth" if more > 0.0 else "holds",
        "FirstFloor(2) has no larger RMSE than GPB(2).",
        f"RMSE of FirstFloor(2) {more:+.0f} % against GPB(2), when steady "
        f"{against(found, 'clean', 'FirstFloor posterior d=2', 'GPB(2)', STEADY):+.0f} %.",
    )


def depth(found: Tables) -> Claim:
    """Optimal stopping."""
    rows = ("threshold tau=0.02 dmax=6", "look-ahead c=0.005 dmax=6")
    parts = ", ".join(
        f"{row} {against(found, 'variable', row, 'fixed d=5'):+.0f} % with {value(found, 'variable', row, LEAVES):.0f} "
        "leaf updates a sample"
        for row in rows
    )
    return Claim(
        "A variable depth has the accuracy of a deep tree at the price of a shallow one",
        holds(max(against(found, "variable", row, "fixed d=5") for row in rows) < 6.0),
        "the RMSE is less than 6 % larger than that of the deep tree.",
        f"RMSE against Decide(5) with {value(found, 'variable', 'fixed d=5', LEAVES):.0f}: {parts}.",
    )


def noise_variance(noise: Rows) -> Claim:
    """Unknown noise."""
    known, assumed, unknown = (noise[name] for name in ("r known", "r = .09 assumed", "unknown, from .09"))
    pairs = ", ".join(
        f"sigma {s}: known {a:.3f}, .09 assumed {b:.3f}, unknown {c:.3f}"
        for s, a, b, c in zip((0.1, 0.3, 1.0), known, assumed, unknown, strict=True)
    )
    return Claim(
        "A noise variance that is estimated costs little where the assumed one is right, and wins where it is far off",
        holds(unknown[1] < 1.15 * known[1] and unknown[2] < assumed[2])
        + (", except where it was assumed ten times too large" if unknown[0] > assumed[0] else ""),
        "less than 15 % worse where the assumed one is right (sigma 0.3), and better where it is ten times "
        "too small (1.0).",
        f"RMSE of Decide(2): {pairs}.",
    )


class Calibrated(NamedTuple):
    """Shares: of sure decisions that are true to the sample, of dates exact and within one; mean of probabilities of
    .01 to .1, and how often they come true.
    """

    sure: float
    exact: float
    near: float
    faint: float
    true: float


def probabilities(found: Mapping[int, Calibrated]) -> Claim:
    """Calibration after decisions, by depth."""
    high = all(row.sure >= 0.9 for row in found.values())
    low = all(0.4 * row.faint <= row.true <= 2.5 * row.faint for row in found.values())
    parts = [
        f"depth {d}: jumps decided with p above .97 happened at that very sample in {100 * row.sure:.0f} %, dates are "
        f"exact in {100 * row.exact:.0f} % and within one sample in {100 * row.near:.0f} %, probabilities of .01 to .1 "
        f"(mean {row.faint:.3f}) come true in {100 * row.true:.1f} %"
        for d, row in found.items()
    ]
    return Claim(
        "Probabilities of events are probabilities",
        {(True, True): "holds", (False, True): "not to the sample and above 0.1, once branches have been cut",
         (True, False): "not below 0.1", (False, False): "does not hold"}[high, low],
        "decisions with p above .97 are right in 90 %; probabilities below 0.1 come true within a factor of 2.5.",
        "; ".join(parts) + ".",
    )  # fmt: skip


def calibrated(d: int, runs: int) -> Calibrated:
    """Decisions of Decide(d) on records with jumps."""
    sure, true, exact, near, hits = 0, 0, 0, 0, 0
    faint: list[tuple[float, bool]] = []
    for seed in range(runs):
        record = jumping(seed)
        run = track(MODEL, bank(Decide(d)), record.y, record.u).hypotheses
        jumps = record.jumps
        called = [decision for decision in run.decisions if decision.event > 0]
        certain = [decision.sample in jumps for decision in called if decision.prob > 0.97]
        sure, true = sure + len(certain), true + sum(certain)
        for jump in jumps:
            away = [abs(c.sample - jump) for c in called if -2 < c.sample - jump < REACH]
            if away:
                hits, exact, near = hits + 1, exact + (min(away) == 0), near + (min(away) <= 1)
        p, at = run.prob(d - 1).reshape(len(record.y), -1)[:, 1:].sum(axis=1), np.isin(np.arange(600), jumps)
        low = (p > 0.01) & (p < 0.1)
        faint += zip(p[low].tolist(), at[low].tolist(), strict=True)
    means = np.mean(faint, axis=0) if faint else (np.nan, np.nan)
    return Calibrated(true / max(sure, 1), exact / max(hits, 1), near / max(hits, 1), float(means[0]), float(means[1]))


def print_claims(found: Tables, wrong: Rows, noise: Rows, runs: int, console: Console) -> None:
    """All of them, numbered."""
    claims = [
        sparse(found), persistent(found), outliers(found), cleaning(found), scale(found, wrong), losses(found),
        covariances(found), probabilities({d: calibrated(d, runs) for d in (1, 4)}), wording(found), depth(found),
        noise_variance(noise),
    ]  # fmt: skip
    for k, claim_of in enumerate(claims, 1):
        claim, verdict, _, measured = claim_of
        console.print(fill(f"{k}. {claim}: {verdict}.", 118), style="bold", highlight=False)
        console.print(claim_of._replace(measured=measured[:1].upper() + measured[1:]).text(115, "   "), highlight=False)
