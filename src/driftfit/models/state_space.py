"""Equations with hidden states: signals that are not measured, and an output that depends on them.

    x_t = f(x_(t-1), inputs, lags, dt; theta) + w_t        a line for each hidden state
    y_t = h(x_t, inputs, lags, dt; theta) + v_t            the last line

    StateSpace('''
        soc = soc[-1] - dt * i / 3600 / theta.capacity
        v1 = v1[-1] + dt * (theta.R1 * i - v1[-1]) / 20
        v = 3.2 + 0.9 * soc - theta.R0 * i - v1
    ''', start={"soc": 0.9, "v1": 0, "capacity": 2, "R1": 0.02, "R0": 0.05})

The text is read as that of an `Equation`, and never evaluated. The name on the left of a line is a hidden state, and on
the left of the last line the output. On the right, ``NAME[-1]`` is the state before, and ``NAME`` the state of the
same sample, in lines after its own. ``dt`` is the interval since the last sample in nominal samples, ``clock`` the time
since the first one. Equations that use neither are applied once for each nominal sample of a gap, with the inputs held.

`JointKalman` follows theta and x together: they are its parameters, with the states last. Derivatives are computed by
forward differentiation of the text (dual numbers), through all lines.

Samples that need a missing input are not used; the states move on with the last known one. A missing output is
replaced by its prediction among the lags, for at most as many samples as the longest lag. Where f or h is not finite
(the root of a negative number) the states stay, and the sample is not used.

Source: Jazwinski, Stochastic Processes and Filtering Theory (1970), section 8.4, for parameters as states; Griewank and
Walther, Evaluating Derivatives (2008), chapter 3. Cost per sample: that of `JointKalman`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from driftfit.engine.drivers import LARGEST, ModelSteps
from driftfit.engine.kernel import State, kernel
from driftfit.models.formula import Formula, Writer, complete_with, parse, start_values, written
from driftfit.models.inputs import NamedInputs
from driftfit.models.lags import take_output

TIME, CLOCK = "dt", "clock"


class System(NamedTuple):
    """The parts of a set of equations."""

    lines: tuple[Formula, ...]
    parameters: tuple[str, ...]
    hidden: tuple[str, ...]
    inputs: tuple[str, ...]
    output: str
    reach: int
    timed: bool
    """Whether the equations use dt or clock."""


@lru_cache(maxsize=256)
def system_of(text: str) -> System:
    """The parts of equations, one per line; ValueError names the part that is not understood."""
    given = [line.strip() for line in text.splitlines() if line.strip()] if isinstance(text, str) else []
    if not given:
        raise ValueError(f"StateSpace: give a text, a line for each hidden state and one for the output; got {text!r}.")
    lines = tuple(parse(line, known=True) for line in given)
    left = tuple(line.output for line in lines)
    if len(set(left)) < len(left) or {TIME, CLOCK} & set(left):
        raise ValueError(
            f"StateSpace: the names on the left must differ, and none may be dt or clock; got {', '.join(left)}."
        )
    hidden, output = left[:-1], left[-1]
    parameters: dict[str, None] = {}
    inputs: dict[str, None] = {}
    lags = [0]
    for k, line in enumerate(lines):
        parameters |= dict.fromkeys(line.parameters)
        for name, lag in line.lags:
            if name in hidden and not (lag == 1 or (lag == 0 and hidden.index(name) < k)):
                raise ValueError(
                    f"StateSpace: {line.text!r} may use {name}[-1], and {name} only in lines after its own."
                )
            if name == output and lag == 0:
                raise ValueError(f"StateSpace: {output} on the right must have a lag, as {output}[-1].")
            if name not in hidden and name not in (TIME, CLOCK):
                lags.append(lag)
                inputs |= dict.fromkeys([name] if name != output else [])
    if not parameters:
        raise ValueError("StateSpace: the equations have no parameter; write the unknown numbers as theta.NAME.")
    if both := sorted(set(parameters) & set(hidden)):
        raise ValueError(f"StateSpace: {', '.join(both)} is the name of a parameter and of a state.")
    timed = any(name in (TIME, CLOCK) for line in lines for name, _ in line.lags)
    return System(lines, tuple(parameters), hidden, tuple(inputs), output, max(lags), timed)


@dataclass(frozen=True)
class StateSpace(NamedInputs):
    """Equations with hidden states, given as text; see `driftfit.models.state_space`. Follow it with `JointKalman`.

    Parameters
    ----------
    equations : str
        A line for each hidden state, and last one for the output.
    start : mapping from name to number, or a number for all
        Parameters and states before the first sample; 1 for parameters that are not named, 0 for states. It is the
        mean of the tracker's prior, unless that has its own.
    inputs : names or None
        Columns of u, in order; None: the inputs of the equations, in the order in which they appear.

    Raises
    ------
    ValueError
        If the text is not such a system, ``start`` names nothing in it, or inputs are missing.
    """

    equations: str
    start: Any = ()
    inputs: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        system = system_of(self.equations)
        self._check_inputs(system.inputs)
        self._set("start", start_values("StateSpace", self.start, self.names))

    @property
    def system(self) -> System:
        return system_of(self.equations)

    @property
    def hidden(self) -> tuple[str, ...]:
        """Names of the states; empty if the equations have none."""
        return self.system.hidden

    @property
    def names(self) -> tuple[str, ...]:
        return (*self.system.parameters, *self.system.hidden)

    @property
    def outputs(self) -> tuple[str, ...]:
        return (self.system.output,)

    @property
    def remembers_outputs(self) -> bool:
        return any(name == self.system.output for line in self.system.lines for name, _ in line.lags)

    def memory(self) -> Mapping[str, Any]:
        depth, n = self.system.reach + 1, self.n
        return {
            "y_lag": np.full((1, depth), np.nan), "u_lag": np.full((max(self.m, 1), depth), np.nan),
            "u_known": np.zeros((max(self.m, 1), depth)), "point": np.zeros(n), "next": np.zeros(n),
            "slopes": np.zeros((max(len(self.hidden), 1), n)), "value": 0.0, "filled": np.zeros(1), "clock": -1.0,
        }  # fmt: skip

    @property
    def steps(self) -> ModelSteps:
        return _steps(self.equations, self.input_names)


class _StateWriter(Writer):
    """Code for the lines of a system: hidden states are variables, as parameters are."""

    def __init__(self, system: System, inputs: tuple[str, ...]) -> None:
        super().__init__(system.lines[-1], inputs)
        self.system, self.parameters, self.present = system, system.parameters, {}  # type: ignore[var-annotated]

    def signal(self, name: str, lag: int) -> tuple[str, dict[int, str]]:
        if name == TIME:
            return "s.dt[l]", {}
        if name == CLOCK:
            return "s.clock[l]", {}
        if name in self.system.hidden:
            if lag == 0 and name in self.present:
                value, derivatives = self.present[name]
                return value, dict(derivatives)
            i = len(self.system.parameters) + self.system.hidden.index(name)
            return self.let(f"s.point[{i}, l]"), {i: "1.0"}
        return super().signal(name, lag)


class Equations(NamedTuple):
    """Compiled equations: they read theta and states in s.point, inputs and lags in s.u_lag and s.y_lag."""

    move: Callable[..., Any]
    """s.next and its derivatives s.slopes, from the states before."""
    play: Callable[..., Any]
    """s.next alone."""
    show: Callable[..., Any]
    """s.value and its derivatives s.phi, from the states of the sample."""
    read: Callable[..., Any]
    """s.value alone."""


@lru_cache(maxsize=256)
def equations_of(text: str, inputs: tuple[str, ...]) -> Equations:
    """The compiled equations of a system."""
    system = system_of(text)
    n = len(system.parameters) + len(system.hidden)
    writer = _StateWriter(system, inputs)
    for line in system.lines[:-1]:
        writer.present[line.output] = writer.write(line.tree)
    values, slopes = list(writer.lines), []
    for k, name in enumerate(system.hidden):
        value, derivatives = writer.present[name]
        values.append(f"s.next[{k}, l] = {value}")
        slopes += [f"s.slopes[{k}, {i}, l] = {derivatives.get(i, '0.0')}" for i in range(n)]
    last = _StateWriter(system, inputs)
    value, derivatives = last.write(system.lines[-1].tree)
    output = [*last.lines, f"s.value[l] = {value}"]
    return Equations(
        written("move", [*values, *slopes] or ["pass"]),
        written("play", values or ["pass"]),
        written("show", [*output, *(f"s.phi[{i}, l] = {derivatives.get(i, '0.0')}" for i in range(n))]),
        written("read", output),
    )


@kernel
def forget_input(s: State, signal: int, age: int, l: int) -> None:
    """`ModelSteps.refuse`."""
    s.u_known[signal, age, l] = 0.0


@kernel
def known_input(s: State, j: int, lag: int, l: int) -> bool:
    """Whether input j was known that many samples ago, and not held from before."""
    return s.u_known[j, lag, l] > 0.0  # type: ignore[no-any-return]


@lru_cache
def _steps(equations: str, inputs: tuple[str, ...]) -> ModelSteps:
    """Lags, and whether a sample has all its inputs. What the equations say of it is the tracker's work."""
    system = system_of(equations)
    m, n, reach = len(inputs), len(system.parameters) + len(system.hidden), system.reach
    complete = complete_with(known_input, system.lines, inputs, system.output)

    @kernel
    def regress(s: State, l: int) -> None:
        s.clock[l] += s.dt[l]
        for i in range(reach, 0, -1):
            s.y_lag[0, i, l] = s.y_lag[0, i - 1, l]
            for j in range(m):
                s.u_lag[j, i, l] = s.u_lag[j, i - 1, l]
                s.u_known[j, i, l] = s.u_known[j, i - 1, l]
        for j in range(m):
            known = abs(s.u[j, l]) < LARGEST
            s.u_known[j, 0, l] = 1.0 if known else 0.0
            s.u_lag[j, 0, l] = s.u[j, l] if known else s.u_lag[j, min(1, reach), l]
        usable = complete(s, l)
        for i in range(n):
            s.phi[i, l] = 1.0 if usable else np.nan

    @kernel
    def push(s: State, l: int) -> None:
        take_output(s, reach, 0, l, l)

    return ModelSteps(regress, push, ages=reach, refuse=forget_input)
