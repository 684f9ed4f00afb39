"""The steps of a bank in the lane form: one filter until it can begin, then the compiled routine of `advance`."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np

from driftfit.bank.layout import BASES as BASE_NAMES
from driftfit.bank.layout import (
    COUNTER,
    ENTER,
    ENTER_NEW,
    FORECAST,
    LEARN,
    MEMORY_AT,
    OUTPUT_LAGS,
    READY,
    REPORT_AT,
    ROW,
    ROWS,
    SAMPLE,
    WAITING,
    memory_at,
    report_at,
)
from driftfit.bank.leaves.lags import PLAUSIBLE
from driftfit.bank.leaves.own_sensor import OWN_AT, entry_of
from driftfit.bank.machine.advance import bank
from driftfit.bank.machine.framed import begin_framed, frame_theta, outgrown, read_framed, spans_lags
from driftfit.engine.drivers import COMMON, TrackerSteps, diagonal
from driftfit.engine.kernel import Array, State, exp, floats, kernel, log, nothing
from driftfit.readings.repeats import resolve
from driftfit.trackers.forms.coordinates import new_row, whiten_within
from driftfit.trackers.forms.covariance import prediction
from driftfit.trackers.forms.diffuse import (
    ENTERING,
    MACHINES,
    NOISE,
    NOW,
    OK,
    WORK,
    Y,
    absorb_on_roots,
    forecast_on_roots,
    spanned_variance,
    wander,
)
from driftfit.trackers.forms.diffuse import hand_over as choose_form
from driftfit.trackers.forms.excitation import learn_scales
from driftfit.trackers.mixture.filters import LEAST_SHARE
from driftfit.trackers.student import RESIDUALS, wider

BASES = len(BASE_NAMES)
GIVEN, GIVEN_CHAIN, DRIFT, LAG_ROWS = (ROW[name] for name in ("given", "given_chain", "drift", "lag_rows"))
LONGEST = 4.0
"""At most so many repeated readings in a row count."""


@kernel
def keep(o: State, s: State, l: int) -> None:
    """Store the report of events."""
    size, L = o.report.shape
    report = floats(report_at(s), size, L)
    for k in range(size):
        o.report[k, l] = report[k, l]


@kernel
def only_drift(s: State, l: int) -> None:
    """The time update by the first change, for the single filter before the bank starts."""
    n = s.theta.shape[0]
    time = s.dt[l] * s.drift[l]
    root = exp(-0.5 * s.dt[l] * log(s.keep0[l]))
    for i in range(n):
        s.d[i, l] *= root
        for j in range(i, n):
            s.S[i, j, l] *= root
            s.H[i, j, l] = s.G[i, j, l]
    wander(s, np.sqrt(time), l)
    for i in range(n):
        unit = s.r[l] / s.c[i, l] if s.c[i, l] > 0.0 else 0.0
        for j in range(i, n):
            s.H[i, j, l] = np.sqrt(s.size0[i, l] * unit) if i == j else 0.0
    wander(s, np.sqrt(time), l)


@kernel
def moved(at: int, size: int, L: int, l: int, to: int, back: bool) -> int:
    """Copy lane l of a field of ``size`` numbers to an address, or ``back``; returns the address behind the copy."""
    lane, flat = floats(at, size, L), floats(to, 1, size)
    for k in range(size):
        if back:
            lane[k, l] = flat[0, k]
        else:
            flat[0, k] = lane[k, l]
    return to + 8 * size


@kernel
def run(s: State, l: int) -> None:
    """Call the compiled routine, whose table receives the addresses of the fields for that time. The numbers of one of
    several lanes are not contiguous, so the routine works on copies behind the memory.
    """
    n, L, framed = s.theta.shape[0], s.theta.shape[1], s.counters[COUNTER.framed, l] > 0
    sizes = (
        s.table[MEMORY_AT, 2, l], s.table[REPORT_AT, 2, l], n, n, n, n * n, n * n, n * n, n * n, n * n, WORK * n, NOW,
        s.counters.shape[0], s.sample.shape[0], 3 * ROWS,
    )  # fmt: skip
    fields = (
        memory_at(s), report_at(s), np.int64(s.x.ctypes.data if framed else s.phi.ctypes.data),
        np.int64(s.c.ctypes.data), np.int64(s.d.ctypes.data if framed else s.theta.ctypes.data),
        np.int64(s.Pz.ctypes.data if framed else s.P.ctypes.data), np.int64(s.S.ctypes.data),
        np.int64(s.R.ctypes.data), np.int64(s.H.ctypes.data), np.int64(s.W.ctypes.data), np.int64(s.work.ctypes.data),
        np.int64(s.at_start.ctypes.data), np.int64(s.counters.ctypes.data), np.int64(s.sample.ctypes.data),
        np.int64(s.table.ctypes.data),
    )  # fmt: skip
    copies = fields[0] + 8 * sizes[0] * L
    to = copies
    for k in range(BASES):
        s.table[MEMORY_AT + k, 0, l] = to if L > 1 else fields[k]
        to = moved(fields[k], sizes[k], L, l, to, False) if L > 1 else fields[BASES]
    if L > 1:
        moved(fields[BASES], sizes[BASES], L, l, to, False)
    bank(to)
    for k in range(BASES if L > 1 else 0):
        copies = moved(fields[k], sizes[k], L, l, copies, True)
    for k in range(BASES):  # addresses are not part of the state
        s.table[MEMORY_AT + k, 0, l] = 0
    if s.counters[COUNTER.phase, l] == LEARN:
        s.table[OWN_AT, 0, l] = 0


@kernel
def repeated(s: State, l: int) -> float:
    """The factor of the noise variance for a repeated reading of a coarse meter, which shares its error of rounding."""
    return 1.0 + min(s.alike[l], LONGEST) if s.floor[l] > 0.0 else 1.0


@kernel
def least_noise(s: State, l: int) -> float:
    """The least r."""
    return max(LEAST_SHARE * s.power[l] + 1e-300, s.floor[l] / s.noise[l])  # type: ignore[no-any-return]


@kernel
def learn_scale(s: State, l: int) -> None:
    """Count the innovation; s.s becomes a variance with the scale known before this sample, and s.scale is updated."""
    counted = s.ok[l] if (s.alike[l] < 1.0) | (s.floor[l] > 0.0) else 0.0
    s.squares[l] += counted * s.e[l] * s.e[l] / s.s[l]
    s.count[l] += counted
    s.s[l] *= s.scale[l]
    scale, least = s.squares[l] / s.count[l], s.floor[l] / s.noise[l]
    s.scale[l] = least if least > scale else scale  # NaN is kept


@kernel
def hand_over(s: State, l: int) -> None:
    """Write the numbers of this sample for the compiled routine, and the output lags of the record."""
    n, memory = s.theta.shape[0], floats(memory_at(s), s.table[MEMORY_AT, 2, l], s.theta.shape[1])
    for k in range(s.table[OUTPUT_LAGS, 0, l]):
        memory[s.table[LAG_ROWS, 0, l] // 8 + k * (n + 1) + n, l] = s.phi[k, l]
    s.sample[SAMPLE.y, l], s.sample[SAMPLE.noise, l], s.sample[SAMPLE.dt, l] = s.y[l], s.noise[l], s.dt[l]
    s.sample[SAMPLE.time, l], s.sample[SAMPLE.shift, l] = s.dt[l] * s.drift[l], s.shift[l]
    s.sample[SAMPLE.ok, l], s.sample[SAMPLE.observed, l] = s.ok[l], s.observed[l]
    s.sample[SAMPLE.r, l], s.sample[SAMPLE.least, l] = s.r[l], least_noise(s, l)
    s.sample[SAMPLE.most, l] = PLAUSIBLE * s.power[l] if s.power[l] > 0.0 else np.inf


@kernel
def alone(s: State, l: int) -> None:
    """After a sample of the single filter: update scales, noise and lags, and begin the bank as soon as possible."""
    learn_scales(s, l)
    residuals = s.count[l]
    s.sample[SAMPLE.freedom, l] = residuals if s.unknown[l] > 0 else np.inf
    if s.unknown[l] > 0 and s.s[l] < np.inf:
        learn_scale(s, l)
        s.scale[l] *= wider(s.count[l])
    s.within[l] += s.ok[l] if s.s[l] < np.inf else 0.0
    hand_over(s, l)
    s.sample[SAMPLE.noise, l] *= repeated(s, l)
    s.sample[SAMPLE.y_hat, l], s.sample[SAMPLE.s, l] = s.y_hat[l], s.s[l] / wider(residuals)
    s.sample[SAMPLE.squares, l], s.sample[SAMPLE.times, l] = s.squares[l], s.count[l]
    ready = s.unknown[l] == 0 or s.count[l] >= RESIDUALS
    if ready:
        choose_form(s, l)
    if ready and s.root[l] > 0:
        ready = s.can_frame[l] > 0 and s.within[l] >= RESIDUALS and spans_lags(s, l)
        if ready:
            begin_framed(s, l)
    s.counters[COUNTER.settled, l] = READY if ready else WAITING
    run(s, l)
    if ready:
        s.scale[l] = 1.0


@kernel
def forecast_tree(s: State, l: int) -> None:
    """The forecast of the tree, in theta or in coordinates of the start."""
    column, y_hat, outside = -1, 0.0, False
    if s.counters[COUNTER.framed, l] > 0:
        column, y_hat = whiten_within(s, s.phi[:, l], l), prediction(s, l)
        outside = column >= 0
    if not outside and s.ok[l] > 0.0 and s.can_frame[l] > 0:
        column = outgrown(s, l)
        if column >= 0 and s.counters[COUNTER.framed, l] == 0:
            frame_theta(s, l)
    hand_over(s, l)
    s.column[l] = column
    if column >= 0:
        s.sample[SAMPLE.ok, l] = 0.0
    s.counters[COUNTER.phase, l] = FORECAST
    run(s, l)
    s.counters[COUNTER.phase, l] = LEARN
    s.y_hat[l], s.s[l] = s.sample[SAMPLE.y_hat, l], s.sample[SAMPLE.s, l]
    if outside:
        s.y_hat[l], s.s[l] = y_hat, np.inf
    s.e[l] = s.y[l] - s.y_hat[l]


@kernel
def enter(s: State, column: int, l: int) -> None:
    """Row ``column`` of M becomes the rest of this regressor. The tree has made the time update."""
    fresh = s.S[column, column, l] == 0.0
    sign = new_row(s, s.phi, column, l)
    noise = s.noise[l] if s.unknown[l] > 0 else s.r[l] * s.noise[l]
    s.at_start[Y, l], s.at_start[NOISE, l], s.at_start[OK, l], s.at_start[ENTERING, l] = s.y[l], noise, sign, column
    s.counters[COUNTER.phase, l] = ENTER_NEW if fresh else ENTER
    run(s, l)
    s.counters[COUNTER.phase, l] = LEARN
    for i in range(column, s.theta.shape[0]):
        s.x[i, l] = 0.0


@kernel
def correct_tree(s: State, l: int) -> None:
    """The tree takes the sample, unless a gate refused it; one that enters a coordinate changes no weight.

    A reading that repeats is known less surely to the tree, but was predicted as any other.
    """
    column, outside, more = s.column[l], s.s[l] == np.inf, repeated(s, l)
    s.sample[SAMPLE.noise, l], s.sample[SAMPLE.least, l] = s.noise[l] * more, least_noise(s, l)
    s.sample[SAMPLE.ok, l], s.sample[SAMPLE.observed, l] = s.ok[l] if column < 0 else 0.0, s.observed[l]
    run(s, l)
    if column >= 0 and s.ok[l] > 0.0:
        enter(s, column, l)
    if (column >= 0 or more > 1.0) and s.ok[l] > 0.0 and not outside:
        e, v = s.y[l] - s.y_hat[l], s.s[l]
        floats(report_at(s), s.table[REPORT_AT, 2, 0], s.theta.shape[1])[0, l] = -0.5 * (
            log(2.0 * np.pi * v) + e * e / v
        )
    learn_scales(s, l)


@kernel
def take_known(s: State, known: Array, t: int, l: int) -> None:
    """Read the priors of the joint events of this sample, a chain of the changes, and their drift factors."""
    row, column = t if known.shape[0] > 1 else 0, COMMON
    memory = floats(memory_at(s), s.table[MEMORY_AT, 2, 0], s.theta.shape[1])
    for field in (GIVEN, GIVEN_CHAIN, DRIFT):
        start = s.table[field, 0, l] // 8
        for k in range(s.table[field, 2, l]):
            memory[start + k, l] = known[row, column, l]
            column += 1


@kernel
def forecast(s: State, l: int) -> None:
    if s.counters[COUNTER.settled, l] > 0:
        forecast_tree(s, l)
    else:
        only_drift(s, l)
        forecast_on_roots(s, l)
        s.s[l] = s.scale[l] * (s.h[l] + s.r[l] * s.noise[l]) if s.h[l] < np.inf else np.inf


@kernel
def correct(s: State, l: int) -> None:
    if s.counters[COUNTER.settled, l] > 0:
        correct_tree(s, l)
    else:
        s.s[l] = s.h[l] + s.r[l] * s.noise[l]
        absorb_on_roots(s, l)
        alone(s, l)


@kernel
def read(s: State, l: int) -> None:
    """theta and its variance from the mixture."""
    if s.counters[COUNTER.settled, l] <= 0:
        spanned_variance(s, l)
    elif s.counters[COUNTER.framed, l] > 0:
        read_framed(s, l)
    else:
        diagonal(s, l)


STEPS = TrackerSteps(
    nothing, forecast, correct, read, nothing, store=keep, read_extra=take_known, machines=(*MACHINES, bank),
    outlined=True, note=resolve,
)  # fmt: skip


@cache
def steps_of(own: tuple[Callable[..., Any], ...]) -> TrackerSteps:
    """The steps, which also know where the user's ``own`` likelihoods are."""
    if not own:
        return STEPS
    entry, point_out = entry_of(own)
    return STEPS._replace(predict=point_out, machines=(*STEPS.machines, entry))
