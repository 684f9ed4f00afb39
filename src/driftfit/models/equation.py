"""An equation of your own: y_t = f(inputs, lags; theta_t) + v_t, written as text, with exact derivatives.

    Equation("flow = theta.k * sqrt(p1 - p2) - theta.c")
    Equation("y = theta.a * y[-1] + theta.b * u[-1] / (1 + theta.s * u[-1] ** 2)", start={"s": 0.5})

The name on the left is the output. ``theta.NAME`` is a parameter, ``NAME[-2]`` a signal two samples ago, every other
name an input. Allowed are + - * / **, numbers, pi, comparisons, ``A if CONDITION else B``, and the functions abs, cos,
exp, log, max, min, sin, sqrt, tanh. Nothing else of the text is evaluated.

Every tracker of linear regressions follows theta by the linearisation of f at a point theta',

    phi_t = d f / d theta (theta'),     y_t - f(theta') + phi_t' theta' = phi_t' theta_t + v_t

so that `Kalman` is the extended Kalman filter for drifting parameters, and `RLS` recursive Gauss-Newton. An equation
that is linear in theta is exactly the `Regression` on its terms. Derivatives are computed by forward differentiation
of the text (dual numbers), together with f and in the same compiled code.

theta' begins at ``start``, and goes to the estimate in the course of the first 10 n usable samples: a parameter that
enters nonlinearly needs a start from which linear steps lead to it. Where f or a derivative is not finite at theta'
(the root of a negative number), or f is out of all proportion to the readings so far, the sample is linearised at
``start`` instead; where it is not finite there either, it is not used.

A missing output is replaced by its prediction among the lags, for at most as many samples as the longest lag; samples
that need a missing input are not used. A gap in time breaks the lags as in `ARX`.

Source: Ljung and Soderstrom, Theory and Practice of Recursive Identification (1983), section 3.6; Griewank and Walther,
Evaluating Derivatives (2008), chapter 3. Cost per sample: that of f and its derivatives, O(n) for each operation at
most.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from types import SimpleNamespace
from typing import Any

import numpy as np

from driftfit.engine.drivers import LARGEST, ModelSteps
from driftfit.engine.kernel import Array, State, kernel
from driftfit.models.base import GAP
from driftfit.models.formula import Formula, compiled, complete_with, in_numpy, parse, start_values
from driftfit.models.inputs import NamedInputs
from driftfit.models.lags import informed, refuse_lag, shift_inputs
from driftfit.models.linearised import MEMORY, along, restore, subtract

SETTLING = 10.0
"""Usable samples for each parameter in which the point of linearisation goes from the start to the estimate."""


@dataclass(frozen=True)
class Equation(NamedInputs):
    """y = f(inputs, lags; theta), given as text; see `driftfit.models.equation`.

    Parameters
    ----------
    equation : str
        Such as ``"y = theta.k * sqrt(p1 - p2) - theta.c"``.
    start : mapping from parameter to number, or a number for all
        Where the linearisation begins; 1 for those that are not named. It is no prior: give that to the tracker, as
        ``theta0`` and ``p0``.
    inputs : names or None
        Columns of u, in order; None: the inputs of the equation, in the order in which they appear.

    Raises
    ------
    ValueError
        If the text is not such an equation, ``start`` names what is no parameter, or inputs are missing.
    """

    equation: str
    start: Any = 1.0
    inputs: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        formula = parse(self.equation)
        self._check_inputs(formula.inputs)
        self._set("start", start_values("Equation", self.start, formula.parameters))

    @property
    def formula(self) -> Formula:
        return parse(self.equation)

    @property
    def names(self) -> tuple[str, ...]:
        return self.formula.parameters

    @property
    def outputs(self) -> tuple[str, ...]:
        return (self.formula.output,)

    @property
    def reach(self) -> int:
        return self.formula.reach

    @property
    def remembers_outputs(self) -> bool:
        return bool(self.formula.lags_of(self.formula.output))

    @property
    def output_lags(self) -> int | None:
        return None if self.remembers_outputs else 0

    def memory(self) -> Mapping[str, Any]:
        depth = self.reach + 1
        return {
            "y_lag": np.full((1, depth), np.nan), "u_lag": np.full((max(self.m, 1), depth), np.nan),
            "point": self.begins, "first_point": self.begins, "value": 0.0, **MEMORY,
        }  # fmt: skip

    @property
    def steps(self) -> ModelSteps:
        return _steps(self.equation, self.input_names)

    def play(self, theta: Array, y: Array, u: Array, noise: Array, span: tuple[Any, Any]) -> Array:
        p, h, value = y.shape[1], noise.shape[1], in_numpy(self.equation, self.input_names)
        out, s = np.concatenate([y, np.zeros((len(theta), h))], axis=1), SimpleNamespace(point=theta.T)
        for k in range(h):
            recent = slice(p + k - self.reach, p + k + 1)
            s.y_lag, s.u_lag = out.T[None, recent][:, ::-1], u.T[:, recent][:, ::-1]
            with np.errstate(all="ignore"):
                out[:, p + k] = value(s, slice(None)) + noise[:, k]
        return out[:, p:]


@kernel
def known_lag(s: State, j: int, lag: int, l: int) -> bool:
    """Whether input j was known that many samples ago."""
    return abs(s.u_lag[j, lag, l]) < LARGEST  # type: ignore[no-any-return]


@lru_cache
def _steps(equation: str, inputs: tuple[str, ...]) -> ModelSteps:
    formula = parse(equation)
    m, n, reach = len(inputs), len(formula.parameters), formula.reach
    evaluate = compiled(equation, inputs)
    complete = complete_with(known_lag, [formula], inputs, formula.output)

    @kernel
    def age(s: State, l: int) -> None:
        broken = s.dt[l] > GAP
        for i in range(reach, 0, -1):
            s.y_lag[0, i, l] = np.nan if broken else s.y_lag[0, i - 1, l]
        shift_inputs(s, m, l)

    @kernel
    def finite(s: State, l: int) -> bool:
        good = abs(s.value[l]) < LARGEST
        for i in range(n):
            good = good & (abs(s.phi[i, l]) < LARGEST)
        return good  # type: ignore[no-any-return]

    @kernel
    def regress(s: State, l: int) -> None:
        age(s, l)
        evaluate(s, l)
        known = complete(s, l)
        if known and not finite(s, l):
            for i in range(n):
                s.point[i, l] = s.first_point[i, l]
            evaluate(s, l)
        good = known and finite(s, l)
        shift = s.value[l] - along(s, l) if good else 0.0
        if not good:
            s.phi[0, l] = np.nan
        subtract(s, shift, good, l)

    @kernel
    def push(s: State, l: int) -> None:
        observed = s.observed[l] > 0.0
        predicted = informed(s, l)
        known = predicted & (s.without[l] < reach)
        restore(s, observed, l)
        s.y_lag[0, 0, l] = s.measured[l] if observed else (s.y_hat[l] if known else np.nan)
        share = min(1.0, s.usable[l] / (SETTLING * n)) if predicted & (s.ok[l] > 0.0) else 0.0
        share = share if (s.moved_on[l] > 0.0) | (s.usable[l] >= SETTLING * n) else 0.0
        for i in range(n):
            moved = s.point[i, l] + share * (s.theta[i, l] - s.point[i, l])
            s.point[i, l] = moved if abs(moved) < LARGEST else s.first_point[i, l]

    return ModelSteps(regress, push, ages=reach, refuse=refuse_lag)
