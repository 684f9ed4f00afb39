"""Records for `benchmarks/gate.py`: what sensors do, and what only looks like it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from driftfit.engine.kernel import Driver

T, AT = 600, 300
LEVEL, ONE, TWO, SHIFTED = "gain and level", "ARX(1,1)", "ARX(2,2)", "ARX(2,2) and level"
MODELS = {LEVEL: (0, 0, 1, True), ONE: (1, 1, 1, False), TWO: (2, 2, 1, False), SHIFTED: (2, 2, 1, True)}


@dataclass
class Case:
    """A record, theta (T, n) behind it, which readings and inputs are codes, and where the trouble begins.

    ``q`` is the drift that `Kalman` is given, ``r`` the variance of the noise.
    """

    model: str
    y: np.ndarray
    u: np.ndarray
    theta: np.ndarray
    bad: np.ndarray
    bad_u: np.ndarray
    at: int = AT
    q: float = 1e-6
    r: float = 0.01

    def without_codes(self) -> tuple[np.ndarray, np.ndarray]:
        """y and u with the codes missing."""
        return np.where(self.bad, np.nan, self.y), np.where(self.bad_u[:, None], np.nan, self.u)


@Driver
def respond(theta: Any, u: Any, e: Any, na: int, nb: int) -> Any:
    """The output of an ARX plant at rest before the record."""
    y = np.zeros(len(u))
    for t in range(len(u)):
        y[t] = e[t] + (theta[t, na + nb] if theta.shape[1] > na + nb else 0.0)
        for i in range(na):
            y[t] += theta[t, i] * y[t - 1 - i] if t > i else 0.0
        for i in range(nb):
            y[t] += theta[t, na + i] * u[t - 1 - i] if t > i else 0.0
    return y


THETA = {LEVEL: [1.0, 5.0], ONE: [0.7, 2.0], TWO: [1.1, -0.5, 1.0, 0.5], SHIFTED: [1.1, -0.5, 1.0, 0.5, 0.0]}


def record(
    model: str, g: np.random.Generator, theta: Any = None, u: Any = None, e: Any = None, T: int = T, **more: Any
) -> Case:
    """A clean record of a model."""
    u = g.normal(size=T) if u is None else u
    e = 0.1 * g.normal(size=T) if e is None else e
    theta = np.tile(THETA[model], (T, 1)) if theta is None else theta
    na, nb, _, _ = MODELS[model]
    y = theta[:, 0] * u + theta[:, 1] + e if model == LEVEL else respond(theta, u, e, na, nb)
    return Case(model, y, u[:, None].copy(), theta, np.zeros(T, bool), np.zeros(T, bool), **more)


def jumped(model: str, column: int, value: float, **more: Any) -> Callable[[Any], Case]:
    """One parameter jumps."""

    def make(g: np.random.Generator) -> Case:
        theta = np.tile(THETA[model], (T, 1))
        theta[AT:, column] = value
        return record(model, g, theta, **({"q": 1e-3} | more))

    return make


def coded(model: str, places: Any, values: Any, of: str = "y", u: Any = None, **more: Any) -> Callable[[Any], Case]:
    """Codes in y or u; ``places`` and ``values`` may be functions of the generator, ``values`` of the signal too."""

    def make(g: np.random.Generator) -> Case:
        case = record(model, g, u=None if u is None else u(g), **more)
        where = places(g) if callable(places) else places
        mask = np.zeros(T, bool)
        mask[where] = True
        signal = case.y if of == "y" else case.u[:, 0]
        signal[mask] = values(g, signal[mask]) if callable(values) else values
        if of == "y":
            case.bad |= mask
        else:
            case.bad_u |= mask
        case.at = int(np.flatnonzero(mask)[0])
        return case

    return make


def signs(g: Any, x: Any) -> Any:
    return 9999.0 * np.where(g.random(len(x)) < 0.5, 1.0, -1.0)


def spikes(g: Any) -> Any:
    where = g.random(T) < 0.05
    where[:20] = False
    return where


def first_ten(g: Any) -> Any:
    return np.r_[g.integers(0, 10), g.integers(60, T, 5)]


def level_50(make: Callable[[Any], Case]) -> Callable[[Any], Case]:
    """The same around 50, with codes of 0 for it."""

    def moved(g: np.random.Generator) -> Case:
        case = make(g)
        case.y[~case.bad] += 45.0
        case.theta[:, 1] += 45.0
        return case

    return moved


def repeated(g: np.random.Generator) -> Case:
    levels = np.repeat([1.0, 5.0, 2.0, 9.0], 100)
    theta = np.column_stack([np.zeros(400), levels])
    return record(LEVEL, g, theta, e=np.zeros(400), T=400, at=100, q=1e-3)


def pulses(*gains: float) -> Callable[[Any], Case]:
    def make(g: np.random.Generator) -> Case:
        N = 600 * len(gains)
        theta = np.column_stack([np.repeat(gains, 600), np.zeros(N)])
        u = (g.random(N) < 0.02) * 1.0
        return record(LEVEL, g, theta, u, T=N, at=600, q=1e-2)

    return make


def rounded(model: str, quantum: float, noise: float, held: int = 1, **more: Any) -> Callable[[Any], Case]:
    def make(g: np.random.Generator) -> Case:
        case = record(model, g, u=np.repeat(g.normal(size=T // held), held), e=noise * g.normal(size=T), **more)
        case.y[:] = quantum * np.round(case.y / quantum)
        case.r = noise**2 + quantum**2 / 12.0
        return case

    return make


def coarse_level(g: np.random.Generator) -> Case:
    case = rounded(LEVEL, 1.0, 0.3)(g)
    case.y[AT:] += 100.0
    case.theta[AT:, 1] += 100.0
    case.q = 1e-1
    return case


def frozen(model: str, length: int) -> Callable[[Any], Case]:
    def make(g: np.random.Generator) -> Case:
        case = record(model, g)
        case.y[AT + 1 : AT + length] = case.y[AT]
        case.bad[AT + 1 : AT + length] = True
        return case

    return make


def at_rest(g: np.random.Generator) -> Case:
    """The plant rests inside its range, and its readings repeat; then it goes on."""
    u = g.normal(size=T)
    u[AT : AT + 60] = u[AT]
    theta = np.tile(THETA[LEVEL], (T, 1))
    e = 0.1 * g.normal(size=T)
    e[AT : AT + 60] = e[AT]
    return record(LEVEL, g, theta, u, e)


def code_then_rest(place: int, value: float, noise: float) -> Callable[[Any], Case]:
    """A code among the first readings of a plant that then rests for 200 samples: a1 = .9."""

    def make(g: np.random.Generator) -> Case:
        u = np.where(np.arange(T) < 200, 0.0, g.normal(size=T))
        e = np.where(np.arange(T) < 200, noise, 0.1) * g.normal(size=T)
        case = record(ONE, g, np.tile([0.9, 1.0], (T, 1)), u, e, at=260)
        case.y[place] = value
        case.bad[place] = True
        return case

    return make


def honest(what: str, model: str = TWO) -> Callable[[Any], Case]:
    """Clean records with unusual inputs, parameters or noise."""

    def make(g: np.random.Generator) -> Case:
        t, u, e, theta = np.arange(T), g.normal(size=T), 0.1 * g.normal(size=T), np.tile(THETA[model], (T, 1))
        q = 1e-6
        if what == "walks":
            theta = theta + np.cumsum(0.02 * g.normal(size=theta.shape) * [0.0, 0.0, 1.0, 1.0][-theta.shape[1] :], 0)
            q = 4e-4
        elif what == "hetero":
            e *= np.exp(0.7 * np.sin(t / 30.0) + 0.5 * u)
        elif what == "t3":
            e = 0.1 * g.standard_t(3, T)
        elif what == "steps":
            u = 0.1 * u + np.where(t >= AT, 3.0, 0.0)
        elif what == "rest, moves":
            u = np.where(t < 200, 0.0, u)
        elif what == "rest at 50, moves":
            u = np.where(t < 200, 50.0, 50.0 + u)
        elif what == "rare":
            u = (g.random(T) < 0.03) * 1.0
        elif what == "tails":
            u = g.standard_t(3, T)
        elif what == "floods":
            flow = np.zeros(T)
            for k in range(1, T):
                flow[k] = 0.95 * flow[k - 1] + 0.3 * u[k]
            u = np.exp(1.5 * flow)
        elif what == "another level":
            u, theta, e = (t >= 7) * 1.0, theta * [50.0, 0.0], 0.1 * e
        elif what == "test at 3":
            u = np.where(t == 3, 100.0, 0.001 * u)
        elif what == "test":
            u = 0.01 * u + (t == AT) * 10.0
        return record(model, g, theta, u, e, q=q)

    return make


def bent(g: np.random.Generator) -> Case:
    """A flood to which the output responds by half as much as a line would."""
    u = g.normal(size=T)
    u[AT : AT + 5] = 12.0
    theta = np.tile(THETA[LEVEL], (T, 1))
    theta[AT : AT + 5, 0] = 0.5
    return record(LEVEL, g, theta, u)


def no_response(noise: float) -> Callable[[Any], Case]:
    """A gain that is lost where the input goes up and stays there."""

    def make(g: np.random.Generator) -> Case:
        up = np.arange(T) >= AT
        u = np.where(up, 3.0 + noise * g.normal(size=T), 0.1 * g.normal(size=T))
        theta = np.column_stack([np.where(up, 0.0, 2.0), np.zeros(T)])
        return record(LEVEL, g, theta, u, 0.01 * g.normal(size=T), q=1e-3, r=1e-4)

    return make


def around_50(g: Any) -> Any:
    return 50.0 + 5.0 * g.normal(size=T)


def start_codes(of: str, value: float) -> dict[str, Callable[[Any], Case]]:
    return {
        f"{value:g} in {of}, at {k}": coded(TWO, [k], value, of)
        for k in (0, 1, 2, 3, 4, 6, 8, 10, 12, 14, 16, 18, 19, 20, 21, 22, 25, 30, 40)
    }


REAL = {
    **{f"jump of a gain to {k}": jumped(LEVEL, 0, k) for k in (3.0, 10.0, 100.0, 1000.0)},
    "jump of a gain to 10, slow": jumped(LEVEL, 0, 10.0, q=1e-6),
    "jump of a gain to 1000, slow": jumped(LEVEL, 0, 1000.0, q=1e-6),
    **{f"level by {k} sd": jumped(LEVEL, 1, 5.0 + 0.1 * k) for k in (3.0, 30.0, 100.0, 1000.0, 10000.0)},
    **{f"ARX gain to {k}": jumped(TWO, 2, k) for k in (3.0, 10.0, 1000.0)},
    **{f"ARX level to {k}": jumped(SHIFTED, 4, k) for k in (3.0, 100.0)},
    "levels without noise": repeated,
    "pulses 5, 1, 4": pulses(5.0, 1.0, 4.0),
    "pulses 8, 25": pulses(8.0, 25.0),
    "pulses 1, 100": pulses(1.0, 100.0),
    **{what: honest(what) for what in (
        "walks", "hetero", "t3", "steps", "rest, moves", "rare", "tails", "floods", "test",
    )},
    "whole numbers, level by 100": coarse_level,
    "test at 3": honest("test at 3"),
    "another level from 7": honest("another level", LEVEL),
    "rest at 50, moves": honest("rest at 50, moves", LEVEL),
    "t3 on a level": honest("t3", LEVEL),
    "a flood that bends": bent,
    "no response, moves": no_response(0.1),
    "no response, rests": no_response(0.0),
    **{f"whole numbers, noise {k}": rounded(LEVEL, 1.0, k) for k in (0.15, 0.3, 0.6)},
    "whole numbers, held": rounded(LEVEL, 1.0, 0.3, 20),
    "quantum .2, ARX": rounded(ONE, 0.2, 0.1),
    "healthy, 5 mV": rounded(ONE, 0.005, 0.1, 5),
    "at rest inside its range": at_rest,
}  # fmt: skip
CODES = {
    "9999": coded(LEVEL, [320], 9999.0),
    "9999 for 8": coded(LEVEL, slice(320, 328), 9999.0),
    "9999 for 8, any sign": coded(LEVEL, slice(320, 328), signs),
    "-999, ARX": coded(TWO, [320], -999.0),
    "9999 for 8, ARX": coded(TWO, slice(320, 328), 9999.0),
    "9999 for 20, ARX": coded(TWO, slice(320, 340), 9999.0),
    "by turns, ARX": coded(TWO, slice(320, 328), lambda g, x: np.resize([9999.0, -999.0], len(x))),
    "with good between, ARX": coded(TWO, [k for k in range(320, 350) if k % 4], -999.0),
    "0 for 50": level_50(coded(LEVEL, [320], 0.0)),
    "0 for 50, for 8": level_50(coded(LEVEL, slice(320, 328), 0.0)),
    "flickering rail": coded(LEVEL, slice(320, 335), lambda g, x: 4095.0 - g.integers(0, 2, len(x))),
    "one of the first ten, and more": coded(TWO, first_ten, 9999.0),
    "9999 for 60": coded(LEVEL, slice(320, 380), 9999.0),
    "9999 for 60, ARX": coded(TWO, slice(320, 380), 9999.0),
    "20 at the start": coded(TWO, slice(0, 20), 9999.0),
    "50 at the start": coded(TWO, slice(0, 50), 9999.0),
    "20 at the start, level": coded(LEVEL, slice(0, 20), 9999.0),
    "spikes 5 %": coded(LEVEL, spikes, lambda g, x: x + 300.0 * g.normal(size=len(x))),
    "spikes 5 %, ARX": coded(TWO, spikes, lambda g, x: x + 300.0 * g.normal(size=len(x))),
    "9999 for 8, coarse": lambda g: _coarse_code(g),
    "0 in u at 50": coded(TWO, [320], 0.0, "u", around_50),
    "-999 in u": coded(TWO, [320], -999.0, "u"),
    "-999 in u for 3": coded(TWO, slice(320, 323), -999.0, "u"),
    "0 in u at 50 for 20": coded(TWO, slice(320, 340), 0.0, "u", around_50),
    "0 in u at 50, no lags": coded(LEVEL, [320], 0.0, "u", around_50),
    "9999 in u for 20, no lags": coded(LEVEL, slice(320, 340), 9999.0, "u", around_50),
    "frozen for 40": frozen(LEVEL, 40),
    "frozen for 40, ARX": frozen(TWO, 40),
    "code 0, then rest": code_then_rest(0, 9999.0, 0.0),
    "code 1, then rest": code_then_rest(1, 9999.0, 0.0),
    "code 1, then noisy rest": code_then_rest(1, 9999.0, 0.1),
}
STARTS = {**start_codes("y", 9999.0), **start_codes("u", -999.0), **start_codes("y", 99.0)}


def _coarse_code(g: np.random.Generator) -> Case:
    case = rounded(LEVEL, 1.0, 0.3)(g)
    case.y[320:328], case.bad[320:328] = 9999.0, True
    return case
