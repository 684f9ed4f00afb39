"""Share of 95 % bands that hold the truth, for what follows from `AdaptiveKalman` without settings, in simulation.

y_t = a y_(t-1) + b u_(t-1) + e_t, noise of 0.3, or ARX(2, 2) with complex poles; parameters are constant, the gain
walks by 0.02 per sample, all of them walk, or the gain rests but for one jump half-way. *theta* is filtered at the last
sample, *smoothed* that of `run.smooth()` over the whole record, *y + h* the forecast h samples after the end, *pole*
`largest_pole`, *gain* `dc_gain` by its standard deviation (the delta method), *Fieller* the interval of `long_run`,
each at the last sample. ``!`` marks shares outside .93 to .98 by more than two standard errors of independent records.

The second table is the smoothed path of a `Bank`, which expects jumps, where parameters of a regression walk instead.
The third has the first samples of ARX(1, 1): `run.band()` of theta after T = n + 1 .. n + 10 samples that can be used,
and `run.output_band()` of the next output, for 4 ``--records`` records.

Run: python benchmarks/default_bands.py [--records 200] [--quick]
"""

from __future__ import annotations

import argparse
from collections import defaultdict

import numpy as np

from driftfit import ARX, FLS, RLS, AdaptiveKalman, Bank, InstrumentalVariables, Regression, Track, track
from driftfit.engine.kernel import Array

NOISE, HALF, LEAST, MOST = 0.3, 1.959963984540054, 0.93, 0.98
HORIZONS = (1, 5, 20)
COLUMNS = ("theta", "smoothed", *(f"y + {h}" for h in HORIZONS), "pole", "gain", "Fieller")
STEPS = {"constant": (0.0, 0.0), "gain walks": (0.0, 0.02), "all walk": (0.004, 0.02), "gain jumps": (0.0, 0.0)}
"""Steps of the lag coefficients and of the input coefficients."""
SYSTEMS = {"ARX(1, 1)": (ARX(1, 1), [0.8, 1.0]), "ARX(2, 2)": (ARX(2, 2), [1.2, -0.5, 1.0, 0.4])}


