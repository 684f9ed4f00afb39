"""ARX: autoregression with exogenous inputs, the standard model of on-line identification.

    y_t = sum_{i=1..na} a_i y_{t-i} + sum_{inputs} sum_{j=1..nb} b_j u_{t-nk-j+1} (+ c) + v_t
    phi_t = [y_{t-1} .. y_{t-na}, u1_{t-nk} .. u1_{t-nk-nb+1}, u2 ..., (1)],   theta_t = [a_1 .., b_1 .., (c)]

The signs of a are those of the regression; the field's polynomial A(z) = 1 + A_1 z^-1 + .. has the opposite signs
(`polynomials` converts).
With nk = 0 the present input is used. The model stores its own lags, so you never build a design matrix.

Missing outputs: the lag is filled with the model's own prediction, if that has a finite variance, for at most ``na``
outputs in a row. After that, samples cannot be used until real lags are available again, because an unstable estimate
would diverge. A missing input makes every sample that needs it unusable. A gap in time above 1.5 nominal intervals
makes the lags that reach across it missing.

Several outputs (``ny=2``) have a regression each, all on the same regressors:

    phi_t = [y1_{t-1} .. y1_{t-na}, y2_{t-1} .., u1_{t-nk} .., (1)],   yo_t = phi_t' theta_o,t + v_o,t

The outputs are lanes of one tile, so every tracker runs unchanged: of G series, lane o G + g is output o of series g.
Each lane keeps a copy of the lags of all outputs of its series, which ``push`` fills from ``y`` of the other lanes, or
from their predictions where y is missing.

Source: Ljung, System Identification (1999), eq. 4.7; the filling rule is ours. Cost per sample: O(na + nb), and
O(ny (ny na + nb)) for the lags of several outputs.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from driftfit.engine.drivers import ModelSteps, TrackerSteps
from driftfit.engine.kernel import Array, State, kernel
from driftfit.engine.settings import one_of, output_names, whole
from driftfit.models.base import GAP, Term
from driftfit.models.inputs import CountedInputs
from driftfit.models.lags import (
    doubted,
    no_doubts,
    refuse_lag,
    shift_doubts,
    shift_inputs,
    take_input,
    take_output,
    wait_for_lags,
)


@dataclass(frozen=True)
class ARX(CountedInputs):
    """ARX(na, nb, nk) with one output and any number of inputs.

    Parameters
    ----------
    na : int
        Lags of the output.
    nb, nk : int, or one per input
        Lags of each input, and its delay in samples (0 uses the present input).
    inputs : int, names, or None
        How many inputs, or their names. None: as many as ``nb`` or ``nk`` have entries, else as many as u has columns
        (`Live`: one).
    intercept : bool
        Add a constant as the last parameter.
    start : "drop" or "zero"
        "drop": nothing is used until the lags are filled. "zero": the unknown past is zero.
    ny : int or names
        Outputs, columns of y. With several, each has a separate regression on the lags of all of them and on the
        inputs.
    """

    na: int
    nb: int | tuple[int, ...] = 1
    nk: int | tuple[int, ...] = 1
    inputs: int | tuple[str, ...] | None = None
    intercept: bool = False
    start: str = "drop"
    ny: int | tuple[str, ...] = 1
    per_input = ("nb", "nk")
    constant = "intercept"

    def __post_init__(self) -> None:
        if not isinstance(self.ny, int):
            self._set("ny", output_names("ARX", self.ny))
        output_names("ARX", self.ny)
        self._set("na", whole("ARX", "na", self.na, 0))
        self._check_inputs()
        one_of("ARX", "start", self.start, ("drop", "zero"))
        if self.inputs is not None and self.n == 0:
            raise ValueError("ARX: there is nothing to estimate with na=0, nb=0 and no intercept.")

    @cached_property
    def outputs(self) -> tuple[str, ...]:
        return output_names("ARX", self.ny)

    @property
    def lags(self) -> tuple[tuple[int, int], ...]:
        """(nb, nk) of every input."""
        return tuple(zip(self.for_each_input("nb"), self.for_each_input("nk"), strict=True))

    @property
    def joint(self) -> bool:
        """Whether there are several outputs."""
        return len(self.outputs) > 1

    @cached_property
    def names(self) -> tuple[str, ...]:
        past = [
            f"a{i + 1}[<-{output}]" if self.joint else f"a{i + 1}" for output in self.outputs for i in range(self.na)
        ]
        given = [f"b{i + 1}{u}" for u, (nb, _) in zip(self.suffixes, self.lags, strict=True) for i in range(nb)]
        return (*past, *given, *(("intercept",) if self.intercept else ()))

    def names_of(self, output: str) -> tuple[str, ...]:
        inputs = [name.strip("[]") or "u" for name in self.suffixes]
        past = [f"a{i + 1}[{output}<-{name}]" for name in self.outputs for i in range(self.na)]
        given = [f"b{i + 1}[{output}<-{u}]" for u, (nb, _) in zip(inputs, self.lags, strict=True) for i in range(nb)]
        return (*past, *given, *((f"intercept[{output}]",) if self.intercept else ()))

    @property
    def dimensions(self) -> tuple[tuple[int, int | None], ...] | None:
        inputs = [(1, j) for j, (nb, _) in enumerate(self.lags) for _ in range(nb)]
        own = ((0, None),) * self.na + (*inputs, *([(1, None)] if self.intercept else []))
        return None if self.joint else own

    def memory(self) -> Mapping[str, Any]:
        unknown, ny = np.nan if self.start == "drop" else 0.0, len(self.outputs)
        return {
            "y_lag": np.full((ny, max(self.na, 1)), unknown),
            "u_lag": np.full((max(self.m, 1), 1 + max(self._oldest, 0)), unknown),
            "filled": np.zeros(ny),
            "started": 0.0 if self.start == "drop" else 1.0,
        }

    @property
    def _oldest(self) -> int:
        """How many samples ago the oldest input was read that is remembered."""
        return max((nb + nk for nb, nk in self.lags), default=1) - 1

    @property
    def steps(self) -> ModelSteps:
        return _steps(self.na, self.lags, self.intercept, len(self.outputs), self._oldest)

    def fitted_to(self, tracker: TrackerSteps) -> tuple[Mapping[str, Any], ModelSteps]:
        if not (tracker.doubts and self.na > 0):
            return self.memory(), self.steps
        ny = len(self.outputs)
        doubting = _steps(self.na, self.lags, self.intercept, ny, self._oldest, True)
        return {**self.memory(), **no_doubts(ny, self.na)}, doubting

    @property
    def terms(self) -> tuple[Term, ...]:
        past: list[Term] = [("y", o, i + 1) for o in range(len(self.outputs)) for i in range(self.na)]
        given: list[Term] = [("u", j, nk + i) for j, (nb, nk) in enumerate(self.lags) for i in range(nb)]
        return (*past, *given, *([("1", 0, 0)] if self.intercept else []))

    def play(self, theta: Array, y: Array, u: Array, noise: Array, span: tuple[Any, Any]) -> Array:
        if self.joint:
            raise ValueError("simulate: the outputs of a joint ARX feed each other; one alone cannot be run forward.")
        p, h = y.shape[1], noise.shape[1]
        out = np.concatenate([y, np.zeros((len(theta), h))], axis=1)
        for k in range(h):
            t, at = p + k, self.na
            total = noise[:, k] + (theta[:, -1] if self.intercept else 0.0)
            for i in range(self.na):
                total = total + theta[:, i] * out[:, t - 1 - i]
            for j, (nb, nk) in enumerate(self.lags):
                for i in range(nb):
                    total = total + theta[:, at + i] * u[:, t - nk - i, j]
                at += nb
            out[:, t] = total
        return out[:, p:]

    def noise_response(self, theta: Array, h: int) -> Array:
        """Response of 1 / A(z) to an impulse, (h,)."""
        A, _ = self.polynomials(theta)
        from scipy import signal  # this import takes a third of a second, and only forecasts need it

        return np.asarray(signal.lfilter([1.0], A, np.eye(1, h)[0]))

    def polynomials(self, theta: Array) -> tuple[Array, list[Array]]:
        """A(z) = [1, A_1, ..], A_i = -a_i, and, per input, B(z) = [0 (nk times), b_1, ..], in powers of z^-1.

        ``theta`` is (n,) or (..., n); the polynomials have their coefficients on the last axis.
        """
        if self.joint:
            raise ValueError("polynomials: A(z) of several outputs is a matrix; take it from run.theta by run.names.")
        theta = np.asarray(theta, dtype=float)
        one = np.ones((*theta.shape[:-1], 1))
        A = np.concatenate([one, -theta[..., : self.na]], axis=-1)
        B, at = [], self.na
        for nb, nk in self.lags:
            delay = np.zeros((*theta.shape[:-1], nk))
            B.append(np.concatenate([delay, theta[..., at : at + nb]], axis=-1))
            at += nb
        return A, B

    def transfers(self, theta: Array) -> tuple[Array, list[tuple[Array, Array]]]:
        if self.joint:
            return super().transfers(theta)
        A, B = self.polynomials(theta)
        return A, [(b, A) for b in B]


@lru_cache
def _steps(
    na: int, lags: tuple[tuple[int, int], ...], intercept: bool, ny: int, oldest: int, doubts: bool = False
) -> ModelSteps:
    """The steps for one set of orders, which are constants, so that every loop is unrolled."""
    m = len(lags)
    # without inputs the loops over them never run, but Numba cannot type an empty tuple
    nb = tuple(b for b, _ in lags) or (0,)
    nk = tuple(k for _, k in lags) or (0,)
    at = tuple(int(ny * na + sum(nb[:j])) for j in range(max(m, 1)))
    n = ny * na + sum(nb)

    @kernel
    def regress(s: State, l: int) -> None:
        broken = s.dt[l] > GAP
        for o in range(ny):
            for i in range(na):
                lag = s.y_lag[o, i, l]
                lag = np.nan if broken else lag
                s.y_lag[o, i, l] = lag
                s.phi[o * na + i, l] = doubted(s, o, i, l, lag) if doubts else lag
        shift_inputs(s, m, l)
        for j in range(m):
            for i in range(nb[j]):
                s.phi[at[j] + i, l] = s.u_lag[j, nk[j] + i, l]
        if intercept:
            s.phi[n, l] = 1.0
        wait_for_lags(s, l)

    @kernel
    def push(s: State, l: int) -> None:
        series = s.y.shape[0] // ny
        first = l if ny == 1 else l % series
        for o in range(ny):
            lane = first + o * series  # of output o of the same series
            if doubts:
                shift_doubts(s, o, l, lane, first, series, ny, na)
            for i in range(na - 1, 0, -1):
                s.y_lag[o, i, l] = s.y_lag[o, i - 1, l]
            take_output(s, na, o, lane, l)

    late = all(delay > 0 for _, delay in lags)
    return ModelSteps(regress, push, apply=take_input if late else None, ages=oldest, refuse=refuse_lag)


def arx_text(model: ARX) -> str:
    """An ARX model with an intercept as `driftfit.parsing.settings.parse_model` reads it."""
    nb, nk = ("/".join(str(one[i]) for one in model.lags) for i in (0, 1))
    return f"arx:{model.na},{nb or 0}{nk and f',nk={nk}'},intercept"
