"""Coverage of the 95 % bands of theta on coarse meters: held and moving inputs, one to four parameters.

theta is constant, the noise is 0.3, and readings are rounded to a quantum. An input keeps its value for ``held``
samples; with one parameter the regressor is 1 + u / 2, or 1 where inputs are held for the whole record. A band is
counted at samples 500 and 1000 where it is finite; it is NaN as long as there is no residual from which to estimate the
noise. In brackets: the share of bands that are not finite, where there are any. The second table has one parameter at
the last sample, and the same bands with and without what readings share.

Run: python benchmarks/coarse_coverage.py [records, 40 by default] [--quick, with 1]
"""

import sys
import warnings

import numpy as np

from driftfit import FLS, RLS, AdaptiveKalman, Regression, track

T, AT, NOISE = 1000, [500, 999], 0.3
TRACKERS = {"RLS(1)": RLS(1.0), "RLS(0.98)": RLS(0.98), "FLS(300)": FLS(300.0), "AdaptiveKalman()": AdaptiveKalman()}


def record(seed: int, quantum: float, held: int, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.normal(size=(-(-T // held), max(n - 1, 1))), held, axis=0)[:T]
    theta = np.r_[5.0 * rng.random(), rng.normal(size=n - 1)]
    X = np.column_stack([np.ones(T), u]) if n > 1 else 1.0 + 0.5 * u if held < T else np.ones((T, 1))
    y = X @ theta + NOISE * rng.normal(size=T)
    return X, quantum * np.round(y / quantum) if quantum else y, theta


def shared(records: int) -> None:
    print(
        f"\n{'quantum':>7} {'held':>5} {'bands':>6}  "
        + "  ".join(f"{name:>23}" for name in ("RLS(1)", "AdaptiveKalman()"))
    )
    for quantum in (1.0, 2.0, 5.0):
        for held in (1, 200, T):
            cells, told = [], 0
            for name in ("RLS(1)", "AdaptiveKalman()"):
                inside = []
                for seed in range(2 * records):
                    X, y, theta = record(seed, quantum, held, 1)
                    run = track(Regression(1), TRACKERS[name], y, X)
                    away, std = abs(run.theta[-1, 0] - theta[0]), run.std[-1, 0]
                    if np.isfinite(std):
                        inside.append([away <= 1.96 * std / np.sqrt(run.state["fold"]), away <= 1.96 * std])
                told = len(inside)
                without, given = np.mean(inside, axis=0) if inside else (np.nan, np.nan)
                cells.append(f"{f'{without:.2f} without, {given:.2f}':>23}")
            print(f"{quantum:>7} {held:>5} {told:>6}  " + "  ".join(cells), flush=True)


def main(records: int = 40, quick: bool = False) -> None:
    warnings.simplefilter("ignore")  # the trackers themselves warn of regressors that do not move
    print(f"{'quantum':>7} {'held':>5} {'n':>2}  " + "  ".join(f"{name:>16}" for name in TRACKERS))
    for quantum in (0.0, 0.5, 1.0, 2.0, 5.0):
        for held in (1, 20, 200, T):
            for n in (1,) if held == T else (1, 2, 4):
                if quick and (n == 4 or held == 20):
                    continue
                cells = []
                for tracker in TRACKERS.values():
                    inside, unknown = [], []
                    for seed in range(records):
                        X, y, theta = record(seed, quantum, held, n)
                        run = track(Regression(n), tracker, y, X)
                        finite = np.isfinite(run.std[AT])
                        inside += (np.abs(run.theta[AT] - theta) <= 1.96 * run.std[AT])[finite].tolist()
                        unknown += (~finite).ravel().tolist()
                    share = f" ({np.mean(unknown):.0%})" if any(unknown) else ""
                    cells.append((f"{np.mean(inside):.2f}" if inside else "-") + share)
                print(f"{quantum:>7} {held:>5} {n:>2}  " + "  ".join(f"{cell:>16}" for cell in cells), flush=True)
    shared(records)


if __name__ == "__main__":
    counts = [int(given) for given in sys.argv[1:] if given.isdigit()]
    quick = "--quick" in sys.argv
    main(*(counts or ([1] if quick else [])), quick=quick)
