"""Figures 1 to 13 of the paper, drawn from this library's runs of seed 0. Truth is grey."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.show.axes import BLUE, GREY, RED, new_figure
from driftfit.systems.arc_furnace import furnace, resistance, valve
from driftfit.systems.hammerstein_wiener import CUBIC, START, Simulated, example
from driftfit.tracking import track
from lab.reproduce.hammerstein_wiener.runs import FAST, PAPER, STARTS, fourth_example, off, separated

if TYPE_CHECKING:
    from matplotlib.figure import Figure

METHODS = {"average": RED, "svd": BLUE}
FADED = {"average": 0.5, "svd": 1.0}
GREEN = "#3a8f4f"


def draw(folder: Path) -> None:
    """Write hammerstein_wiener_01.png .. 13."""

    def save(number: int, figure: Figure) -> None:
        figure.savefig(folder / f"hammerstein_wiener_{number:02d}.png", dpi=80)

    save(1, structure_of_the_model())
    save(11, structure_of_the_furnace())
    for first, s in ((2, example(1, 0)), (8, example(3, 0, snr_db=20.0))):
        run = track(s.model, PAPER, s.y, s.u)
        paths = {method: separated(run, method) for method in METHODS}
        title = f"example {1 if first == 2 else '3, 20 dB'}, Q = 10 I, R = 0.01"
        save(first, errors({m: off(xi, s) for m, xi in paths.items()}, title))
        save(first + 1, parameters(s, paths, slice(0, 4), title))
        save(first + 2, parameters(s, paths, slice(4, 8), title))
    s = example(2, 0, T=600)
    for number, start in zip((5, 6, 7), STARTS, strict=True):
        run = track(s.model, replace(PAPER, theta0=start), s.y, s.u)
        with np.errstate(all="ignore"):
            ekf = off(track(s.model, replace(FAST, theta0=start), s.y, s.u).theta, s)
        paths = {"two-stage": off(separated(run, "svd-joint"), s), "extended Kalman": ekf}
        save(number, errors(paths, f"example 2, theta0 = {start:g}"))
    f = furnace(0)
    raw = {f"raw powers, q = {q}": fourth_example(f, q, True, "average") for q in (4, 5, 6)}
    raw["Legendre, q = 4"] = fourth_example(f, 4, False, "svd")
    save(12, errors({name: r.a + r.b + r.p for name, r in raw.items()}, "example 4, Er of (67)"))
    save(13, residuals({name: r.equation for name, r in raw.items()}))


def structure_of_the_model() -> Figure:
    """The three blocks, with the curves of examples 1 to 3 at their beginning."""
    x = np.linspace(-1.5, 1.5, 61)
    into, out = ([1.0, *START[name]] @ CUBIC.out.value(x).T for name in "cd")
    blocks = (("F_I,t", (x, into)), ("G_t(z^-1)", None), ("F_O,t", (out, x)))
    return chain(blocks, ("u_t", "v_t", "w_t", "y_t"), "the Hammerstein-Wiener system, and its static curves at t = 0")


def structure_of_the_furnace() -> Figure:
    """Valve, hydraulic drive and arc, with the curves of valve and arc, the arc at the beginning."""
    u, L = np.linspace(-12.0, 12.0, 121), np.linspace(5.0, 40.0, 61)
    arc = (L, resistance(L, np.full(len(L), 6.0)))
    blocks = (("proportional valve (V)", (u, valve(u))), ("hydraulic system", None), ("arc (cm to mOhm)", arc))
    return chain(blocks, ("u", "v", "L", "R_arc"), "the electric arc furnace as a Hammerstein-Wiener system")


def chain(blocks: Sequence[tuple[str, tuple[Array, Array] | None]], signals: Sequence[str], title: str) -> Figure:
    """Blocks in series with the signals between them; a curve is drawn in the block it belongs to."""
    figure = new_figure(7.0, 1.9)
    figure.set_layout_engine("none")
    page = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    page.axis("off")
    page.set(xlim=(0.0, 1.0), ylim=(0.0, 1.0))
    step, width = 1.0 / len(blocks), 0.2
    for k, (name, curve) in enumerate(blocks):
        left = (k + 0.5) * step - 0.5 * width
        box = figure.add_axes((left, 0.22, width, 0.46), xticks=[], yticks=[])
        box.set_title(name, fontsize=9)
        if curve is None:
            box.text(0.5, 0.5, "linear,\nlags of w and v", ha="center", va="center", fontsize=8)
        else:
            box.plot(*curve, color=BLUE, lw=1.2)
    for k, signal in enumerate(signals):
        start = max((k - 0.5) * step + 0.5 * width, 0.005)
        end = min((k + 0.5) * step - 0.5 * width, 0.995)
        page.annotate("", (end, 0.45), (start, 0.45), arrowprops={"arrowstyle": "->", "color": GREY})
        page.text(0.5 * (start + end), 0.5, signal, ha="center", fontsize=9)
    page.text(0.01, 0.05, title, fontsize=9)
    return figure


def errors(paths: Mapping[str, Array], title: str) -> Figure:
    """Errors over time, on a logarithmic axis."""
    figure = new_figure(7.0, 3.4)
    axis = figure.subplots()
    colours = (RED, BLUE, GREEN, "black")
    for (name, path), colour in zip(paths.items(), colours, strict=False):
        axis.semilogy(path, lw=0.8, color=colour, label=name)
    settled = np.concatenate([path[50:] for path in paths.values()])
    settled = settled[np.isfinite(settled) & (settled > 0.0)]
    low, high = np.quantile(settled, (0.001, 0.999))
    axis.set_ylim(0.5 * low, 3.0 * max(high, 1.0))
    axis.set(xlabel="sample", ylabel="error of the parameters")
    axis.set_title(title, fontsize=9, loc="left")
    axis.legend(fontsize=8, frameon=False, ncols=2, loc="lower right", bbox_to_anchor=(1.0, 1.0), borderpad=0.0)
    axis.grid(alpha=0.25, lw=0.5)
    return figure


def parameters(s: Simulated, paths: Mapping[str, Array], part: slice, title: str) -> Figure:
    """True and estimated parameters."""
    figure = new_figure(7.0, 6.0)
    names = s.model.structure.minimal_names[part]
    axes = figure.subplots(len(names), 1, sharex=True)
    for axis, name, i in zip(axes, names, range(part.start, part.stop), strict=True):
        axis.plot(s.xi[:, i], lw=2.6, color=GREY, alpha=0.7, label="true")
        for method, xi in paths.items():
            axis.plot(xi[:, i], lw=0.6, color=METHODS[method], alpha=FADED[method], label=method)
        shown = np.concatenate([s.xi[:, i], paths["svd"][500:, i]])
        low, high = np.quantile(shown, (0.005, 0.995))
        axis.set_ylim(low - 0.3 * (high - low), high + 0.3 * (high - low))
        axis.set_ylabel(name)
        axis.grid(alpha=0.25, lw=0.5)
    figure.suptitle(title, fontsize=9)
    axes[0].legend(fontsize=8, frameon=False, ncols=3, loc="lower left", bbox_to_anchor=(0.0, 1.0))
    axes[-1].set_xlabel("sample")
    return figure


def residuals(paths: Mapping[str, Array]) -> Figure:
    """Errors of the equation, a panel each."""
    figure = new_figure(7.0, 6.0)
    axes = figure.subplots(len(paths), 1, sharex=True)
    for axis, (name, path) in zip(axes, paths.items(), strict=True):
        axis.plot(path, lw=0.6, color=BLUE)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            reach = float(np.nanquantile(np.abs(path[500:]), 0.999))
        axis.set_ylim(-3.0 * reach, 3.0 * reach)
        axis.set_title(name, fontsize=9)
        axis.grid(alpha=0.25, lw=0.5)
    axes[-1].set_xlabel("sample")
    figure.supylabel("error of the equation", fontsize=10)
    return figure
