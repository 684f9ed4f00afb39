"""Coverage of 95 % forecast bands after short records, for models with and without a memory of their own (a minute).

    python benchmarks/short_forecasts.py            400 records of each length
    python benchmarks/short_forecasts.py --quick    10 of the first two models

The table is that of docs/coloured_noise.md. y_T+1 .. y_T+10 are forecast by RLS(1.0), with known future inputs; the
least and the largest coverage over the ten steps. A coverage of 400 records has a standard error of .011.
"""

from __future__ import annotations

import sys

import numpy as np
from scipy import signal

from driftfit import ARMAX, ARX, OE, RLS, BoxJenkins, track

H, LENGTHS = 10, (15, 30, 60, 120, 400)
A = [1.0, -0.7]
MODELS = {
    "ARX(1, 1)": (ARX(1, 1), A, [1.0], A),
    "OE(1, 1)": (OE(1, 1), A, [1.0], [1.0]),
    "ARMAX(1, 1, 1)": (ARMAX(1, 1, 1), A, [1.0, 0.5], A),
    "BoxJenkins(nb=1)": (BoxJenkins(), A, [1.0, 0.5], [1.0, -0.8]),
}
"""The model, the denominator of the plant 1 / A z^-1 u, numerator and denominator of the noise."""


def main() -> None:
    quick = "--quick" in sys.argv
    records = 5 if quick else 400
    print("Share of outputs within 95 % bands, 1 to 10 steps after a record of T samples")
    print(f"{'':24}  n" + "".join(f"{f'T = {T}':>14}" for T in LENGTHS))
    for name, (model, plant, numerator, denominator) in list(MODELS.items())[: 2 if quick else None]:
        cells = []
        for T in LENGTHS:
            rng = np.random.default_rng([T, 7])
            u, e = rng.normal(size=(records, T + H)), 0.3 * rng.normal(size=(records, T + H))
            y = signal.lfilter([0.0, 1.0], plant, u) + signal.lfilter(numerator, denominator, e)
            fleet = track(model, RLS(1.0), y[:, :T], u[:, :T], by="row")
            inside = np.zeros(H)
            for k, run in enumerate(fleet[key] for key in fleet):
                ahead = run.forecast(H, u[k, T:])
                inside += np.abs(y[k, T:] - ahead.y_hat) < 1.96 * ahead.y_std
            share = inside / records
            cells.append(f"{share.min():.2f} to {share.max():.2f}".replace("0.", "."))
        print(f"{name:24}{model.bind(1).n:3}" + "".join(f"{cell:>14}" for cell in cells), flush=True)


if __name__ == "__main__":
    main()
