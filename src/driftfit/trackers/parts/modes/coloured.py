"""Coloured noise: the previous innovation as one more regressor, where innovations are correlated.

    y_t = phi_t' theta + v_t + c v_(t-1)
        = c y*_(t-1) + (phi_t - c phi*_(t-1))' theta + v_t
        with y*_t = y_t - c y*_(t-1),  phi*_t = phi_t - c phi*_(t-1)

because v_(t-1) = y*_(t-1) - phi*_(t-1)' theta, for a theta that hardly moves from one sample to the next. The filters
therefore take phi* as regressor and c y*_(t-1) as known: theta is not biased by a lag of y that contains v_(t-1), and
no parameter is added. c is estimated by weighted least squares on the derivative psi of the prediction,

    psi_t = v_(t-1) - c psi_(t-1),    w = r / s
    A <- f A + w psi^2 / s,    b <- f b + w psi (e + c psi) / s,    V <- f V + w^2 psi^2 / s

and used as c (1 - SHRUNK V / b^2), c = b / A, where that is positive: innovations that are white leave everything as it
is. After a jump of theta, innovations are alike because the filters have not followed it yet, and are no evidence of
colour. Two things tell: w, the share of the innovation's variance that is noise, is small then, and before the filters
notice, innovations are large: in these sums e and psi are bounded by BOUND s^(1/2). A sample that is missing or an
outlier is no past.

Source: recursive maximum likelihood is Soderstrom's (1973), see Ljung and Soderstrom, Theory and Practice of Recursive
Identification (1983), section 3.7; bounds on both factors are those of generalized M-estimates, Denby and Martin
(1979); the weights and the shrinkage are ours. Cost per sample: O(n).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from driftfit.engine.kernel import Array, State, kernel

FADE = 0.995
"""Factor of the sums A, b and V at every sample."""
SHRUNK = 5.0
"""Square of the estimate in standard deviations below which innovations count as white. Less shrinkage of larger
estimates, an exponent of the bracket that grows with V, makes errors of ARMAX plants 2 to 3 per cent smaller and the
one-step errors of a river's flow 2 to 4 per cent larger.
"""
BOUND = 2.0
"""Bound of innovations and derivatives in the sums, in standard deviations of the innovation."""
MOST = 0.95
"""Largest size of c: the past is forgotten at this rate at least."""
GAP = 1.5
"""Intervals longer than this, in nominal ones, separate a sample from its past."""


def white(n: int) -> dict[str, Any]:
    """Fields before the first sample."""
    return {
        "white": np.zeros(n),
        "past": np.zeros(n),
        "past_y": 0.0,
        "explained": 0.0,
        "colour": 0.0,
        "colour_used": 0.0,
        "psi": 0.0,
        "colour_scores": np.zeros(3),
    }


@kernel
def whiten_noise(s: State, l: int) -> None:
    """The regressor phi* and the known part of y."""
    c = s.colour[l] if s.dt[l] <= GAP else 0.0
    s.colour_used[l] = c
    s.explained[l] = c * s.past_y[l]
    for i in range(s.theta.shape[0]):
        s.white[i, l] = s.phi[i, l] - c * s.past[i, l]


@kernel
def learn_colour(s: State, l: int) -> None:
    """Update c, and store the past of the next sample; s.theta is still the prediction."""
    c, v = s.colour_used[l], s.past_y[l]
    ordinary = s.weighed[l] * (1.0 - s.outlier[l])
    for i in range(s.theta.shape[0]):
        v -= s.past[i, l] * s.theta[i, l]
        s.past[i, l] = ordinary * s.white[i, l]
    s.past_y[l] = ordinary * (s.y[l] - s.explained[l])
    psi = (v - c * s.psi[l]) if s.dt[l] <= GAP else 0.0
    noise = s.noise[l] * s.leverage[l] * s.r[l]
    share = ordinary * min(1.0, noise / s.s[l]) if s.weighed[l] > 0 else 0.0
    weight = share / s.s[l] if share > 0.0 else 0.0
    bound = BOUND * np.sqrt(s.s[l]) if share > 0.0 else 0.0
    slope, e = max(-bound, min(bound, psi)), max(-bound, min(bound, s.e[l])) if share > 0.0 else 0.0
    A = FADE * s.colour_scores[0, l] + weight * slope * slope
    b = FADE * s.colour_scores[1, l] + weight * slope * (e + c * slope)
    V = FADE * s.colour_scores[2, l] + weight * share * slope * slope
    s.colour_scores[0, l], s.colour_scores[1, l], s.colour_scores[2, l] = A, b, V
    s.psi[l] = ordinary * psi
    square = b * b / V if V > 0.0 else 0.0
    known = b / A * (1.0 - SHRUNK / square) if square > SHRUNK else 0.0
    s.colour[l] = max(-MOST, min(MOST, known))


def colour(lane: Mapping[str, Array]) -> tuple[tuple[str, str], ...]:
    """The line of the summary about coloured noise; none where innovations are white."""
    c = float(lane["colour"])
    return (("Coloured noise", f"v + {c:.2g} v of the sample before; the previous innovation is used"),) if c else ()
