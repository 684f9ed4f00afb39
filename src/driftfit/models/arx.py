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

Several outputs (``ny=2``) have a regression each, all on the same regressors, and are bound as `JointARX`:

    phi_t = [y1_{t-1} .. y1_{t-na}, y2_{t-1} .., u1_{t-nk} .., (1)],   yo_t = phi_t' theta_o,t + v_o,t

The outputs are lanes of one tile, so every tracker runs unchanged: of G series, lane o G + g is output o of series g.
Each lane keeps a copy of the lags of all outputs of its series, which ``push`` fills from ``y`` of the other lanes, or
from their predictions where y is missing.

Source: Ljung, System Identification (1999), eq. 4.7; the filling rule is ours. Cost per sample: O(na + nb), and
O(ny (ny na + nb)) for the lags of several outputs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from driftfit.engine.drivers import ModelSteps, TrackerSteps
from driftfit.engine.kernel import Array, State, Step, kernel
from driftfit.engine.settings import one_of, output_names, whole
from driftfit.models.base import GAP, Term, refuse_lag
from driftfit.models.inputs import CountedInputs
from driftfit.models.lags import doubted, no_doubts, shift_doubts, shift_inputs, take_output, wait_for_lags


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
        Outputs, columns of y. With several, each has a separate regression on the lags of all of them and on the inputs
        (`JointARX`).
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

    def bind(self, inputs: int | Sequence[str]) -> ARX:
        bound = super().bind(inputs)
        return bound if len(self.outputs) == 1 else JointARX.from_settings(bound.settings())

    @cached_property
    def outputs(self) -> tuple[str, ...]:
        return output_names("ARX", self.ny)

    @property
    def lags(self) -> tuple[tuple[int, int], ...]:
        """(nb, nk) of every input."""
        return tuple(zip(self.for_each_input("nb"), self.for_each_input("nk"), strict=True))

    @cached_property
    def names(self) -> tuple[str, ...]:
        return (*(f"a{i + 1}" for i in range(self.na)), *self._names_after_lags())

    def _names_after_lags(self) -> tuple[str, ...]:
        names = [f"b{i + 1}{u}" for u, (nb, _) in zip(self.suffixes, self.lags, strict=True) for i in range(nb)]
        return (*names, "intercept") if self.intercept else tuple(names)

    @property
    def dimensions(self) -> tuple[tuple[int, int | None], ...]:
        inputs = [(1, j) for j, (nb, _) in enumerate(self.lags) for _ in range(nb)]
        return ((0, None),) * self.na + (*inputs, *([(1, None)] if self.intercept else []))

    def memory(self) -> Mapping[str, Any]:
        unknown = np.nan if self.start == "drop" else 0.0
        depth = max((nb + nk for nb, nk in self.lags), default=1)
        return {
            "y_lag": np.full(max(self.na, 1), unknown),
            "u_lag": np.full((max(self.m, 1), max(depth, 1)), unknown),
            "filled": 0.0,
            "started": 0.0 if self.start == "drop" else 1.0,
        }

    @property
    def steps(self) -> ModelSteps:
        return _steps(self.na, self.lags, self.intercept)

    def memory_for(self, tracker: TrackerSteps) -> Mapping[str, Any]:
        if not (tracker.doubts and self.na > 0):
            return self.memory()
        return {**self.memory(), **no_doubts(len(self.outputs), self.na)}

    def steps_for(self, tracker: TrackerSteps) -> ModelSteps:
        return _steps(self.na, self.lags, self.intercept, True) if tracker.doubts and self.na > 0 else self.steps

    @property
    def apply(self) -> Step | None:
        return take_input if all(nk > 0 for _, nk in self.lags) else None

    @property
    def input_memory(self) -> int:
        return max((nb + nk for nb, nk in self.lags), default=1) - 1

    @property
    def refuse(self) -> Any:
        return refuse_lag

    @property
    def output_lags(self) -> int:
        """The number of leading entries of phi that are past outputs: a bank of hypotheses corrects them by leaf."""
        return self.na

    @property
    def terms(self) -> tuple[Term, ...]:
        past: list[Term] = [("y", o, i + 1) for o in range(len(self.outputs)) for i in range(self.na)]
        given: list[Term] = [("u", j, nk + i) for j, (nb, nk) in enumerate(self.lags) for i in range(nb)]
        return (*past, *given, *([("1", 0, 0)] if self.intercept else []))

    @property
    def reach(self) -> int:
        return max(self.na, *(nb + nk - 1 for nb, nk in self.lags), 0)

    def play(self, theta: Array, y: Array, u: Array, noise: Array, span: tuple[Any, Any]) -> Array:
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

        response: Array = signal.lfilter([1.0], A, np.eye(1, h)[0])
        return response

    def polynomials(self, theta: Array) -> tuple[Array, list[Array]]:
        """A(z) = [1, A_1, ..], A_i = -a_i, and, per input, B(z) = [0 (nk times), b_1, ..], in powers of z^-1.

        ``theta`` is (n,) or (..., n); the polynomials have their coefficients on the last axis.
        """
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
        if len(self.outputs) > 1:
            return super().transfers(theta)
        A, B = self.polynomials(theta)
        return A, [(b, A) for b in B]


@kernel
def take_input(s: State, l: int) -> None:
    """The present input is the first of its lags."""
    for j in range(s.u_lag.shape[0]):
        s.u_lag[j, 0, l] = s.u[j, l]


