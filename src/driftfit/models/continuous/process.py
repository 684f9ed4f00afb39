"""Process models in continuous time: gain, time constants and delay, from samples at any times.

    P1   T y' + y = K u(t - delay)                          first order
    P2   T1 T2 y'' + (T1 + T2) y' + y = K u(t - delay)      two lags in series
    P2U  y'' + 2 zeta wn y' + wn^2 y = K wn^2 u(t - delay)   underdamped, zeta < 1
    PI   y' = K u(t - delay)                                integrator

    y(t) = .. + offset + v_t

`process_model` writes the exact solution between samples, with inputs that are held, as a `StateSpace`: with z the
response to u at gain 1 and h the interval since the last sample,

    P1   z <- u + (z - u) exp(-h / T)
    P2   z1 <- u + (z1 - u) e1;  z2 <- u + (z2 - u) e2 + (z1 - u) T1 / (T1 - T2) (e1 - e2),   ei = exp(-h / Ti)
    P2U  the same with a decaying rotation of angle wn sqrt(1 - zeta^2) h

so that uneven and jittered times are exact, and parameters have physical units: with ``time=`` in seconds and dt = 1, T
is in seconds. u of the last sample holds up to the present one. What must be positive is followed as its logarithm,
log_T, log_T1, log_T2, log_wn, and zeta as logit_zeta = log(zeta / (1 - zeta)): no step of a filter makes the model
unstable, and std is the relative error. exp(theta) has the band from exp(low) to exp(high).

The delay is ``delay`` whole samples; with ``fraction=True`` (P1, even times) the rest of it, between 0 and 1 nominal
intervals, is a parameter.

Source: Astrom and Hagglund, Advanced PID Control (2006), chapter 2. The alternative are refined instrumental variables:
Garnier and Wang (eds.), Identification of Continuous-time Models from Sampled Data (2008).
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping

from driftfit.engine.settings import numbers, one_of, whole
from driftfit.models.state_space import StateSpace

KINDS = {
    "P1": ["z = u + (z[-1] - u) * exp(-dt / T)"],
    "P1D": ["z = old + (z[-1] - old) * exp(-dt / T) + (u - old) * (1 - exp(-(dt - theta.rest) / T))"],
    "P2": [
        "z1 = u + (z1[-1] - u) * exp(-dt / T1)",
        "z = u + (z[-1] - u) * exp(-dt / T2) + (z1[-1] - u) * (apart if abs(T1 - T2) > 0.0001 * T1 else equal)",
    ],
    "P2U": [
        "w = fall * (cosine * w[-1] - sine * (zeta * w[-1] + wn * (z[-1] - u)) / root)",
        "z = u + fall * (cosine * (z[-1] - u) + sine * (zeta * (z[-1] - u) + w[-1] / wn) / root)",
    ],
    "PI": ["z = z[-1] + dt * u"],
}
"""The lines of the states; u is the input that holds since the last sample, old the one before it."""

PARTS = {
    "apart": "T1 / (T1 - T2) * (exp(-dt / T1) - exp(-dt / T2))", "equal": "dt / T1 * exp(-dt / T1)",
    "fall": "exp(-zeta * wn * dt)", "cosine": "cos(wn * root * dt)", "sine": "sin(wn * root * dt)",
    "root": "sqrt(1 - zeta ** 2)", "T": "exp(theta.log_T)", "T1": "exp(theta.log_T1)", "T2": "exp(theta.log_T2)",
    "wn": "exp(theta.log_wn)", "zeta": "1 / (1 + exp(-theta.logit_zeta))",
}  # fmt: skip
"""Expressions for words in the lines, in the order in which they are put there."""

STARTS = {"T": 10.0, "T1": 10.0, "T2": 5.0, "zeta": 0.5, "wn": 0.3, "K": 1.0, "rest": 0.5, "offset": 0.0}
LOGARITHMS = {"T": "log_T", "T1": "log_T1", "T2": "log_T2", "wn": "log_wn"}


def process_model(
    kind: str = "P1", delay: int = 0, *, fraction: bool = False, offset: bool = True,
    start: Mapping[str, float] | None = None, input: str = "u", output: str = "y",
) -> StateSpace:  # fmt: skip
    """A process model as a `StateSpace`, to be followed with `JointKalman`.

    Parameters
    ----------
    kind : "P1", "P2", "P2U" or "PI"
        See `driftfit.models.continuous.process`; parameters are K and log_T, or log_T1, log_T2, or log_wn, logit_zeta.
    delay : int
        Whole nominal samples between input and response, beyond the hold.
    fraction : bool
        Estimate the rest of the delay, ``rest``, between 0 and 1 nominal intervals; for "P1" at even times.
    offset : bool
        Add a constant to the output.
    start : mapping from K, T, T1, T2, wn, zeta, rest, offset to number
        Where the estimation starts: the mean of the prior, in physical units. The order of magnitude of time constants
        is needed.
    input, output : str
        Names of the signals.

    Raises
    ------
    ValueError
        For another kind, a negative delay, a start that names no parameter, or ``fraction`` for another kind than "P1".
    """
    one_of("process_model", "kind", kind, ("P1", "P2", "P2U", "PI"))
    whole("process_model", "delay", delay, 0)
    if fraction and kind != "P1":
        raise ValueError(f'process_model: fraction=True is for "P1"; got {kind!r}. Compare whole delays by run.loglik.')
    lines = KINDS["P1D" if fraction else kind]
    text = "\n".join([*lines, "output = theta.K * z" + (" + theta.offset" if offset else "")])
    for word, part in PARTS.items():
        text = re.sub(rf"(?<![\w.]){word}(?!\w)", f"({part})", text)
    places = {"u": f"{input}[-{delay + 1}]", "old": f"{input}[-{delay + 2}]", "output": output}
    text = re.sub(r"(?<![\w.])(u|old|output)(?!\w)", lambda found: places[found[0]], text)
    parameters = StateSpace(text).system.parameters
    found = {}
    for name, value in (STARTS | dict(start or {})).items():
        number = numbers("process_model", "start", value, ndim=0)
        if name in LOGARITHMS or name == "zeta":
            if not 0.0 < number < (1.0 if name == "zeta" else math.inf):
                raise ValueError(f"process_model: {name} must be positive, and zeta below 1; got {value!r}.")
            number = math.log(number / (1.0 - number) if name == "zeta" else number)
        found[LOGARITHMS.get(name, "logit_zeta" if name == "zeta" else name)] = number
    if unknown := sorted(set(start or {}) - set(STARTS)):
        raise ValueError(f"process_model: start names {', '.join(unknown)}; there are {', '.join(STARTS)}.")
    return StateSpace(text, start={name: value for name, value in found.items() if name in parameters})
