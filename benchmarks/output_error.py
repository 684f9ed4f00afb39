"""The paper's trackers, smoothed or not, beside the most probable path: a, b, c, d of the four examples, and curves
without an inverse.

    python benchmarks/output_error.py            all tables and the figure
    python benchmarks/output_error.py --quick    the sensor that saturates

Rows are root mean square errors of all a, b, c and d after the first 500 samples of one record, c_1 = d_1 = 1. Examples
1 and 2 are one system. The two stages have the paper's settings without noise, and Q / R = 1e-3 at 20 dB. The furnace
(example 4) is scored by a, the thresholds, the ratios of b and the local gain, relative to the true one, since its d
have another scale. Its paths begin at constants; "straight output" is that of a model whose output curve is a line.
Systems with a curve of w have 1500 samples and noise of 20 dB; "output" is the error of the simulated output, in
standard deviations of the true one.
"""

from __future__ import annotations

import sys
import warnings
from pathlib import Path

import numpy as np

import driftfit as df
from driftfit.models.hammerstein_wiener.thresholds import DeadZone
from driftfit.systems.arc_furnace import THRESHOLDS, A, B, furnace
from driftfit.systems.hammerstein_wiener import example

BURN = 500
FIGURE = Path(__file__).parent.parent / "docs" / "figures" / "output_error.png"
METHODS = {"AVE": "average", "SVD": "svd", "SVD joint": "svd-joint", "GLS": "gls"}
SLOW = df.Kalman(q=1e-3, r=1.0, p0=1e8)


def rms(error):
    """Root mean square after the first samples."""
    return float(np.sqrt(np.mean(error[BURN:] ** 2)))


def examples(number, snr_db):
    """Errors of each method, and the share of the truth in the bands."""
    s = example(number, 0, snr_db=snr_db)
    two = df.Kalman(q=10.0, r=0.01, p0=1e8, theta0=0.01) if snr_db is None else SLOW
    small = df.ExtendedKalman(q=4e-6, r=1e-6 if snr_db is None else 4e-3, p0=1.0)
    run, path = df.track(s.model, two, s.y, s.u), df.output_error(df.track(s.model, SLOW, s.y, s.u))
    rows = {name: run.blocks(method) for name, method in METHODS.items()}
    rows |= {"SVD joint, smoothed": run.smooth().blocks(), "GLS, smoothed": run.smooth().blocks("gls")}
    rows |= {"EKF": df.track(s.model, small, s.y, s.u).blocks(), "most probable path": path.blocks()}
    noise = "no noise" if snr_db is None else f"{snr_db:g} dB"
    print("\n" + f"Example {number}, {noise}".ljust(26) + "     a        b        c        d")
    for name, blocks in rows.items():
        own = blocks.gauge("c1", "d1")
        groups = (own.a - s.a, own.b - s.b, own.c[:, 1:] - s.c[:, 1:], own.d[:, 1:] - s.d[:, 1:])
        print(f"{name:22}", *(f"{rms(group):8.4f}" for group in groups))
    low, high = path.band()
    print(f"bands of 95 % hold {np.mean((low < s.xi) & (s.xi < high)):.2f}; samples {len(s.y)}")
    return s, run, path


def furnaces(noise):
    """Errors of a, thresholds and ratios of b, and the gain relative to the true one."""
    f = furnace(0)
    R = f.R + noise * np.random.default_rng(0).normal(size=len(f.R))
    span = (float(R.min()), float(R.max()))

    def run(degree, q):
        output = df.Legendre(degree, span)
        model = df.HammersteinWiener(3, 3, input=DeadZone(3.0), output=output, intercept=True)
        return df.track(model, df.Kalman(q=q, r=0.01, p0=1e8, theta0=0.01), R, f.u)

    curved = run(4, 1.0)
    rows = {name: curved.blocks(method) for name, method in METHODS.items()}
    rows |= {"most probable path": df.output_error(run(4, 0.0)).blocks()}
    rows |= {"straight output": df.output_error(run(1, 0.0)).blocks()}
    print(f"\nFurnace, noise {noise:<5g}            a     p1, p2   b ratios     gain at 500, 1500, 3000, 4800")
    for name, blocks in rows.items():
        p, ratio = blocks.gauge("c1", "d1").c[:, 1:], blocks.b[:, 1:] / blocks.b[:, :1]
        gain = blocks.b[:, 0] / blocks.slope(f.R) / (B[0] / f.length_per_resistance)
        errors = rms(blocks.a - A), rms(p - THRESHOLDS), rms(ratio - np.array(B[1:]) / B[0])
        print(f"{name:22}", *(f"{x:10.2g}" for x in errors), *(f"{gain[t]:8.3g}" for t in (500, 1500, 3000, 4800)))