@lru_cache
def _steps(na: int, lags: tuple[tuple[int, int], ...], intercept: bool, doubts: bool = False) -> ModelSteps:
    """The steps for one set of orders, which are constants, so that every loop is unrolled."""
    m = len(lags)
    # without inputs the loops over them never run, but Numba cannot type an empty tuple
    nb = tuple(b for b, _ in lags) or (0,)
    nk = tuple(k for _, k in lags) or (0,)
    at = tuple(int(na + sum(nb[:j])) for j in range(max(m, 1)))
    n = na + sum(nb)

    @kernel
    def regress(s: State, l: int) -> None:
        broken = s.dt[l] > GAP
        for i in range(na):
            lag = s.y_lag[i, l]
            lag = np.nan if broken else lag
            s.y_lag[i, l] = lag
            s.phi[i, l] = doubted(s, 0, i, l, lag) if doubts else lag
        shift_inputs(s, m, l)
        for j in range(m):
            for i in range(nb[j]):
                s.phi[at[j] + i, l] = s.u_lag[j, nk[j] + i, l]
        if intercept:
            s.phi[n, l] = 1.0
        wait_for_lags(s, l)

    @kernel
    def push(s: State, l: int) -> None:
        if doubts:
            shift_doubts(s, 0, l, l, l, 1, 1, na)
        for i in range(na - 1, 0, -1):
            s.y_lag[i, l] = s.y_lag[i - 1, l]
        take_output(s, na, l)

    return ModelSteps(regress, push)


@dataclass(frozen=True)
class JointARX(ARX):
    """A bound `ARX` with several outputs."""

    @property
    def names(self) -> tuple[str, ...]:
        own = [f"a{i + 1}[<-{output}]" for output in self.outputs for i in range(self.na)]
        return (*own, *self._names_after_lags())

    @property
    def sources(self) -> tuple[str, ...]:
        inputs = self.input_names or tuple(f"u{j + 1}" for j in range(self.m))
        given = (name for name, (nb, _) in zip(inputs, self.lags, strict=True) for _ in range(nb))
        past = (output for output in self.outputs for _ in range(self.na))
        return (*past, *given, *(("",) if self.intercept else ()))

    def names_of(self, output: str) -> tuple[str, ...]:
        named = []
        for name in self.names:
            head, _, source = name.partition("[")
            source = source.removeprefix("<-").removesuffix("]") or ("" if head == "intercept" else "u")
            named.append(f"{head}[{output}<-{source}]" if source else f"{head}[{output}]")
        return tuple(named)

    @property
    def dimensions(self) -> None:  # type: ignore[override]
        return None

    def memory(self) -> Mapping[str, Any]:
        count = len(self.outputs)
        unknown = np.nan if self.start == "drop" else 0.0
        return {**super().memory(), "y_lag": np.full((count, max(self.na, 1)), unknown), "filled": np.zeros(count)}

    @property
    def steps(self) -> ModelSteps:
        return _joint_steps(self.na, self.lags, self.intercept, len(self.outputs))

    def steps_for(self, tracker: TrackerSteps) -> ModelSteps:
        doubts = tracker.doubts and self.na > 0
        return _joint_steps(self.na, self.lags, self.intercept, len(self.outputs), doubts)

    def play(self, theta: Array, y: Array, u: Array, noise: Array, span: tuple[Any, Any]) -> Array:
        raise ValueError("simulate: the outputs of a joint ARX feed each other; one alone cannot be run forward.")

    def polynomials(self, theta: Array) -> tuple[Array, list[Array]]:
        raise ValueError("polynomials: A(z) of several outputs is a matrix; take it from run.theta by run.names.")


@lru_cache
def _joint_steps(
    na: int, lags: tuple[tuple[int, int], ...], intercept: bool, ny: int, doubts: bool = False
) -> ModelSteps:
    m = len(lags)
    nb = tuple(b for b, _ in lags) or (0,)
    nk = tuple(k for _, k in lags) or (0,)
    at = tuple(int(ny * na + sum(nb[:j])) for j in range(max(m, 1)))
    n = ny * na + sum(nb)

    @kernel
    def regress(s: State, l: int) -> None:
        broken = s.dt[l] > GAP
        for o in range(ny):
            for i in range(na):
                s.y_lag[o, i, l] = np.nan if broken else s.y_lag[o, i, l]
                s.phi[o * na + i, l] = doubted(s, o, i, l, s.y_lag[o, i, l]) if doubts else s.y_lag[o, i, l]
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
        for o in range(ny):
            lane = o * series + l % series  # of output o of the same series
            if doubts:
                shift_doubts(s, o, l, lane, l % series, series, ny, na)
            for i in range(na - 1, 0, -1):
                s.y_lag[o, i, l] = s.y_lag[o, i - 1, l]
            informed = (s.s[lane] != np.inf) | (s.noise[lane] == np.inf)
            fill = s.y_hat[lane] if s.valid[lane] > 0.0 and informed and s.filled[o, l] < na else np.nan
            s.filled[o, l] = 0.0 if s.observed[lane] > 0.0 else s.filled[o, l] + 1.0
            if na > 0:
                s.y_lag[o, 0, l] = s.y[lane] if s.observed[lane] > 0.0 else fill

    return ModelSteps(regress, push)
