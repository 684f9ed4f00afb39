"""The ten figures of the paper, drawn from this library's runs.

1, 2 sinusoids: parameters and output over all seeds; 3, 4 rational: parameters by T-FLS and A-FLS; 5, 6 its output by
both; 7, 8 switching; 9, 10 exponential autoregression. Truth is grey, estimates are blue; bands hold 95 % of the seeds.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.show.axes import BLUE, GREY, RED, new_figure
from driftfit.systems.time_varying import MU, Simulated, example
from lab.reproduce.fls import Fit, fits

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ONLINE, FILTERED = "A-FLS on-line", "T-FLS filtered"
PLACES = (("sinusoids", ONLINE, 1, 2), ("rational", FILTERED, 3, 5), ("rational", ONLINE, 4, 6),
          ("switching", ONLINE, 7, 8), ("exp-ar", ONLINE, 9, 10))  # fmt: skip
"""(example, method, number of the figure of its parameters, and of its output)."""
ABOVE: dict[str, Any] = {"loc": "lower left", "bbox_to_anchor": (0.0, 1.0), "ncols": 3, "fontsize": 8, "frameon": False}
"""Where legends hide nothing."""


def draw(folder: Path, seeds: Iterable[int]) -> None:
    """Write fls_paper_01.png .. fls_paper_10.png."""
    numbers = list(seeds)
    for name, method, first, second in PLACES:
        records = [example(name, s) for s in numbers]
        found = [fits(d, MU[name])[method] for d in records]
        title = f"{name}, {method}, mu = {MU[name]:g}"
        parameters(records, found, title).savefig(folder / f"fls_paper_{first:02d}.png", dpi=110)
        outputs(records, found, title).savefig(folder / f"fls_paper_{second:02d}.png", dpi=110)


def parameters(records: list[Simulated], found: list[Fit], title: str) -> Figure:
    """True and estimated parameters: one seed, and the band of all."""
    n = records[0].theta.shape[1]
    figure = new_figure(7.0, 2.0 * n)
    theta = np.stack([fit.theta for fit in found])
    axes = figure.subplots(n, 1, sharex=True, squeeze=False).ravel()
    for i, axis in enumerate(axes):
        _band(axis, theta[:, :, i])
        axis.plot(records[0].theta[:, i], color=GREY, lw=1.6, label="true")
        axis.plot(theta[0, :, i], color=BLUE, lw=1.1, label="estimate, one seed")
        axis.set_ylabel(f"b{i + 1}")
        axis.grid(alpha=0.25, lw=0.5)
        _view(axis, np.concatenate([theta[:, :, i], [records[0].theta[:, i]]]))
    figure.suptitle(title, fontsize=9)
    axes[0].legend(**ABOVE)
    axes[-1].set_xlabel("sample")
    return figure


def outputs(records: list[Simulated], found: list[Fit], title: str) -> Figure:
    """Output, one-step prediction and a-posteriori fit of one seed; both errors, and the band of the first."""
    figure = new_figure(7.0, 4.2)
    d, fit = records[0], found[0]
    after = np.sum(d.phi * fit.theta, axis=1)
    signal, error = figure.subplots(2, 1, sharex=True)
    signal.plot(d.y, color=GREY, lw=1.6, label="output")
    signal.plot(d.y - fit.one_step, color=BLUE, lw=1.1, label="one-step prediction")
    signal.plot(after, color=RED, lw=0.8, ls="--", label="a posteriori")
    figure.suptitle(title, fontsize=9)
    signal.set_ylabel("y")
    signal.legend(**ABOVE)
    one_step = np.stack([each.one_step for each in found])
    _view(signal, np.stack([d.y, d.y - fit.one_step]))
    _view(error, one_step)
    _band(error, one_step)
    error.plot(fit.one_step, color=BLUE, lw=1.1)
    error.plot(d.y - after, color=RED, lw=0.8, ls="--")
    error.set_ylabel("error")
    error.legend(**ABOVE)
    error.set_xlabel("sample")
    for axis in (signal, error):
        axis.grid(alpha=0.25, lw=0.5)
    return figure


def _band(axis: Axes, values: Array) -> None:
    """The range of 95 % of the seeds."""
    low, high = np.nanquantile(values, (0.025, 0.975), axis=0)
    axis.fill_between(np.arange(values.shape[1]), low, high, color=BLUE, alpha=0.15, lw=0, label="95 % of the seeds")


def _view(axis: Axes, values: Array) -> None:
    """Show the settled part in full: an estimate from one or two samples can be anywhere."""
    settled = values[:, values.shape[1] // 5 :]
    margin = 0.1 * np.ptp(settled)
    axis.set_ylim(settled.min() - margin, settled.max() + margin)
