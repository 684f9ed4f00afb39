"""How often `diagnose` finds a fault with constancy although the coefficients are constant.

Regression on three inputs and ARX(2, 2), Gaussian noise, constant coefficients. "loss" is the cost of letting the
coefficients change: the one-step error of the tracker over that of constant least squares, minus one, median over the
records. Three rules for "the drift is set too high", each in addition to constants not being rejected (p above 0.05):

    ratio     the errors of the record are more than 3 % larger than those of constants
    worse     constants are better at all, at 1 % (paired test)
    by 3 %    the errors are more than 3 % larger, at 1 % (paired test): what `diagnose` uses

"constant" is a tracker with constant coefficients; it has a fault if constancy is rejected at 1 %.

Run: python benchmarks/diagnose_constancy.py [records per cell, 60 by default] [--quick]
"""

import sys

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from scipy import signal

from driftfit import ARX, AdaptiveKalman, Kalman, Regression, Track, track
from driftfit.judge.diagnose import MATERIAL, holds_constant
from driftfit.judge.evidence import Evidence
from driftfit.judge.statistics.paired import paired
from driftfit.run.result import root_mean_square

TRACKERS = {
    "constant": Kalman(q=0.0, r=1.0), "AdaptiveKalman()": AdaptiveKalman(), "Kalman, q/r = 1e-4": Kalman(q=1e-4, r=1.0),
    "Kalman, q/r = 1e-3": Kalman(q=1e-3, r=1.0), "Kalman, q/r = 1e-2": Kalman(q=1e-2, r=1.0),
}  # fmt: skip


def record(model: str, seed: int, T: int) -> tuple[np.ndarray, np.ndarray]:
    """Outputs (T,) and inputs."""
    rng = np.random.default_rng(seed)
    if model == "regression":
        u, e = rng.normal(size=(T, 3)), rng.normal(size=T)
        return u @ [1.0, -1.0, 0.5] + e, u
    u, e = rng.normal(size=T), rng.normal(size=T)
    A, B = [1.0, -1.1, 0.5], [0.0, 1.0, 0.5]
    return signal.lfilter(B, A, u) + signal.lfilter([1.0], A, e), u


def judged(run: Track, p: float) -> tuple[float, bool, bool, bool]:
    """(loss, ratio, worse, by 3 %); for a tracker with constant coefficients the first rule is its own."""
    error = Evidence(run).errors
    own, steady = error.tracked[error.scored], error.constant_ls[error.scored]
    loss = root_mean_square(own) / root_mean_square(steady)
    if holds_constant(run):
        return loss - 1.0, p < 0.01, p < 0.01, p < 0.01
    kept = p > 0.05
    return (
        loss - 1.0, kept and loss > MATERIAL, kept and paired("", own, steady).p < 0.01,
        kept and paired("", own, MATERIAL * steady).p < 0.01,
    )  # fmt: skip


def main(
    records: int = 60, lengths: tuple[int, ...] = (200, 1000, 5000), trackers: tuple[str, ...] = tuple(TRACKERS)
) -> None:
    table = Table(box=SIMPLE_HEAD, show_edge=False, title=f"Fault found, % of {records} constant records", width=100)
    for head in ("model", "tracker", "T", "loss, %", "ratio", "worse", "by 3 %"):
        table.add_column(head, justify="left" if head in ("model", "tracker") else "right")
    for name, model in (("regression", Regression(3)), ("ARX(2, 2)", ARX(2, 2))):
        still = {T: [track(model, TRACKERS["constant"], *record(name, k, T)) for k in range(records)] for T in lengths}
        p = {T: [Evidence(run).p for run in runs] for T, runs in still.items()}  # not a matter of the tracker
        for tracker in trackers:
            given = TRACKERS[tracker]
            for T in lengths:
                runs = (track(model, given, *record(name, k, T)) for k in range(records))
                rows = np.array([judged(*one) for one in zip(runs, p[T], strict=True)])
                shares = (f"{100.0 * share:.1f}" for share in rows[:, 1:].mean(axis=0))
                table.add_row(name, tracker, str(T), f"{100.0 * np.median(rows[:, 0]):.2f}", *shares)
        table.add_section()
    Console(width=100).print(table)


if __name__ == "__main__":
    if "--quick" in sys.argv:
        main(lengths=(200,), trackers=("constant",))
    else:
        main(*map(int, sys.argv[1:2]))