def path(kind: str, start: list[float], length: int, after: int, rng: np.random.Generator) -> Array:
    """theta (length + after, n); walks of the lags are reflected so that the system stays stable."""
    n, na = len(start), len(start) // 2
    steps = np.repeat(STEPS[kind], na) * rng.normal(size=(length + after, n))
    moved = np.cumsum(steps, axis=0)
    moved[:, :na] = 0.08 - np.abs((moved[:, :na] - 0.08) % 0.32 - 0.16)
    if kind == "gain jumps":
        moved[length // 2 :, na] += 0.5
    return np.asarray(start) + moved


def simulated(theta: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """y and u."""
    (length, n), na = theta.shape, theta.shape[1] // 2
    u, y = rng.normal(size=length), np.zeros(length)
    e = NOISE * rng.normal(size=length)
    for t in range(na, length):
        y[t] = theta[t] @ np.concatenate([y[t - na : t][::-1], u[t - n + na : t][::-1]]) + e[t]
    return y, u


def inside(off: Array | float, std: Array | float) -> float:
    return float(np.mean(np.abs(off) <= HALF * np.asarray(std)))


def of_record(run: Track, theta: Array, y: Array, u: Array) -> dict[str, float]:
    """What the bands hold, by column, for a run of the first samples of y and u."""
    T, na = len(run), theta.shape[1] // 2
    last, ahead, smoothed = theta[T - 1], run.forecast(HORIZONS[-1], u[T:]), run.smooth()
    pole, gain, effect = run.largest_pole(at=-1), run.dc_gain(at=-1), run.long_run()[0]
    true_pole = np.abs(np.roots([1.0, *-last[:na]])).max()
    true_gain = last[na:].sum() / (1.0 - last[:na].sum())
    fieller = effect.low <= true_gain <= effect.high
    return {
        "theta": inside(run.theta[-1] - last, run.std[-1]),
        "smoothed": inside(smoothed.theta[na:] - theta[na:T], smoothed.std[na:]),
        **{f"y + {h}": inside(y[T + h - 1] - ahead.y_hat[h - 1], ahead.y_std[h - 1]) for h in HORIZONS},
        "pole": inside(pole.value[0] - true_pole, pole.std[0]),
        "gain": inside(gain.value[0, 0] - true_gain, gain.std[0, 0]),
        "Fieller": float(fieller),
    }


def row(name: str, kind: str, T: int, records: int) -> dict[str, float]:
    """Means over records, which no constant of the tracker was chosen on."""
    model, start = SYSTEMS[name]
    rng = np.random.default_rng([T, *name.encode(), *kind.encode()])
    paths = [path(kind, start, T, HORIZONS[-1], rng) for _ in range(records)]
    made = [simulated(theta, rng) for theta in paths]
    y, u = (np.array(part) for part in zip(*made, strict=True))
    fleet = track(model, AdaptiveKalman(), y[:, :T], u[:, :T], by="row")
    found: dict[str, list[float]] = defaultdict(list)
    for key, theta, own_y, own_u in zip(fleet, paths, y, u, strict=True):
        for column, share in of_record(fleet[key], theta, own_y, own_u).items():
            found[column].append(share)
    return {column: float(np.mean(shares)) for column, shares in found.items()}


def shown(share: float, records: int) -> str:
    allowed = 2.0 * np.sqrt(0.05 * 0.95 / records)
    return f"{share:.2f}" + (" " if LEAST - allowed <= share <= MOST + allowed else "!")


def bank(records: int) -> None:
    """Print the coverage of the smoothed path of a bank in walks."""
    print(f"\n{'Bank().smooth()':24}{'records':>8}{'theta':>8}{'smoothed':>10}")
    for step in (0.005, 0.02, 0.05):
        found = []
        for seed in range(records):
            rng = np.random.default_rng([seed, 11])
            theta = 1.0 + np.cumsum(step * rng.normal(size=(500, 1)), axis=0)
            u = rng.normal(size=theta.shape)
            run = track(Regression(1), Bank(), np.sum(u * theta, axis=1) + NOISE * rng.normal(size=len(u)), u)
            smoothed = run.smooth()
            found.append([inside((r.theta - theta)[50:], r.std[50:]) for r in (run, smoothed)])
        filtered, smooth = np.mean(found, axis=0)
        print(
            f"{f'walk of {step:g}':24}{records:8}{shown(filtered, records):>8}{shown(smooth, records):>10}", flush=True
        )


def first(records: int, trackers: int) -> None:
    """Print the coverage at the first samples that have a variance, for trackers that estimate it."""
    model, start = SYSTEMS["ARX(1, 1)"]
    n, rng = len(start), np.random.default_rng(5)
    made = [simulated(np.tile(start, (n + 12, 1)), rng) for _ in range(records)]
    y, u = (np.array(part) for part in zip(*made, strict=True))
    print(f"\n{'residuals':46}" + "".join(f"{k:>6}" for k in range(1, 11)))
    for tracker in (AdaptiveKalman(), Bank(), RLS(1.0), RLS(0.98), FLS(1e3), InstrumentalVariables(1.0))[:trackers]:
        fleet, found = track(model, tracker, y, u, by="row"), []
        for key, own in zip(fleet, y, strict=True):
            (low, high), (least, most) = fleet[key].band(), fleet[key].output_band()
            of_theta = np.mean((low <= start) & (start <= high), axis=1)[n + 1 : -1]
            found.append([of_theta, ((least <= own) & (own <= most))[n + 2 :]])
        for name, shares in zip(("theta", "next y"), np.mean(found, axis=0), strict=True):
            print(f"{repr(tracker) if name == 'theta' else '':38}{name:8}" + "".join(f"{x:6.2f}" for x in shares))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--records", type=int, default=200)
    parser.add_argument("--quick", action="store_true", help="two records of one kind, 120 samples")
    given = parser.parse_args()
    records = 2 if given.quick else given.records
    print(f"{'':24}{'T':>5}" + "".join(f"{column:>10}" for column in COLUMNS))
    for name in list(SYSTEMS)[: 1 if given.quick else None]:
        for kind in list(STEPS)[: 1 if given.quick else None]:
            for T in (120,) if given.quick else (100, 300, 1000):
                shares = row(name, kind, T, records)
                cells = "".join(f"{shown(shares[column], records):>10}" for column in COLUMNS)
                print(f"{f'{name}, {kind}':24}{T:5}{cells}", flush=True)
    bank(2 if given.quick else records // 4)
    first(4 * records, 2 if given.quick else 6)


if __name__ == "__main__":
    main()
