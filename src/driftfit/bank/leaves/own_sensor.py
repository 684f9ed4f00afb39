"""Sensors with a likelihood that the user writes: `driftfit.bank.sensor.Sensor.own`.

A leaf, whose forecast without noise has mean y_hat = z'm and variance h = z'C z, is updated by a measurement with the
noise variance a that the function returns,

    K = C z / (h + a),     m+ = m + K (y - y_hat),     C+ = C - K (C z)'

so C remains a covariance whatever the function returns; a = inf is `LARGEST_NOISE` times h + r. The function is
compiled by itself, in a second or two. The compiled routine of a bank calls it by its address (`call`), which a step
has looked up by its symbol; the routine is not recompiled.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import numpy as np
from numba import types

from driftfit.bank.layout import ROW
from driftfit.bank.leaves.leaf_matrix import NU, S
from driftfit.engine.kernel import Array, State, floats, kernel, machine, shared
from driftfit.engine.numba_internals import ir, named_intrinsic
from driftfit.engine.simd import WIDTH

OWN_AT = ROW["own_likelihoods"]
LARGEST_NOISE, LEAST_NOISE = 1e12, 1e-12
"""Limits of noise variances: at most this multiple of the forecast's variance, which has no effect, and at least this
share of the nominal one.
"""
LOG_P, NOISE, CLEAN = range(3)
"""Entries of what a function returns."""
NUMBERS = 6
"""Numbers that a function called by its address takes, before the address of its results."""
_KIND = ir.FunctionType(ir.VoidType(), [ir.DoubleType()] * NUMBERS + [ir.IntType(64)])


def _address_of(context: Any, machine: Any) -> Any:
    """The address of a compiled routine in this process."""

    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        known = builder.module.globals.get(machine.symbol)
        function = known or ir.Function(builder.module, _KIND, machine.symbol)
        return builder.ptrtoint(function, ir.IntType(64))

    return types.intp(machine), build


def _call(context: Any, address: Any, numbers: Any, out: Any) -> Any:
    """Call the function at an address with a tuple of six numbers and the address of its results."""

    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        at, given, results = arguments
        values = [builder.extract_value(given, k) for k in range(NUMBERS)]
        builder.call(builder.inttoptr(at, _KIND.as_pointer()), [*values, results])
        return context.get_dummy_value()

    return types.void(types.intp, types.UniTuple(types.float64, NUMBERS), types.intp), build


address_of = named_intrinsic("callback.address_of", _address_of)
call = named_intrinsic("callback.call", _call)


@shared
def judge(t: Any, which: float, at: int, l: int, y: float, r: float, answers: Array) -> None:
    """Evaluate function ``which`` for the leaf in column at + l, with the noise variance in the units of C; r is that
    of the nominal sensor.
    """
    B, expected = t.leaves, t.expected
    unit = B[S, at + l] / (B[NU, at + l] - 2.0) if t.unknown > 0 else 1.0
    h = expected[0, l]
    readings = y + t.shift, expected[1, l] + t.shift
    call(t.own_likelihoods, (which, *readings, h * unit, r * unit, t.reading), answers.ctypes.data)
    most = LARGEST_NOISE * (h + r)
    answers[NOISE] = max(answers[NOISE] / unit, LEAST_NOISE * r) if answers[NOISE] < most * unit else most
    answers[LOG_P] = answers[LOG_P] if answers[LOG_P] < np.inf else -np.inf
    answers[CLEAN] = answers[CLEAN] if abs(answers[CLEAN]) < np.inf else y


@shared
def judge_all(t: Any, which: float, at: int, columns: int, y: float, r: float) -> None:
    """Evaluate the function for every leaf: log densities in the first row of `scores`, noise variances in its last
    row, and what the function returns as the output in the first row of `answers`.

    The columns up to a whole SIMD vector hold no leaf; their variance must not be zero, because numbers are divided by
    it.
    """
    clean, answer = t.answers[0], t.answers[1]
    for l in range(-(-columns // WIDTH) * WIDTH):
        answer[NOISE] = r
        if l < columns:
            judge(t, which, at, l, y, r, answer)
            t.scores[0, l], clean[l] = answer[LOG_P], answer[CLEAN]
        t.scores[2, l] = answer[NOISE]


@cache
def entry_of(functions: tuple[Callable[..., Any], ...]) -> tuple[Any, Any]:
    """The functions, numbered from 1, as a compiled routine; and the step that writes their address."""
    chosen = _chosen(functions)

    def likelihoods(which: float, y: float, y_hat: float, h: float, r: float, last: float, out: int) -> None:
        answers = floats(out, 1, 3)
        answers[0, 0], answers[0, 1], answers[0, 2] = chosen(which, y, y_hat, h, r, last)

    likelihoods.__annotations__ = {name: "float" for name in ("which", "y", "y_hat", "h", "r", "last")}
    entry = machine(likelihoods)

    @kernel
    def point_out(s: State, l: int) -> None:
        s.table[OWN_AT, 0, l] = address_of(entry)

    return entry, point_out


def _chosen(functions: Sequence[Callable[..., Any]]) -> Any:
    """One of several functions, by its number."""
    first = kernel(functions[0])
    others = _chosen(functions[1:]) if len(functions) > 1 else None

    @kernel
    def one(which: float, y: float, y_hat: float, h: float, r: float, last: float) -> tuple[float, float, float]:
        if others is None or which == 1.0:
            return first(y, y_hat, h, r, last)  # type: ignore[no-any-return]
        return others(which - 1.0, y, y_hat, h, r, last)  # type: ignore[no-any-return]

    return one
