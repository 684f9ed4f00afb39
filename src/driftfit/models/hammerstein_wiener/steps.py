"""The compiled steps of `driftfit.models.hammerstein_wiener.model`.

The state keeps the functions of the last inputs and outputs, so that each is evaluated once. A basis that depends on
its own coefficients is evaluated with those estimated before the sample of the input. The output is predicted from
theta before the sample, by solving

    g_1(y) + sum_k d_k g_k(y) = -(phi' theta over all columns but those of the present output)

with `driftfit.models.hammerstein_wiener.output_curve`. The fields of the state are listed in `memory`. Orders are
constants for the compiler, so that loops over them are unrolled.

The regressors of the next sample (``next_phi``) are filled as soon as its lags are known, at the sample before. If a
row were written in single numbers and read in SIMD vectors directly afterwards, the processor would have to wait until
all writes are finished.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np

from driftfit.engine.drivers import LARGEST, ModelSteps
from driftfit.engine.kernel import Array, State, Step, kernel
from driftfit.models.base import GAP
from driftfit.models.hammerstein_wiener import output_curve
from driftfit.models.hammerstein_wiener.basis import Basis
from driftfit.models.hammerstein_wiener.output_curve import accept, inverting, laying, trying
from driftfit.models.hammerstein_wiener.structure import Structure
from driftfit.models.hammerstein_wiener.thresholds import INSIDE

DIGITS = 1e13
"""Largest ratio of the functions of a reading to the first of them, or to 1. Beyond it an absurd reading would leave
too few of sixteen digits for ordinary readings in the same columns."""
CURVED = 1e19
"""Largest function of a reading if there are several functions, which are nearly proportional for large readings. The
product of two stays below LARGEST."""


def memory(
    s: Structure, delays: Sequence[int], bases: Sequence[Basis], out: Basis, sigma: float, floor: float
) -> dict[str, Any]:
    """The fields of the state before the first sample, for measurement noise of standard deviation sigma."""
    lags = sum(width * (count + delay) for width, count, delay in zip(s.n_in, s.nb, delays, strict=True))
    outputs = np.full((1 + max(s.na, 1), s.n_out), np.nan)
    return {
        "next_phi": np.full(s.n, np.nan),
        "input_lags": np.full(lags, np.nan),  # functions of inputs t, t - 1, .. of the first input, of the second, ..
        "output_lags": outputs, "slope_lags": outputs,  # functions of outputs t, t - 1, .., and their slopes
        "input_numbers": np.concatenate([basis.parameters for basis in bases]),
        "spare": np.zeros(max(s.n_in)),  # slopes of inputs, which are not used
        "started": 0.0,  # whether all lags were known once
        "minimal": 0.0,  # whether theta is xi
        "given_noise": 0.0, "y_given": 0.0, "predicted": np.nan,
        "noise_of_y": sigma * sigma, "least_noise": floor,
        **output_curve.memory(out),
    }  # fmt: skip


class Input(NamedTuple):
    """An input: the kernel of its basis, nb, number of functions and nk; where its lags, and the numbers of its basis,
    begin; and where its b begins in theta, its c in xi, and its products b c in theta.
    """

    functions: Any
    adaptive: bool
    nb: int
    n_in: int
    nk: int
    lags: int
    numbers: int
    end: int
    b: int
    c: int
    bc: int


@lru_cache
def inputs_of(s: Structure, delays: tuple[int, ...], bases: tuple[Basis, ...]) -> tuple[Input, ...]:
    """The inputs of a model."""
    made, spans, lags, numbers, bc = [], s.spans(False), 0, 0, s.starts[1]
    for i, basis in enumerate(bases):
        nb, n_in, nk, end = s.nb[i], basis.n, delays[i], numbers + basis.parameters.size
        b, c = spans.b[i][0].item(), s.na + sum(s.nb) + sum(s.n_in[:i]) - i
        made.append(Input(basis.functions, basis.adaptive, nb, n_in, nk, lags, numbers, end, b, c, bc))
        lags, numbers, bc = lags + n_in * (nb + nk), end, bc + nb * (n_in - 1)
    return tuple(made)


def driven(inputs: tuple[Input, ...]) -> Array:
    """For each lag of each input: the entry of b, its first product b c, the distance of these, the first c in xi, how
    many c there are besides c_1, the place of the functions of the lag, and the input.
    """
    rows = [
        (one.b + j, one.bc + j, one.nb, one.c, one.n_in - 1, one.lags + (one.nk + j) * one.n_in, i)
        for i, one in enumerate(inputs)
        for j in range(one.nb)
    ]
    return np.array(rows)


@kernel
def usable(functions: Array) -> bool:
    """Whether the functions of a reading are numbers of comparable size."""
    count = functions.shape[0]
    top = min(DIGITS * max(abs(functions[0]), 1.0), CURVED) if count > 1 else LARGEST
    beyond = 0
    for k in range(count):
        beyond += 0 if abs(functions[k]) < top else 1
    return beyond == 0


@lru_cache
def _past(s: Structure) -> Any:
    """A kernel that returns -(phi' theta) without the columns of the present output, and fills d_now."""
    (at_d, _, _), n, others = s.starts, s.n, s.n_out - 1

    @kernel
    def past(s: State, l: int) -> float:
        for k in range(others):
            s.d_now[k + 1, l] = s.theta[at_d + k, l]
        one, other = 0.0, 0.0
        for i in range(at_d):
            one -= s.theta[i, l] * s.next_phi[i, l]
        i = at_d + others
        while i + 1 < n:
            one -= s.theta[i, l] * s.next_phi[i, l]
            other -= s.theta[i + 1, l] * s.next_phi[i + 1, l]
            i += 2
        if i < n:
            one -= s.theta[i, l] * s.next_phi[i, l]
        return one + other

    return past


@lru_cache
def _minimal_past(s: Structure, inputs: tuple[Input, ...]) -> Any:
    """The same if theta is xi."""
    lags, at_ad, at_n, na, more = driven(inputs), s.starts[2], s.n - s.intercept, s.na, s.n_out - 1
    count, n = len(lags), s.n
    at_d = s.n_x - s.intercept - more

    @partial(kernel, inline=False)
    def minimal_past(s: State, l: int) -> float:
        total = 0.0
        for r in range(count):
            b, bc, apart, c = lags[r, 0], lags[r, 1], lags[r, 2], lags[r, 3]
            column = s.next_phi[b, l]
            for k in range(lags[r, 4]):
                column += s.theta[c + k, l] * s.next_phi[bc + k * apart, l]
            total -= s.theta[b, l] * column
        for k in range(more):
            s.d_now[k + 1, l] = s.theta[at_d + k, l]
        for i in range(na):
            column = s.next_phi[i, l]
            for k in range(more):
                column += s.theta[at_d + k, l] * s.next_phi[at_ad + k * na + i, l]
            total -= s.theta[i, l] * column
        for i in range(at_n, n):
            total -= s.theta[at_d + more, l] * s.next_phi[i, l]
        return total

    return minimal_past


@lru_cache
def _noise_factor(na: int) -> Any:
    """A kernel: sigma^2 sum_i a_i^2 F'(y_(t-i))^2 + floor, a_0 = 1, from the estimates before the sample."""

    @partial(kernel, inline=False)
    def noise_factor(s: State, l: int) -> float:
        total = 0.0
        for i in range(na + 1):
            slope = 0.0
            for k in range(s.d_now.shape[0]):
                slope += s.d_now[k, l] * s.slope_lags[i, k, l]
            weight = 1.0 if i == 0 else s.theta[i - 1, l]
            total += weight * weight * slope * slope
        factor = s.noise_of_y[l] * total + s.least_noise[l]
        return factor if factor < LARGEST else 1.0

    return noise_factor


@lru_cache
def _filling(s: Structure, inputs: tuple[Input, ...]) -> Any:
    """A kernel (s, ago, observed, l) that fills ``next_phi`` from the lags ``ago`` samples before it, without the
    columns of the present output.
    """
    from_inputs = np.array([
        (one.bc + (k - 1) * one.nb + j if k else one.b + j, one.lags + (one.nk + j) * one.n_in + k, one.n_in)
        for one in inputs
        for k in range(one.n_in)
        for j in range(one.nb)
    ])  # fmt: skip
    lags = [(k, i) for k in range(s.n_out) for i in range(s.na)]
    columns = [(s.starts[2] + (k - 1) * s.na + i if k else i, i, k) for k, i in lags]
    from_outputs = np.array(columns, np.int64).reshape(-1, 3)
    inside, outside, last, n = len(from_inputs), len(from_outputs), s.n - s.intercept, s.n

    @kernel
    def fill(s: State, ago: int, observed: bool, l: int) -> None:
        for r in range(inside):
            place = from_inputs[r, 1] - ago * from_inputs[r, 2]
            s.next_phi[from_inputs[r, 0], l] = -s.input_lags[place, l]
        for r in range(outside):
            i, k = from_outputs[r, 1], from_outputs[r, 2]
            value = s.output_lags[i + 1 - ago, k, l]
            s.next_phi[from_outputs[r, 0], l] = value if observed or i > 0 else np.nan
        for i in range(last, n):
            s.next_phi[i, l] = 1.0

    return fill


@lru_cache
def _entering(inputs: tuple[Input, ...], i: int = 0, moves: bool = True) -> Any:
    """A kernel that adds the inputs of this sample, from input i on, to their lags, or replaces the newest."""
    functions, adaptive, nb, n_in, nk, begin, numbers, end, b, c, bc = inputs[i]
    length = n_in * (nb + nk)

    @kernel
    def feed_back(s: State, l: int) -> None:
        """The thresholds: sum_j b_j (b_j c_k) / sum_j b_j^2, or the mean of (b_j c_k) / b_j."""
        minimal, average, u_max = s.minimal[l], s.input_numbers[numbers + 3, l], s.input_numbers[numbers + 2, l]
        for k in range(2):
            total, size = 0.0, 0.0
            for j in range(nb if minimal == 0.0 else 0):
                gain, product = s.theta[b + j, l], s.theta[bc + k * nb + j, l]
                size += 1.0 if average > 0.0 else gain * gain
                total += product / gain if average > 0.0 else product * gain
            threshold = total / size if minimal == 0.0 else s.theta[c + k, l]
            if abs(threshold) < LARGEST:
                top, bottom = INSIDE * u_max * (1 - k), -INSIDE * u_max * k
                s.input_numbers[numbers + k, l] = min(max(threshold, bottom), top)

    @kernel
    def enter(s: State, l: int) -> None:
        if moves:
            if adaptive and s.ok[l] > 0.0:
                feed_back(s, l)
            for k in range(begin + length - 1, begin + n_in - 1, -1):
                s.input_lags[k, l] = s.input_lags[k - n_in, l]
        newest = s.input_lags[begin : begin + n_in, l]
        functions(s.u[i, l], s.input_numbers[numbers:end, l], newest, s.spare[:n_in, l])
        if not usable(newest):
            s.input_lags[begin, l] = np.nan

    if i + 1 == len(inputs):
        return enter
    others = _entering(inputs, i + 1, moves)

    @kernel
    def enter_all(s: State, l: int) -> None:
        enter(s, l)
        others(s, l)

    return enter_all


def _regressing(s: Structure, inputs: tuple[Input, ...], out: Any, curved: bool, fill: Any, ahead: bool) -> Any:
    """The step that makes phi; ``fill`` prepares that of the next sample, before its input is known if ``ahead``."""
    enter, past, minimal_past, noise_factor = _entering(inputs), _past(s), _minimal_past(s, inputs), _noise_factor(s.na)
    lay, invert, at_d, more, n = laying(out), inverting(out), s.starts[0], s.n_out - 1, s.n

    @kernel
    def regress(s: State, l: int) -> None:
        gap, s.given_noise[l] = s.dt[l] > GAP, s.noise[l]
        if not s.observed[l] > 0.0:  # the output before is missing, or a gate refused it
            for k in range(more + 1):
                s.output_lags[0, k, l] = np.nan
            if ahead:
                fill(s, 1, False, l)
        elif abs(s.y_given[l]) < LARGEST:
            accept(s, s.y_given[l], l)  # not before a gate has judged it
        for i in range(s.output_lags.shape[0] - 1, 0, -1):
            for k in range(more + 1):
                s.output_lags[i, k, l], s.slope_lags[i, k, l] = s.output_lags[i - 1, k, l], s.slope_lags[i - 1, k, l]
        if curved and s.grid_due[l] > 0.0:
            lay(s, l)
        if gap:  # all lags are missing
            for i in range(s.input_lags.shape[0]):
                s.input_lags[i, l] = np.nan
            for i in range(s.output_lags.shape[0]):
                for k in range(more + 1):
                    s.output_lags[i, k, l], s.slope_lags[i, k, l] = np.nan, np.nan
        enter(s, l)
        if not ahead or gap:
            fill(s, 0, True, l)
        missing = 0
        for i in range(n):
            if i < at_d or i >= at_d + more:
                missing += 0 if abs(s.next_phi[i, l]) < LARGEST else 1
        if missing == 0:
            s.started[l] = 1.0
        right = minimal_past(s, l) if s.minimal[l] > 0.0 else past(s, l)
        y = s.y[l]
        observed = abs(y) < LARGEST
        if observed:
            out(y, s.output_numbers[:, l], s.output_lags[0, :, l], s.slope_lags[0, :, l])
            observed = usable(s.output_lags[0, :, l])
        s.y_given[l] = y if observed else np.nan
        if curved:
            right = invert(s, right, l)
        s.predicted[l] = right
        if not observed:
            out(right, s.output_numbers[:, l], s.output_lags[0, :, l], s.slope_lags[0, :, l])
        s.noise[l] *= noise_factor(s, l) if s.noise_of_y[l] > 0.0 else 1.0
        s.y[l] = -s.output_lags[0, 0, l] if observed else np.nan
        s.dt[l] = s.dt[l] if s.started[l] > 0.0 else 0.0
        for i in range(n):
            s.phi[i, l] = s.next_phi[i, l]
        for k in range(more):
            s.phi[at_d + k, l] = s.output_lags[0, k + 1, l]
        if ahead:
            fill(s, 1, observed, l)

    return regress


@lru_cache
def build(s: Structure, inputs: tuple[Input, ...], out: Any, curved: bool) -> ModelSteps:
    """The steps of a model with the kernel ``out`` of its output block; ``curved`` unless that is the identity."""
    fill, ahead, place = _filling(s, inputs), min(one.nk for one in inputs) > 0, _entering(inputs, moves=False)
    begins, widths = tuple(one.lags for one in inputs), tuple(one.n_in for one in inputs)
    regress = _regressing(s, inputs, out, curved, fill, ahead)

    @kernel
    def push(s: State, l: int) -> None:
        s.noise[l], s.y_hat[l] = s.given_noise[l], s.predicted[l]

    @kernel
    def apply(s: State, l: int) -> None:
        place(s, l)
        fill(s, 1, s.observed[l] > 0.0, l)

    @kernel
    def refuse(s: State, signal: int, age: int, l: int) -> None:
        for i in range(len(begins)):
            if i == signal:
                for k in range(widths[i]):
                    s.input_lags[begins[i] + age * widths[i] + k, l] = np.nan
        if ahead:
            fill(s, 1, abs(s.y_given[l]) < LARGEST, l)

    oldest = max(one.nb + one.nk for one in inputs) - 1
    foresee = partial(foreseeing, out, s.starts[0]) if curved else None
    return ModelSteps(regress, push, foresee, apply if ahead else None, oldest, refuse, width=1)


@lru_cache
def foreseeing(out: Any, at_d: int, forecast: Step) -> Step:
    """`ModelSteps.foreseeing`: y - y_hat is F' (y - y_hat) in the equation, and s is that of phi at y_hat."""
    try_output = trying(out)

    @kernel
    def foresee(s: State, l: int) -> None:
        y_hat, own = s.predicted[l], 0.0
        try_output(s, y_hat, l)
        slope = s.trial_slopes[0, l]
        for k in range(1, s.d_now.shape[0]):
            slope += s.d_now[k, l] * s.trial_slopes[k, l]
        if abs(y_hat) < LARGEST:
            for back in range(2):
                for k in range(1, s.d_now.shape[0]):
                    s.phi[at_d + k - 1, l], s.trial[k, l] = s.trial[k, l], s.phi[at_d + k - 1, l]
                forecast(s, l)
                own = own if back else s.s[l]
            s.y_hat[l], s.s[l] = -s.trial[0, l], own
            s.e[l] = slope * (s.y_given[l] - y_hat)

    return foresee  # type: ignore[no-any-return]
