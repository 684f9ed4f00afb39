"""What `driftfit.identify` can know: how often a slow plant is said to have a unit root, and what a curve is worth.

First, plants with a pole below 1, and with one at 1: shares of which the sum of the lags "may be 1". Second, the
static curves of `benchmarks/identify.py`: "nats" is what the curve of the plant itself explains beyond a straight line,
on average over the plants, if its form and its input were known; "price" is the logarithm of the number of products
among which one is chosen; "named" is the share of which the curve is named.

Run: python benchmarks/identify_limits.py [first seed, 1000 by default] [seed to stop before] [--quick]
"""

from __future__ import annotations

import argparse
import warnings

import numpy as np

from benchmarks.identify import BEFORE, INPUTS, NOISES, SNRS, Judged, T, input_of, ours, plant
from driftfit.engine.kernel import Array
from driftfit.identify.judgement import Memory
from driftfit.identify.roles import roles
from driftfit.identify.structure import Structure, search
from driftfit.identify.working_point import products
from driftfit.use.simulate import moved

POLES = (0.8, 0.9, 0.95, 0.98, 0.99, 1.0)


def slow(pole: float, length: int, seed: int) -> dict[str, Array]:
    """A record of y_t = pole y_(t-1) + 0.5 u_(t-3) + v_t, with an idle input."""
    rng = np.random.default_rng([seed, int(1000 * pole), length])
    u, idle, y = input_of("AR(0.9)", rng, length + BEFORE), rng.normal(size=length), rng.normal(size=length + BEFORE)
    for t in range(3, len(y)):
        y[t] += pole * y[t - 1] + 0.5 * u[t - 3]
    return {"flow": y[BEFORE:], "u1": u[BEFORE:], "u2": idle}


def rooted(table: dict[str, Array]) -> bool:
    """Whether the sum of the lags that are found may be 1."""
    record = roles(table, "flow")
    y, U, _ = record.spread(31)
    best = search(y, U, 30, 0, np.inf, np.random.default_rng(0))
    each = [(record.U[:, j], k) for j, nb, nk in best.shape[1] for k in range(nk, nk + nb)]
    past = [(record.y, k + 1) for k in range(best.na)]
    phi = np.column_stack([*(moved(x, k) for x, k in (*past, *each)), np.ones(len(y))])
    rows = np.isfinite(phi).all(axis=1)
    phi, y = phi[rows], record.y[rows]
    inverse = np.linalg.pinv(phi)
    e, lags = y - phi @ (inverse @ y), np.arange(phi.shape[1]) < best.na
    std = np.sqrt(np.sum(e**2) / (len(y) - phi.shape[1]) * lags @ (inverse @ inverse.T) @ lags)
    return best.na > 0 and Memory(float(lags @ (inverse @ y)), float(std)).root


def worth(snr: float, inputs: str, noise: str, seed: int) -> tuple[float, float, float]:
    """(nats of the plant's own curve, price of one among the products, whether a curve is named) of a plant."""
    one = plant("static curve", inputs, noise, snr, seed)
    (first, k), names = next(iter(one.inputs.items())), [name for name in one.table if name != "flow"]
    given = Structure(2, {names.index(name): (1, delay) for name, delay in one.inputs.items()})
    rows = Judged.of(one, given).rows
    bent = np.column_stack([rows.phi, np.tanh(1.2 * moved(one.table[first], k)[rows.at] + 0.6)])
    left = [np.sum((rows.y - X @ np.linalg.lstsq(X, rows.y, rcond=None)[0]) ** 2) for X in (rows.phi, bent)]
    record = roles(one.table, "flow")
    made = products(record.y, record.U, given, record.inputs, "flow", 0)[1]
    return len(rows.y) / 2.0 * np.log(left[0] / left[1]), np.log(len(made)), ours(one).cause == "working point"


def main() -> None:
    """Print both tables."""
    options = argparse.ArgumentParser()
    options.add_argument("seeds", type=int, nargs="*", default=[1000, 1020])
    options.add_argument("--quick", action="store_true", help="one seed")
    given = options.parse_args()
    seeds = range(given.seeds[0], given.seeds[0] + 1 if given.quick else given.seeds[1])
    print(f"{'pole':6}{'500 samples':>13}{f'{T} samples':>14}  said to have a unit root")
    for pole in POLES:
        shares = [np.mean([rooted(slow(pole, length, seed)) for seed in seeds]) for length in (500, T)]
        print(f"{pole:<6}{shares[0]:13.2f}{shares[1]:14.2f}", flush=True)
    print(f"\n{'effect':8}{'nats':>7}{'price':>7}{'named':>7}{'plants':>8}")
    for snr in SNRS:
        cases = ((inputs, NOISES[(j + seed) % 2], seed) for seed in seeds[:6] for j, inputs in enumerate(INPUTS))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = np.array([worth(snr, *case) for case in cases])
        cells = np.mean(found, axis=0)
        print(f"{snr:<8}{cells[0]:7.1f}{cells[1]:7.1f}{cells[2]:7.2f}{len(found):8}", flush=True)


if __name__ == "__main__":
    main()
