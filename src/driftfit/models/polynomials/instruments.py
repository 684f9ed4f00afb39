"""Refined instrumental variables for transfer functions: regressors that are linear in theta, and their instruments.

With xi_j = y - c - sum_(k != j) w_k, the response to input j with the noise, and L_j = D / (C F_j) at the point theta',

    e = L_j (F_j xi_j - B_j u_j)  =  xi'_j,t - sum_i f_i xi'_j,t-i - sum_i b_i u'_j,t-nk-i+1,    xi'_j = L_j xi_j, ..

is linear in b_j and f_j: no linearisation. At theta' it is the prediction error, which is computed as such, because the
sum above is not it while the filters change. Its regressors contain noise, so the instruments have the response w_j
without noise in the place of xi_j,

    phi   = [u'_j lags, 1/C e lags, 1/C v lags, xi'_j lags, D/C 1]
    zeta  = [u'_j lags, 1/C e lags, 1/C v lags, w'_j  lags, D/C 1]        w'_j = L_j w_j

zeta is the gradient of the prediction (`driftfit.models.polynomial`), so that at the true parameters the estimate is
efficient. If the model of the noise is wrong, B and F are still consistent: w depends on the inputs alone.

B and F of theta' follow theta with the share `FOLLOWING` of the distance at each sample, C and D at once; or theta' is
held (``point``), which is one iteration of the method for a whole record. Before the filters are known, the first
samples are an ARX regression; C and D enter after 10 n samples, and until then the instruments are the regressors.

Source: Young, Recursive Estimation and Time-Series Analysis (2011), chapter 7: RIV, and SRIV without C and D; Young and
Jakeman, Int. J. Control 29 (1979). Departures: noise and plant are estimated by one recursion, where the source has one
for each, which are independent asymptotically; filters that grow in the course of time; the late C and D.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from driftfit.engine.drivers import ModelSteps
from driftfit.engine.kernel import State, kernel
from driftfit.models.polynomials.steps import (
    EACH,
    OWN,
    SETTLING,
    Places,
    V,
    W,
    filtered,
    filters,
    gradient_of,
    pushing,
    regressing,
    staying,
)

XI, XI_C, XI_F, MORE = range(4)
"""Rows for every input, behind all others: xi_j, D/C of it, and D/(C F_j) of it."""

FOLLOWING = 0.05
"""Share of the distance to theta that B and F of the point move at a sample."""

WAITING = 10.0
"""Samples for each parameter before C and D enter. Until then the errors of B and F are larger than the noise; a noise
model that learns from them has zeros of C at the unit circle, where the gradient is huge and its bands are too narrow.
"""


@kernel
def at_followed(s: State, l: int) -> None:
    """The point of the filters is behind theta."""
    for i in range(s.theta.shape[0]):
        s.point[i, l] = s.followed[i, l]


@lru_cache
def _regressors(p: Places) -> Any:
    """``regressors(s, y_hat, l)``: s.phi and s.zeta; returns the prediction at the point."""
    m, n, nf, at_f, rows = p.m, p.n, p.nf, p.at_f, OWN + EACH * p.m
    gradient = gradient_of(p)

    @kernel
    def regressors(s: State, y_hat: float, l: int) -> float:
        settled = s.usable[l] >= SETTLING * n
        gradient(s, l)
        for i in range(n):
            s.zeta[i, l] = s.phi[i, l] if abs(s.phi[i, l]) < np.inf else 0.0
        for j in range(m):
            for i in range(nf[j]):
                lag = s.signals[rows + MORE * j + XI_F, i + 1, l]
                s.phi[at_f[j] + i, l] = lag if settled else s.phi[at_f[j] + i, l]
        return y_hat

    return regressors


@lru_cache
def instrumental_steps(p: Places, held: bool) -> ModelSteps:
    """The compiled steps for a tracker with instruments, s.zeta."""
    m, n, nf, at_c, at_f, rows = p.m, p.n, p.nf, p.at_c, p.at_f, OWN + EACH * p.m
    colour, _ = filters(p)
    place = staying if held else at_followed
    push_signals = pushing(p, place, WAITING)

    @kernel
    def push(s: State, l: int) -> None:
        share = FOLLOWING if s.usable[l] >= SETTLING * n else 1.0
        for i in range(n):
            of_noise = (i >= at_c) & (i < at_f[0])
            s.followed[i, l] += (1.0 if of_noise else share) * (s.theta[i, l] - s.followed[i, l])
        push_signals(s, l)
        for j in range(m):
            own = rows + MORE * j
            s.signals[own + XI, 0, l] = s.signals[OWN + EACH * j + W, 0, l] + s.signals[V, 0, l]
            raw = s.signals[own + XI, 0, l]
            s.signals[own + XI_C, 0, l] = filtered(s, colour(s, own + XI, own + XI_C, 0.0, l), raw, 0, l)
            x = s.signals[own + XI_C, 0, l]
            for i in range(nf[j]):
                x += s.damped[at_f[j] + i, l] * s.signals[own + XI_F, i + 1, l]
            s.signals[own + XI_F, 0, l] = filtered(s, x, raw, 0, l)

    return ModelSteps(regressing(p, place, _regressors(p), WAITING), push)
