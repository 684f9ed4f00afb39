"""A static curve before a linear system, recovered from the coefficient of its input.

y_t = 0.5 y_{t-1} + f(u_{t-1}) + noise with f(u) = u + 0.5 u^3 and white u. As an ARX(1, 1) model the coefficient of the
input is f(u) / u: it jumps in time and is smooth along u. Run: python examples/static_curve.py [picture.png]
"""

import sys
import warnings

import numpy as np

from driftfit import FLS, static_curve, track, tune
from driftfit.show.axes import BLUE, GREY, RED, new_figure
from driftfit.systems.time_varying import hammerstein


def main(picture: str | None = None) -> None:
    rng = np.random.default_rng(5)
    d = hammerstein(rng.uniform(-1.5, 1.5, 300), lambda u: u + 0.5 * u**3, rng=rng)
    before = np.concatenate([[0.0], d.u[:-1, 0]])  # the input that acts on the output
    curves = {}
    for label, order in (("in time", None), ("along the input", before)):
        with warnings.catch_warnings():
            warnings.simplefilter(
                "ignore"
            )  # the lag coefficient is constant, and time is the wrong order: both are said
            tuned = tune(d.model, FLS(), d.y, d.u, method="loo", groups="each", order_by=order)
            path = track(d.model, tuned.tracker, d.y, d.u).smooth(order_by=order)
            curves[label] = curve = static_curve(path, "b1")
        error = curve.value - (curve.input + 0.5 * curve.input**3)
        print(f"smoothed {label}: rms error of the curve {np.sqrt(np.mean(error**2)):.3f}")
    if picture:
        figure = new_figure(6.5, 4.0)
        axis = figure.subplots()
        u = np.linspace(-1.5, 1.5, 200)
        axis.plot(u, u + 0.5 * u**3, color=GREY, lw=3.0, label="f")
        for (label, curve), color in zip(curves.items(), (RED, BLUE), strict=True):
            axis.plot(curve.input, curve.value, ".", ms=3.0, color=color, label=f"smoothed {label}")
        axis.set_xlabel("input u")
        axis.set_ylabel("f(u)")
        axis.legend(fontsize=8, frameon=False)
        axis.grid(alpha=0.25, lw=0.5)
        figure.savefig(picture, dpi=90)


if __name__ == "__main__":
    main(*sys.argv[1:2])
