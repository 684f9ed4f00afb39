"""What not knowing costs `AdaptiveKalman`, piece by piece: its error where one thing that it learns is given.

For the scenarios of `benchmarks.unseen` whose parameters walk independently with a constant drift. Errors of the
parameters are divided by those of the oracle of `benchmarks.scenarios`; medians over runs.

    nothing     the tracker as it is
    r           the noise variance (its median, where it changes) is given at every sample
    which       the second ladder has the true proportions of the drifts instead of learned weights
    constant    filters do not interact: drift never changes, and nothing jumps
    both        which and constant
    drift       only the filter with the true drift is left; r, outliers, frozen readings and colour are still unknown
    drift, r    the same, and r is given
    c           the coefficient of the previous innovation is given, where the noise has one

Run: python -m benchmarks.known_pieces [--runs 10] [--only NAME ..] [--quick]
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any
from zlib import crc32

import numpy as np

from benchmarks.drift_floors import COLOURED
from benchmarks.scenarios import error, oracle
from benchmarks.unseen import found
from driftfit import AdaptiveKalman, track
from driftfit.engine.drivers import TrackerSteps
from driftfit.engine.kernel import State, kernel
from driftfit.trackers.parts.modes.filters import predict
from driftfit.trackers.parts.modes.ladder import LADDER, LEARNED
from lab.bench.records import Record

COLUMNS = ("nothing", "r", "which", "constant", "both", "drift", "drift, r", "c")
NAMES = (
    "one_of_eight", "few_of_twelve", "bias_beside_ar", "armax", "quantised", "closed_loop", "near_unit_root",
    "frozen_coarse", "very_slow", "little_noise", "counts", "t3_noise", "garch", "missing_blocks", "scales", "short",
    "intercept", "steady", "ar_noise",
)  # fmt: skip
"""Scenarios with a constant, independent drift."""


@kernel
def predict_with_given(s: State, l: int) -> None:
    """Replace what was learned by what is given, before every sample."""
    if (s.given_r[l] > 0.0) & (s.settled[l] > 0):
        s.r[l] = s.given_r[l]
    if abs(s.given_c[l]) < 1.0:
        s.colour[l] = s.given_c[l]
    predict(s, l)


@dataclass(frozen=True)
class Informed(AdaptiveKalman):
    """`AdaptiveKalman` that is given the true ``drift``, q c / r of each parameter, and uses of it what ``piece`` says;
    the noise variance ``r``, unless 0; and the coefficient ``c``, unless 1."""

    drift: Any = ()
    piece: str = "nothing"
    r: float = 0.0
    c: float = 1.0

    def state(self, n: int) -> Mapping[str, Any]:
        fields = {**super().state(n), "given_r": self.r, "given_c": self.c}
        drift, second = np.array(self.drift), slice(len(LADDER), len(LADDER) + len(LEARNED))
        if self.piece in ("which", "both", "drift"):
            share = drift / drift.max() if drift.max() > 0.0 else np.ones(n)
            ratio, learned = fields["ratio"].copy(), fields["learned"].copy()
            ratio[:, second] = drift[:, None] if self.piece == "drift" else share[:, None] * np.array(LEARNED)
            learned[second] = 0.0
            fields |= {"ratio": ratio, "learned": learned}
        if self.piece in ("constant", "both", "drift"):
            fields |= {name: 0.0 * fields[name] for name in ("arrive", "arrivals", "moves")}
        if self.piece == "drift":
            only = np.full(len(fields["mu"]), 1e-30)
            only[second.start] = 1.0
            fields |= {"mu": only, "prior": only}
        return fields

    @property
    def steps(self) -> TrackerSteps:
        return super().steps._replace(predict=predict_with_given)


def ratios(name: str, seed: int) -> list[float]:
    """Errors over the oracle's, by column; NaN for none."""
    case = found()[name](np.random.default_rng([seed, crc32(name.encode())]))
    u = case.u if case.u.ndim == 2 else case.u[:, None]
    phi = np.ascontiguousarray(Record(case.model.bind(u.shape[1]), case.y, u).phi)
    size, r = np.nanmean(phi**2, axis=0), float(np.median(case.r))
    least, drift = error(case, oracle(case, phi), size), tuple(np.median(case.q, axis=0) * size / r)
    moving, row = COLOURED.get(name, (0.0, 0.0))[1], []
    for column in COLUMNS:
        piece = column.split(",")[0]
        c = moving if column == "c" else 1.0
        informed = Informed(drift=drift, piece=piece, r=r if column in ("r", "drift, r") else 0.0, c=c)
        known = column != "c" or moving
        row.append(error(case, track(case.model, informed, case.y, case.u).theta, size) / least if known else np.nan)
    return row


def line(name: str, row: list[float]) -> str:
    """A line of the table."""
    return f"{name:16}" + "".join(f"{'-' if np.isnan(value) else f'{value:.2f}':>10}" for value in row)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=10)
    parser.add_argument("--only", nargs="*", choices=NAMES)
    parser.add_argument("--quick", action="store_true", help="one run of one scenario")
    given = parser.parse_args()
    rows = []
    print(f"{'':16}" + "".join(f"{column:>10}" for column in COLUMNS))
    for name in given.only or (["near_unit_root"] if given.quick else NAMES):
        runs = 1 if given.quick else given.runs if name != "very_slow" else max(2, given.runs // 5)
        rows.append([float(value) for value in np.median([ratios(name, seed) for seed in range(runs)], axis=0)])
        print(line(name, rows[-1]), flush=True)
    print(line("median", [float(np.median(column)) for column in zip(*rows, strict=True)]))


if __name__ == "__main__":
    main()