def without_inverse(kind, knots=(-1.2, 2.0)):
    """A square, or a saturation with unknown limits, of a system whose pole, gain and input curve drift."""
    rng, T = np.random.default_rng(0), 1500
    t, u = np.arange(T), rng.normal(size=T)
    laws = (-0.6 - 0.2 * t / T, 0.2, 0.7 + 0.1 * np.cos(2 * np.pi * t / T), -0.3, 0.3 + 0.2 * np.sin(2 * np.pi * t / T))
    truth = np.stack(np.broadcast_arrays(*laws), axis=1)
    v, w = u + truth[:, 4] * u**2, np.zeros(T)
    for k in range(2, T):
        w[k] = -truth[k, :2] @ w[[k - 1, k - 2]] + truth[k, 2:4] @ v[[k - 1, k - 2]]
    y0 = {"w + w^2": w + w**2, "0.3 w + w^2": 0.3 * w + w**2, "limited": np.clip(w, -1.0, 1.5)}[kind]
    truth[:, 2:4] *= 0.3 if kind == "0.3 w + w^2" else 1.0  # d_1 = 1
    y = y0 + 0.1 * y0.std() * rng.normal(size=T)
    curve = df.PiecewiseLinear(knots) if kind == "limited" else df.Polynomial(2)
    model = df.HammersteinWiener(2, 2, input=df.Polynomial(2))
    run = df.track(model, df.Kalman(q=1e-6, r=1e-2, p0=1e2), y, u)
    path = df.output_error(run, curve, knots=kind == "limited")
    for name, xi in (("no curve", run.blocks().xi), ("path", path.theta)):
        groups = [rms((xi[:, :5] - truth)[:, part]) for part in (slice(0, 2), slice(2, 4), slice(4, 5))]
        groups += [rms(path.prediction - y0) / y0.std()] if name == "path" else []
        print(f"{f'{kind}, {name}':32}", *(f"{value:8.3f}" for value in groups))
    if kind == "limited":
        ends = zip(path.theta[-1, -2:], path.std[-1, -2:], strict=True)
        print(f"limits -1 and 1.5, from {knots}:", *(f"{x:.3f} +- {sd:.3f}" for x, sd in ends))


def draw(s, run, path):
    """Four parameters of example 3 at 20 dB: the truth, the two stages smoothed, and the path with its bands."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, 2, figsize=(9.0, 4.6), sharex=True, layout="constrained")
    smoothed, (low, high) = run.smooth().blocks().xi, path.band()
    for axis, name in zip(axes.flat, ("A1", "b2", "c3", "d2"), strict=True):
        i = path.names.index(name)
        axis.plot(smoothed[:, i], color="0.6", lw=0.8, label="SVD joint, smoothed")
        axis.fill_between(range(len(s.y)), low[:, i], high[:, i], color="C0", alpha=0.3, lw=0)
        axis.plot(path.theta[:, i], color="C0", lw=1.2, label="most probable path, 95 %")
        axis.plot(s.xi[:, i], color="k", lw=0.8, ls="--", label="truth")
        middle, reach = s.xi[:, i].mean(), np.ptp(s.xi[:, i]) + 0.3
        axis.set_ylim(middle - reach, middle + reach)
        axis.set_ylabel(name)
        axis.grid(alpha=0.25, lw=0.5)
    axes[0, 0].legend(fontsize=8, frameon=False)
    for axis in axes[1]:
        axis.set_xlabel("sample")
    figure.savefig(FIGURE, dpi=110)


def main(quick):
    """All tables."""
    warnings.simplefilter("ignore", UserWarning)
    if quick:
        return without_inverse("limited")
    for number, snr_db in ((1, None), (1, 20.0), (3, None), (3, 20.0)):
        found = examples(number, snr_db)
    draw(*found)
    for noise in (0.0, 0.005):
        furnaces(noise)
    print("\nCurve of w                               a        b        c   output")
    for kind in ("w + w^2", "0.3 w + w^2", "limited"):
        without_inverse(kind)
    without_inverse("limited", (-0.7, 1.0))


if __name__ == "__main__":
    main("--quick" in sys.argv)
