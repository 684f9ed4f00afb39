"""Coverage of the 95 % bands of theta on coarse meters: held and moving inputs, one to four parameters.

theta is constant, the noise is 0.3, and readings are rounded to a quantum. An input keeps its value for ``held``
samples; with one parameter the regressor is 1 + u / 2, or 1 where inputs are held for the whole record. A band is
counted at samples 500 and 1000 where it is finite; it is NaN as long as there is no residual from which to estimate the
noise. In brackets: the share of bands that are not finite, where there are any. "Gate": with ``gate=True``, which keeps
the noise variance above that of the rounding; the least squares beside it have none. `AdaptiveKalman` has a gate.

Run: python benchmarks/coarse_coverage.py [records, 40 by default] [--quick, a row]
"""

import sys
import warnings

import numpy as np

from driftfit import FLS, RLS, AdaptiveKalman, Regression, track

T, AT, NOISE = 1000, [500, 999], 0.3
COLUMNS = {
    "RLS(1)": (RLS(1.0), False), "gate": (RLS(1.0), True), "RLS(0.98)": (RLS(0.98), False), "gate ": (RLS(0.98), True),
    "FLS(300)": (FLS(300.0), False), "gate  ": (FLS(300.0), True), "AdaptiveKalman()": (AdaptiveKalman(), None),
}  # fmt: skip
WIDTHS = [max(11, len(name.strip())) for name in COLUMNS]


def record(seed: int, quantum: float, held: int, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.normal(size=(-(-T // held), max(n - 1, 1))), held, axis=0)[:T]
    theta = np.r_[5.0 * rng.random(), rng.normal(size=n - 1)]
    X = np.column_stack([np.ones(T), u]) if n > 1 else 1.0 + 0.5 * u if held < T else np.ones((T, 1))
    y = X @ theta + NOISE * rng.normal(size=T)
    return X, quantum * np.round(y / quantum) if quantum else y, theta


def _row(cells: list[str]) -> str:
    return "  ".join(f"{cell:>{width}}" for cell, width in zip(cells, WIDTHS, strict=True))


def main(records: int = 40, quick: bool = False) -> None:
    warnings.simplefilter("ignore")  # the trackers themselves warn of regressors that do not move
    print(f"{'quantum':>7} {'held':>5} {'n':>2}  " + _row([name.strip() for name in COLUMNS]))
    for quantum in (0.0, 0.5, 1.0, 2.0, 5.0):
        for held in (1, 20, 200, T):
            for n in (1,) if held == T else (1, 2, 4):
                if quick and (quantum, held, n) != (2.0, 1, 1):
                    continue
                cells = []
                for tracker, gate in COLUMNS.values():
                    inside, unknown = [], []
                    for seed in range(records):
                        X, y, theta = record(seed, quantum, held, n)
                        run = track(Regression(n), tracker, y, X, gate=gate)
                        finite = np.isfinite(run.std[AT])
                        inside += (np.abs(run.theta[AT] - theta) <= 1.96 * run.std[AT])[finite].tolist()
                        unknown += (~finite).ravel().tolist()
                    share = f" ({np.mean(unknown):.0%})" if any(unknown) else ""
                    cells.append((f"{np.mean(inside):.2f}" if inside else "-") + share)
                print(f"{quantum:>7} {held:>5} {n:>2}  " + _row(cells), flush=True)


if __name__ == "__main__":
    counts = [int(given) for given in sys.argv[1:] if given.isdigit()]
    main(*counts, quick="--quick" in sys.argv)
