"""Pictures of the system behind a run: its responses over time, its poles in the plane, its fit its blocks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from driftfit.data.arguments import as_output
from driftfit.engine.kernel import Array
from driftfit.run.live.conformal import quantile
from driftfit.show.axes import BLUE, GREY, RED, date_axis, frame, named, panels, settled, time_label
from driftfit.use.blocks import blocks_of
from driftfit.use.simulate import fit, simulate
from driftfit.use.system import dc_gain, frequency_response, input_of, largest_pole, linear, poles, step_response

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from driftfit.run.result import Track

RESPONSES_DRAWN = 5
"""Number of samples whose responses are drawn by default."""

STEP_SAMPLES = 200
"""Largest number of samples of a step response."""


def plot_system(
    run: Track, input: int | str = 0, at: Any = None, h: int | None = None, level: float = 0.95, dt: float = 1.0,
    ax: Any = None,
) -> Figure:  # fmt: skip
    """Step and frequency response at some samples, with bands; poles in the plane; gain over time.

    Parameters
    ----------
    run : Track
        A run of ARX, ARMAX, OE or BoxJenkins.
    input : int or name
        The input of the step.
    at : samples
        The samples whose responses are drawn; by default five from the end of the start to the last. Dark is late.
    h : int
        Samples of the step response; None: until the slowest of these systems has settled, at most 200.
    level : number
        Level of the bands, which are pointwise, from the covariance of the run.
    dt : number
        Time between samples, for the axes of the responses: frequencies are then in radians per unit of time.
    ax : axes or None
        As for `Track.plot`; four panels.

    Raises
    ------
    ValueError
        For another model, or an input that does not exist.
    """
    linear(run)
    j = input_of(run, input)
    first = settled(run).start
    chosen = (
        np.unique(np.linspace(first, len(run) - 1, RESPONSES_DRAWN).astype(int)) if at is None else np.atleast_1d(at)
    )
    length = _settling(run, chosen) if h is None else h
    figure, (step, magnitude, plane, gain) = panels(ax, (10.0, 7.4), 4, 2)
    colours = _shades(len(chosen))
    _step(step, run, j, chosen, length, level, dt, colours)
    _frequency(magnitude, run, j, chosen, level, dt, colours)
    _plane(plane, run, first)
    _gain(gain, run, j, first, level)
    return figure


def _settling(run: Track, at: Array) -> int:
    """Samples until the slowest stable mode has decayed to 2 per cent."""
    found, (_, parts) = poles(run, at), run.model.transfers(run.theta[:1])
    sizes = np.abs(found[:, 0]) if found.shape[1] else np.zeros(1)
    slowest = float(np.max(np.where(sizes < 1.0, sizes, 0.99)))
    lags = max(B.shape[-1] for B, _ in parts)
    return int(np.clip(lags + (np.log(0.02) / np.log(slowest) if slowest > 0.02 else 1.0), 10, STEP_SAMPLES))


def _shades(count: int) -> list[Any]:
    """Shades of blue, from light (early) to dark (late)."""
    from matplotlib.colors import LinearSegmentedColormap

    ramp = LinearSegmentedColormap.from_list("time", ["#b9d3ef", BLUE, "#0a2747"])
    return [ramp(x) for x in (np.linspace(0.0, 1.0, count) if count > 1 else [0.6])]


def _step(axis: Axes, run: Track, j: int, at: Array, h: int, level: float, dt: float, colours: list[Any]) -> None:
    response = step_response(run, h, j, at)
    low, high = response.band(level)
    time = np.arange(h) * dt
    for k, t in enumerate(at):
        if np.isfinite(low[k]).all():
            axis.fill_between(time, low[k], high[k], color=colours[k], alpha=0.2, lw=0, step="post")
        axis.step(time, response.value[k], where="post", color=colours[k], lw=1.3, label=run.time_text(int(t)))
    _titled(axis, f"step response to {_input_name(run, j)}")
    axis.set_xlabel("samples" if dt == 1.0 else "time", fontsize=9)
    axis.legend(fontsize=7, frameon=False, loc="best")


def _frequency(axis: Axes, run: Track, j: int, at: Array, level: float, dt: float, colours: list[Any]) -> None:
    response = frequency_response(run, None, j, at)
    half = np.exp(quantile(level) * response.log_magnitude_std)
    w = response.w / dt
    for k, colour in enumerate(colours):
        if np.isfinite(half[k]).all():
            band = response.magnitude[k] / half[k], response.magnitude[k] * half[k]
            axis.fill_between(w, *band, color=colour, alpha=0.2, lw=0)
        axis.loglog(w, response.magnitude[k], color=colour, lw=1.3)
    phase = axis.twinx()
    for k, colour in enumerate(colours):
        phase.semilogx(w, np.degrees(response.phase[k]), color=colour, lw=0.8, ls=":")
    phase.set_ylabel("phase, degrees (dotted)", fontsize=8)
    phase.tick_params(labelsize=8)
    _titled(axis, f"frequency response to {_input_name(run, j)}: magnitude")
    axis.set_xlabel("radians per sample" if dt == 1.0 else "radians per unit of time", fontsize=9)


def _plane(axis: Axes, run: Track, first: int) -> None:
    """Poles at every sample, light to dark, in the unit circle; outside it a system is unstable."""
    path = poles(run)[first:]
    axis.plot(*np.array([(np.cos(x), np.sin(x)) for x in np.linspace(0.0, 2.0 * np.pi, 200)]).T, color=GREY, lw=0.8)
    axis.axhline(0.0, color=GREY, lw=0.4)
    axis.axvline(0.0, color=GREY, lw=0.4)
    step = max(1, len(path) // 400)
    shades = _shades(len(path[::step]))
    for column in path[::step].T:
        axis.scatter(column.real, column.imag, c=shades, s=7, lw=0)
    for last in path[-1] if len(path) else []:
        axis.plot(last.real, last.imag, marker="x", color=RED, ms=6, mew=1.3, ls="")
    reach = max(1.1, 1.1 * float(np.max(np.abs(path), initial=0.0)))
    axis.set_xlim(-reach, reach)
    axis.set_ylim(-reach, reach)
    axis.set_aspect("equal")
    if reach < 1.5:
        axis.set_xticks([-1.0, -0.5, 0.0, 0.5, 1.0])
        axis.set_yticks([-1.0, -0.5, 0.0, 0.5, 1.0])
    _titled(axis, "poles: light early, dark late, last red")


def _gain(axis: Axes, run: Track, j: int, first: int, level: float) -> None:
    gain, pole = dc_gain(run), largest_pole(run)
    low, high = (part[:, j] for part in gain.band(level))
    axis.fill_between(run.time, low, high, color=BLUE, alpha=0.2, lw=0)
    axis.plot(run.time, gain.value[:, j], color=BLUE, lw=1.3)
    frame(axis, np.concatenate([gain.value[first:, j], low[first:], high[first:]]))
    if poles(run, -1).shape[1]:
        size = axis.twinx()
        size.plot(run.time, pole.value, color=RED, lw=0.8)
        size.set_ylabel("largest pole (red)", fontsize=8)
        size.set_ylim(0.0, max(1.05, float(np.nanmax(pole.value[first:], initial=0.0)) * 1.05))
        size.tick_params(labelsize=8)
    _titled(axis, f"steady-state gain of {_input_name(run, j)}")
    axis.set_xlabel(time_label(run), fontsize=9)
    date_axis(axis, run)


def _input_name(run: Track, j: int) -> str:
    names = run.model.input_names
    return str(names[j]) if names else f"u{j + 1}"


def _titled(axis: Axes, title: str) -> None:
    axis.set_title(title, fontsize=10, loc="left")
    axis.grid(alpha=0.25, lw=0.5)
    axis.tick_params(labelsize=8)


def plot_validation(run: Track, y: Any, u: Any, at: int = -1, level: float = 0.95, ax: Any = None) -> Figure:
    """Free simulation of the model at one sample on data that it has not used, with the measured outputs.

    The first outputs, as many as its regressors reach back, are given to the simulation. The fit, in per cent,
    is that of `driftfit.use.simulate.fit`.
    """
    output = as_output(y)
    lags = run.model.reach
    simulated = simulate(run, u, at, np.nan_to_num(output[:lags]))
    low, high = simulated.band(level)
    time = np.arange(len(output))
    figure, (signal, error) = panels(ax, (9.0, 4.2), 2, sharex=True, heights=[2.4, 1.0])
    signal.fill_between(time, low, high, color=BLUE, alpha=0.2, lw=0)
    signal.plot(time, output, color=GREY, lw=1.0, label="measured")
    signal.plot(time, simulated.y_hat, color=BLUE, lw=1.1, label=f"simulated, parameters of {run.time_text(at)}")
    signal.legend(fontsize=8, frameon=False, ncols=2, loc="lower right", bbox_to_anchor=(1.0, 1.0))
    signal.set_ylabel(named(run.labels.y, run.labels.units.get(run.labels.y, "")))
    frame(signal, np.concatenate([output, simulated.y_hat]))
    _titled(signal, f"fit {fit(output[lags:], simulated.y_hat[lags:]):.1f} %")
    error.fill_between(time, low - simulated.y_hat, high - simulated.y_hat, color=BLUE, alpha=0.15, lw=0)
    error.plot(time, output - simulated.y_hat, color=BLUE, lw=0.8)
    error.axhline(0.0, color=GREY, lw=0.6)
    error.set_ylabel("error")
    error.set_xlabel("sample of the validation record")
    error.grid(alpha=0.25, lw=0.5)
    return figure


CURVE_POINTS = 200


def plot_blocks(run: Track, method: str = "svd-joint", times: Sequence[int] | None = None, ax: Any = None) -> Figure:
    """The curves of the inputs and the output at samples ``times`` (four by default), and a, b, c, d over time."""
    from matplotlib import colormaps

    found = blocks_of(run, method)
    T, m = len(run), found.model.m
    chosen = [T // 4, T // 2, 3 * T // 4, T - 1] if times is None else [range(T)[t] for t in times]
    colours = colormaps["viridis"](np.linspace(0.0, 0.85, len(chosen)))
    heights = [1.4] * (m // 2 + 1) + [1.0] * (-(-(m + 5) // 2) - m // 2 - 1)
    figure, axes = panels(ax, (9.0, 2.2 * len(heights)), m + 5, 2, heights=heights)
    curves, below = axes[: m + 1], axes[m + 1 :]
    *lefts, right = curves
    y = _points(run.y)
    for t, colour in zip(chosen, colours, strict=True):
        label = run.time_text(t) if run.timed else f"sample {t}"
        for i, left in enumerate(lefts):
            u = _points(run.u[:, i])
            left.plot(u, found.input_curve(u, t, i), color=colour, lw=1.3, label=label)
        right.plot(found.output_curve(y, t), y, color=colour, lw=1.3)
    for i, left in enumerate(lefts):
        name = run.labels.u[i] if run.labels.u else "u" if m == 1 else f"u{i + 1}"
        left.set(xlabel=name, ylabel="v", title="input block" if m == 1 else f"block of {name}")
    right.set(xlabel="w", ylabel=run.labels.y, title="output block")
    lefts[0].legend(fontsize=8, frameon=False)
    groups = zip(below, "abcd", (found.a, found.b, found.c, found.d), found.names, found.std, strict=True)
    for place, (axis, letter, group, names, std) in enumerate(groups):
        _paths(axis, run, group, names, std)
        axis.set_ylabel(letter)
        if place > 1:
            axis.set_xlabel(time_label(run))
        date_axis(axis, run)
    for axis in curves:
        axis.title.set_fontsize(10)
        axis.grid(alpha=0.25, lw=0.5)
    return figure


def _points(signal: Any) -> Any:
    """Points over the central 99 % of a signal."""
    values = signal[np.isfinite(signal)]
    low, high = np.quantile(values, (0.005, 0.995)) if values.size else (-1.0, 1.0)
    return np.linspace(low, high, CURVE_POINTS)


def _paths(axis: Axes, run: Track, group: Any, names: Any, std: Any) -> None:
    """Coefficients over time, with bands of two standard deviations if known; the leading 1 is left out."""
    late = settled(run)
    shown = [i for i in range(group.shape[1]) if not np.all(group[late, i] == 1.0)]
    for i in shown:
        (line,) = axis.plot(run.time, group[:, i], lw=1.2, label=names[i])
        known = np.isfinite(std[:, i])
        low, high = group[:, i] - 2.0 * std[:, i], group[:, i] + 2.0 * std[:, i]
        axis.fill_between(run.time, low, high, where=known, color=line.get_color(), alpha=0.2, lw=0)
    if shown:
        frame(axis, group[late][:, shown].ravel())
        axis.legend(fontsize=8, frameon=False, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=len(shown))
    else:
        axis.text(0.5, 0.5, "the identity", transform=axis.transAxes, ha="center", va="center", color="grey")
        axis.set_axis_off()
    axis.grid(alpha=0.25, lw=0.5)
