"""A self-test of an exported tracker: recorded samples and the bits that they must give."""

from __future__ import annotations

from typing import Any

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.models.base import Model
from driftfit.readings.gate import Gate
from driftfit.streams import Live
from driftfit.trackers.base import Tracker

SAMPLES = 200

PROGRAM = """\
/* Runs the tracker over recorded samples and compares every result with what driftfit gives. Exit status 0: all agree,
   in double precision bit for bit, in single precision within {bound} of the largest usual result, or of the result
   itself if that is larger: a prediction before the first samples determine theta may be. */
#include "tracker.h"

#include <math.h>
#include <stdio.h>

#define SAMPLES {T}

static const double Y[SAMPLES] = {{{y}}};
static const double U[SAMPLES * {m}] = {{{u}}};
/* y_hat, e, variance, ok of every sample; then theta */
static const double STEPS[SAMPLES * 4] = {{{steps}}};
static const double THETA[TRACKER_PARAMETERS] = {{{theta}}};

static double worst = 0.0;
static int wrong = 0;

static void compare(double found, double expected, double scale) {{
    int same = found == expected || (found != found && expected != expected);
    double away = same ? 0.0 : fabs(found - expected) / fmax(scale, fabs(expected));
    if (!(away <= worst)) worst = away;
    if (sizeof(tracker_real) == sizeof(double) ? !same : !(away <= {bound})) wrong++;
}}

int main(void) {{
    tracker_state state;
    tracker_init(&state);
    for (int t = 0; t < SAMPLES; t++) {{
        tracker_real u[{m}];
        for (int j = 0; j < {m}; j++) u[j] = (tracker_real)U[t * {m} + j];
        tracker_step step = tracker_update(&state, (tracker_real)Y[t], u);
        compare((double)step.y_hat, STEPS[t * 4], {y_scale});
        compare((double)step.e, STEPS[t * 4 + 1], {y_scale});
        compare((double)step.variance, STEPS[t * 4 + 2], {s_scale});
        if (step.ok != (int)STEPS[t * 4 + 3]) wrong++;
    }}
    for (int i = 0; i < TRACKER_PARAMETERS; i++) compare((double){last}, THETA[i], {theta_scale});
    printf("%s: %d of %d results differ, the largest difference is %.3g of the largest result\\n",
           wrong ? "FAILED" : "passed", wrong, SAMPLES * 4 + TRACKER_PARAMETERS, worst);
    return wrong ? 1 : 0;
}}
"""

BOUND = 0.001
"""Largest error of single precision, as a share of the largest usual result or of the result itself."""


def record(model: Model, T: int = SAMPLES, seed: int = 0, codes: bool = False) -> tuple[Array, Array]:
    """y (T,), u (T, m): a stable system whose gain doubles, with missing data, an outage and constant inputs, and with
    fault codes, some of them among the first samples.
    """
    rng = np.random.default_rng(seed)
    m = max(model.m, 1)
    u = rng.standard_normal((T, m))
    u[T // 2 : T // 2 + T // 8] = 0.0
    y = np.zeros(T)
    for t in range(2, T):
        gain = 1.0 if t < T // 3 else 2.0
        y[t] = 0.6 * y[t - 1] - 0.1 * y[t - 2] + gain * u[t - 1].sum() + 0.1 * rng.standard_normal()
    y[rng.random(T) < 0.03] = np.nan
    y[3 * T // 4 : 3 * T // 4 + 5] = np.inf
    u[rng.random((T, m)) < 0.01] = np.nan
    if codes:
        y[[5, T // 4, T // 4 + 1, T // 2 + 40]], u[[8, T // 3 + 20], 0] = 9999.0, -999.0
    return y, u


def selftest(model: Model, tracker: Tracker, gate: Gate | None) -> str:
    """The text of the test program."""
    y, u = record(model, codes=gate is not None)
    live = Live(model, tracker, gate=gate or False)
    steps = np.array([live.update(float(y[t]), u[t, : model.m]) for t in range(SAMPLES)], dtype=float)
    scales = [
        max(float(np.max(np.abs(_finite(part)), initial=0.0)), 1e-30)
        for part in (record(model)[0], steps[:, 2], live.theta)
    ]  # without codes; fmt: skip
    last = "state.theta[i]" if len(live.theta) > 1 else "state.theta"
    return PROGRAM.format(
        T=SAMPLES, m=max(model.m, 1), bound=BOUND, y=_listed(y), u=_listed(u), steps=_listed(steps), last=last,
        theta=_listed(live.theta), y_scale=repr(scales[0]), s_scale=repr(scales[1]), theta_scale=repr(scales[2]),
    )  # fmt: skip


def _finite(values: Array) -> Array:
    kept: Array = values[np.isfinite(values)]
    return kept


def _listed(values: Any) -> str:
    return ", ".join(_number(one) for one in np.ravel(values).tolist())


def _number(x: float) -> str:
    if np.isnan(x):
        return "NAN"
    return repr(x) if np.isfinite(x) else "INFINITY" if x > 0 else "-INFINITY"
