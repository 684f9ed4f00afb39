"""The compiled steps of `driftfit.models.polynomial`: the signals behind a prediction, and its gradient.

`driftfit.models.polynomials.instruments` puts other regressors in the place of the gradient. Each function makes the
kernels for one set of orders, which are constants, so that every loop is unrolled.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from driftfit.engine.drivers import LARGEST, SMALLEST, ModelSteps
from driftfit.engine.kernel import State, Step, kernel
from driftfit.models.base import GAP
from driftfit.models.lags import informed
from driftfit.models.linearised import along, restore, subtract

SETTLING = 4.0
"""Samples for each parameter, at the start, that are a pseudolinear regression."""

ENTRY = 2.0
"""Samples for each parameter before C and D enter."""

STABLE = 0.9999
"""Largest reflection coefficient of a filter that is used."""

CONTRACTION, CONTRACTIONS = 0.9, 20
"""Factor of the zeros of C or F while it is unstable, and how often it is applied."""

DOUBLINGS = 12
"""How often the zeros of D are drawn towards 0 while it is unstable: by 1 - `STABLE`, then twice as much each time."""

LEAST_RESIDUAL = 1e-10
"""A residual below this share of the output and the fitted value is rounding that an interpolated sample left: 0."""

BEYOND = 1e6
"""A signal that the model computes is at most so many times the largest reading of its unit. Parameters that one absurd
reading left behind would otherwise compute absurd signals, which are the regressors of the next samples. An offset that
cancels the response to a large mean of the input is within it."""
NOISE = 1e3
"""The same for noise and innovation, which nothing cancels."""
FIRST, RISE, FALL = 10.0, 10.0, 0.1
"""After the first samples, the factor by which the largest reading grows at most at one (before, by BEYOND); and the
factor by which it falls at a reading that it is BEYOND times."""

Y, YF, V, VF, E, EF, ONE, OWN = range(8)
"""Rows of the past: the output and D/C of it, v and 1/C v, e and 1/C e, D/C 1; then EACH rows for every input."""
U, HELD, G, UF, W, WF, EACH = range(7)
"""Rows of an input: itself, itself or its last value, D/C and D/(C F) of that, its response w, D/(C F) of w."""


class Places(NamedTuple):
    """The orders, and where the coefficients of each polynomial begin in theta; tuples have an entry per input."""

    na: int
    nc: int
    nd: int
    m: int
    nb: tuple[int, ...]
    nf: tuple[int, ...]
    nk: tuple[int, ...]
    at_b: tuple[int, ...]
    at_c: int
    at_d: int
    at_f: tuple[int, ...]
    at_offset: int
    """-1 if there is none."""
    n: int


def places(na: int, nc: int, nd: int, orders: tuple[tuple[int, int, int], ...], offset: bool) -> Places:
    """The places for these orders; ``orders`` are (nb, nf, nk) of every input."""
    # without inputs the loops over them never run, but Numba cannot type an empty tuple
    nb, nf, nk = (tuple(one[i] for one in orders) or (0,) for i in range(3))
    at_c = na + sum(nb)
    at_f = at_c + nc + nd
    last = at_f + sum(nf)
    return Places(
        na, nc, nd, len(orders), nb, nf, nk, tuple(na + sum(nb[:j]) for j in range(len(nb))), at_c, at_c + nc,
        tuple(at_f + sum(nf[:j]) for j in range(len(nf))), last if offset else -1, last + offset,
    )  # fmt: skip


@kernel
def credible(s: State, x: float, signal: int, l: int) -> bool:
    """Whether the readings of a signal (0 the output, 1 + j an input) make x possible."""
    largest = s.extent[signal, l]
    return abs(x) < (min(BEYOND * largest, LARGEST) if largest > SMALLEST else LARGEST)


@kernel
def within(s: State, x: float, l: int) -> float:
    """x, or the largest noise of its sign that is credible."""
    top = min(NOISE * s.extent[0, l], LARGEST) if s.extent[0, l] > SMALLEST else LARGEST
    return min(max(x, -top), top) if abs(x) < np.inf else 0.0


@kernel
def filtered(s: State, x: float, raw: float, signal: int, l: int) -> float:
    """What a filter of the gradient gives, or the signal itself where that is not credible."""
    return x if credible(s, x, signal, l) else raw


@kernel
def enlarge(s: State, x: float, signal: int, l: int) -> None:
    """Remember the size of the largest readings of a signal, but for a single absurd one, also if it is the first."""
    largest, size = s.extent[signal, l], abs(x)
    most = largest * (RISE if s.usable[l] >= FIRST else BEYOND)
    near = min(size, most) if size > largest else largest
    near = FALL * largest if BEYOND * size < largest else near
    near = near if largest > 0.0 else size
    s.extent[signal, l] = near if (size > SMALLEST) & (size < LARGEST) else largest


@kernel
def refer(s: State, x: float, signal: int, l: int) -> None:
    """The reading about which a signal is filtered: the last before the first usable sample."""
    s.reference[signal, l] = x if (s.usable[l] < 1.0) & (abs(x) < LARGEST) else s.reference[signal, l]


@kernel
def stable(s: State, first: int, order: int, sign: float, l: int) -> bool:
    """Whether 1 + sum_i sign x_i z^-i is, x from s.point[first]: all reflection coefficients are inside (-1, 1)."""
    inside = True
    for i in range(order):
        s.recursion[0, i, l] = sign * s.point[first + i, l]
    for k in range(order - 1, -1, -1):
        r = s.recursion[0, k, l]
        inside = inside & (abs(r) < STABLE)
        scale = 1.0 / (1.0 - r * r) if inside else 0.0
        for i in range(k):
            s.recursion[1, i, l] = (s.recursion[0, i, l] - r * s.recursion[0, k - 1 - i, l]) * scale
        for i in range(k):
            s.recursion[0, i, l] = s.recursion[1, i, l]
    return inside


@kernel
def contract(s: State, first: int, order: int, sign: float, l: int) -> None:
    """The zeros of a polynomial in s.point are drawn towards 0 until it is stable."""
    for _ in range(CONTRACTIONS):
        if not stable(s, first, order, sign, l):
            scale = CONTRACTION
            for i in range(order):
                s.point[first + i, l] *= scale
                scale *= CONTRACTION
    if not stable(s, first, order, sign, l):
        for i in range(order):
            s.point[first + i, l] = 0.0


@kernel
def bound(s: State, first: int, order: int, sign: float, l: int) -> None:
    """An unstable polynomial in s.point becomes a stable one near it, which is not 1.

    D is what the model takes for noise, and near 1 - z^-1 it represents the level of a record without an offset: the
    level would not be predicted any more if D were drawn far from it. D must not be C, as it would be if both were 1: e
    and v would then be the same, and their parameters could not be learned again.
    """
    nearer = 1.0 - STABLE
    if not stable(s, first, order, sign, l):
        for _ in range(DOUBLINGS if order > 1 else 0):
            if not stable(s, first, order, sign, l):
                scale = 1.0 - nearer
                for i in range(order):
                    s.point[first + i, l] *= scale
                    scale *= 1.0 - nearer
                nearer *= 2.0
    if not stable(s, first, order, sign, l):
        total = 0.0
        for i in range(order):
            total += abs(s.point[first + i, l])
        for i in range(order):
            s.point[first + i, l] *= STABLE / total if total < LARGEST else 0.0


@kernel
def at_theta(s: State, l: int) -> None:
    """The point of the linearisation is the last estimate."""
    for i in range(s.theta.shape[0]):
        s.point[i, l] = s.theta[i, l]


@kernel
def staying(s: State, l: int) -> None:
    """The point of the linearisation is held."""


@lru_cache
def filters(p: Places) -> tuple[Any, Any]:
    """``colour(s, raw, into, about, l)`` and ``whitened(s, raw, into, l)``: D/C and 1/C of the present sample of a row.

    Beside an offset, signals are filtered about a reading of the start: filters change while they learn, and those of a
    large mean and of the ones, at different moments, would differ by more than the signal.
    """
    nc, nd, at_c, at_d = p.nc, p.nd, p.at_c, p.at_d

    @kernel
    def colour(s: State, raw: int, into: int, about: float, l: int) -> float:
        x = s.signals[raw, 0, l] - about
        for i in range(nd):
            x -= s.point[at_d + i, l] * (s.signals[raw, i + 1, l] - about)
        for i in range(nc):
            x -= s.damped[at_c + i, l] * s.signals[into, i + 1, l]
        return x  # type: ignore[no-any-return]

    @kernel
    def whitened(s: State, raw: int, into: int, l: int) -> float:
        x = s.signals[raw, 0, l]
        for i in range(nc):
            x -= s.damped[at_c + i, l] * s.signals[into, i + 1, l]
        return filtered(s, x, s.signals[raw, 0, l], 0, l)  # type: ignore[no-any-return]

    return colour, whitened


@lru_cache
def point(p: Places, place: Step, waiting: float = ENTRY) -> Any:
    """The point of the linearisation, which ``place`` gives, with C, D and F made stable."""
    n, at_c, at_d, at_f, nc, nd, nf, m = p.n, p.at_c, p.at_d, p.at_f, p.nc, p.nd, p.nf, p.m

    @kernel
    def linearise(s: State, l: int) -> None:
        place(s, l)
        if nc > 0:
            contract(s, at_c, nc, 1.0, l)
        if nd > 0:
            bound(s, at_d, nd, -1.0, l)
        for j in range(m):
            if nf[j] > 0:
                contract(s, at_f[j], nf[j], -1.0, l)
        # the filters of the gradient reach their full length in the course of time
        inner = 1.0 - 1.0 / max((s.usable[l] - (waiting - ENTRY) * n) / (SETTLING * n), 1.0)
        scale = inner
        for i in range(nc):
            s.damped[at_c + i, l] = scale * s.point[at_c + i, l]
            scale *= inner
        inner = 1.0 - 1.0 / max(s.usable[l] / (SETTLING * n), 1.0)
        for j in range(m):
            scale = inner
            for i in range(nf[j]):
                s.damped[at_f[j] + i, l] = scale * s.point[at_f[j] + i, l]
                scale *= inner

    return linearise


@lru_cache
def taking_inputs(p: Places) -> Step:
    """The step that takes the inputs of the present sample, and filters them."""
    m, nf, at_f, offset = p.m, p.nf, p.at_f, p.at_offset >= 0
    colour, _ = filters(p)

    @kernel
    def take_inputs(s: State, l: int) -> None:
        for j in range(m):
            own, u = OWN + EACH * j, s.u[j, l]
            known = abs(u) < LARGEST
            s.signals[own + U, 0, l] = u if known else np.nan
            s.last_input[j, l] = u if known else s.last_input[j, l]
            enlarge(s, u, 1 + j, l)
            held = s.last_input[j, l]
            s.signals[own + HELD, 0, l] = held
            if offset & (nf[j] == 0):
                refer(s, held, 1 + j, l)
            about = s.reference[1 + j, l]
            s.signals[own + G, 0, l] = filtered(s, colour(s, own + HELD, own + G, about, l), held - about, 1 + j, l)
            x = s.signals[own + G, 0, l]
            for i in range(nf[j]):
                x += s.damped[at_f[j] + i, l] * s.signals[own + UF, i + 1, l]
            s.signals[own + UF, 0, l] = filtered(s, x, held - about, 1 + j, l)

    return take_inputs  # type: ignore[no-any-return]


@lru_cache
def _responses(p: Places) -> Any:
    """``respond(s, gradient, l)`` stores the present w of every input, with ``gradient`` D/(C F) of it too."""
    m, nb, nf, nk, at_b, at_f = p.m, p.nb, p.nf, p.nk, p.at_b, p.at_f

    @kernel
    def respond(s: State, gradient: bool, l: int) -> float:
        total = 0.0
        for j in range(m):
            w, wf, own = 0.0, 0.0, OWN + EACH * j
            for i in range(nb[j]):
                b = s.point[at_b[j] + i, l]
                w += b * s.signals[own + HELD, nk[j] + i, l]
                wf += b * s.signals[own + UF, nk[j] + i, l]
            for i in range(nf[j]):
                w += s.point[at_f[j] + i, l] * s.signals[own + W, i + 1, l]
                wf += s.damped[at_f[j] + i, l] * s.signals[own + WF, i + 1, l]
            w = w if abs(w) < LARGEST else 0.0
            s.signals[own + W, 0, l] = w
            s.signals[own + WF, 0, l] = filtered(s, wf, 0.0, 0, l) if gradient else s.signals[own + WF, 0, l]
            total += w
        return total

    return respond


@lru_cache
def predictions(p: Places) -> tuple[Any, Any]:
    """``predict(s, gradient, l)``: y_hat at s.point; ``noise(s, l)``: the part of it that earlier noise explains."""
    na, nc, nd, at_c, at_d, at_offset = p.na, p.nc, p.nd, p.at_c, p.at_d, p.at_offset
    respond = _responses(p)

    @kernel
    def noise(s: State, l: int) -> float:
        total = 0.0
        for i in range(nc):
            total += s.point[at_c + i, l] * s.signals[E, i + 1, l]
        for i in range(nd):
            total += s.point[at_d + i, l] * s.signals[V, i + 1, l]
        return total

    @kernel
    def predict(s: State, gradient: bool, l: int) -> float:
        y_hat = respond(s, gradient, l) + noise(s, l)
        for i in range(na):
            lag = s.signals[Y, i + 1, l]
            y_hat += s.point[i, l] * (lag if abs(lag) < LARGEST else 0.0)
        if at_offset >= 0:
            y_hat += s.point[at_offset, l]
        return y_hat  # type: ignore[no-any-return]

    return predict, noise


@lru_cache
def gradient_of(p: Places) -> Any:
    """s.phi: the gradient of y_hat, or at the start the regression vector."""
    na, nc, nd, m, nb, nf, nk = p.na, p.nc, p.nd, p.m, p.nb, p.nf, p.nk
    at_b, at_c, at_d, at_f, at_offset, n = p.at_b, p.at_c, p.at_d, p.at_f, p.at_offset, p.n

    @kernel
    def gradient(s: State, l: int) -> None:
        settled = s.usable[l] >= SETTLING * n
        if at_offset >= 0:
            one = 1.0
            for i in range(nd):
                one -= s.point[at_d + i, l]
            for i in range(nc):
                one -= s.damped[at_c + i, l] * s.signals[ONE, i + 1, l]
            one = one if abs(one) < BEYOND else 1.0
            s.signals[ONE, 0, l] = one
            s.phi[at_offset, l] = one if settled else 1.0
        for i in range(na):
            lag = s.signals[YF, i + 1, l] + s.reference[0, l] * s.signals[ONE, 0, l]
            lag = lag if settled else s.signals[Y, i + 1, l]
            s.phi[i, l] = lag if abs(s.signals[Y, i + 1, l]) < LARGEST else np.nan
        for j in range(m):
            own = OWN + EACH * j
            for i in range(nb[j]):
                at = nk[j] + i
                lag = s.signals[own + UF, at, l] + s.reference[1 + j, l] * s.signals[ONE, 0, l]
                lag = lag if settled else s.signals[own + U, at, l]
                s.phi[at_b[j] + i, l] = lag if abs(s.signals[own + U, at, l]) < LARGEST else np.nan
            for i in range(nf[j]):
                s.phi[at_f[j] + i, l] = s.signals[own + WF, i + 1, l] if settled else s.signals[own + W, i + 1, l]
        for i in range(nc):
            s.phi[at_c + i, l] = s.signals[EF, i + 1, l] if settled else s.signals[E, i + 1, l]
        for i in range(nd):
            s.phi[at_d + i, l] = s.signals[VF, i + 1, l] if settled else s.signals[V, i + 1, l]

    return gradient


@lru_cache
def ageing(p: Places) -> Any:
    """Every signal moves by one sample."""
    m = p.m

    @kernel
    def age(s: State, l: int) -> None:
        # a gap in time breaks the lags
        broken = s.dt[l] > GAP
        for j in range(m):
            for r in range(s.left.shape[1]):
                s.left[j, r, l] = s.signals[OWN + EACH * j + HELD + r, s.signals.shape[1] - 1, l]
        for r in range(s.signals.shape[0]):
            for i in range(s.signals.shape[1] - 1, 0, -1):
                s.signals[r, i, l] = s.signals[r, i - 1, l]
        for i in range(1, s.signals.shape[1]):
            s.signals[Y, i, l] = np.nan if broken else s.signals[Y, i, l]
            for j in range(m):
                s.signals[OWN + EACH * j + U, i, l] = np.nan if broken else s.signals[OWN + EACH * j + U, i, l]
            for r in range(V, ONE):
                s.signals[r, i, l] = 0.0 if broken else s.signals[r, i, l]

    return age


@lru_cache
def regressing(p: Places, place: Step, regressors: Any, waiting: float = ENTRY) -> Step:
    """``regress``; ``regressors(s, y_hat, l)`` fills s.phi, and returns the prediction at the point."""
    n, offset, predict = p.n, p.at_offset >= 0, predictions(p)[0]
    age, linearise, take_inputs = ageing(p), point(p, place, waiting), taking_inputs(p)

    @kernel
    def regress(s: State, l: int) -> None:
        age(s, l)
        if offset:
            refer(s, s.y[l], 0, l)
        linearise(s, l)
        take_inputs(s, l)
        y_hat = regressors(s, predict(s, True, l), l)
        complete = True
        for i in range(n):
            complete = complete & (abs(s.phi[i, l]) < LARGEST)
        shift = y_hat - along(s, l)
        known = (s.usable[l] >= SETTLING * n) & credible(s, shift, 0, l)
        subtract(s, shift if known else 0.0, complete, l)

    return regress  # type: ignore[no-any-return]


@lru_cache
def pushing(p: Places, place: Step, waiting: float = ENTRY) -> Step:
    """``push``; C and D enter after ``waiting`` samples for each parameter."""
    na, n, m, held = p.na, p.n, p.m, place is staying
    at_offset, first_f = p.at_offset, p.nf[0] if p.m == 1 else 0
    first_noise = waiting * n
    linearise, (predict, noise), (colour, whitened) = point(p, place, waiting), predictions(p), filters(p)

    @kernel
    def remember(s: State, y: float, known: bool, v: float, e: float, l: int) -> None:
        s.signals[Y, 0, l], s.signals[V, 0, l], s.signals[E, 0, l] = y, v, e
        s.signals[EF, 0, l], s.signals[VF, 0, l] = whitened(s, E, EF, l), whitened(s, V, VF, l)
        s.signals[YF, 0, l] = filtered(s, colour(s, Y, YF, s.reference[0, l], l), y - s.reference[0, l], 0, l)
        s.signals[Y, 0, l] = y if known else np.nan

    @kernel
    def responding(s: State, y: float, otherwise: float, l: int) -> float:
        """w of one input as the output says: y without its autoregressive part."""
        w = y
        for i in range(na):
            w -= s.theta[i, l] * s.signals[Y, i + 1, l]
        w -= s.theta[at_offset, l] if at_offset >= 0 else 0.0
        return w if credible(s, w, 0, l) else otherwise

    @kernel
    def possible(s: State, fitted: float, l: int) -> float:
        """The fitted value of an output, after responses that contradict it have started again."""
        for j in range(m):
            w = s.signals[OWN + EACH * j + W, 0, l]
            if not credible(s, w, 0, l):
                again = responding(s, s.measured[l], 0.0, l) if first_f > 0 else 0.0
                s.signals[OWN + EACH * j + W, 0, l] = again
                fitted += again - w
        return fitted

    @kernel
    def push(s: State, l: int) -> None:
        observed = s.observed[l] > 0.0
        predicted = informed(s, l)
        # w and e of this sample are those of the theta that has learned from it
        enlarge(s, s.measured[l] if observed else np.nan, 0, l)
        linearise(s, l)
        fitted = predict(s, False, l)
        fitted = possible(s, fitted, l) if observed else fitted
        # a point that is held says what noise is, also before theta is determined, and before the first regressor
        known = (s.valid[l] > 0.0) | (s.started[l] == 0.0) if held else predicted
        e = s.measured[l] - fitted if observed & known else 0.0
        # what is left of an interpolated sample is rounding, and no regressor
        e = e if abs(e) > LEAST_RESIDUAL * (abs(s.measured[l]) + abs(fitted)) else 0.0
        e = within(s, e, l)
        begun = s.usable[l] >= first_noise
        v = within(s, e + noise(s, l), l) if begun else 0.0
        known = observed | (predicted & ((na == 0) | (s.without[l] < na)))
        restore(s, observed, l)
        y = s.measured[l] if observed else s.y_hat[l]
        y = y if observed | credible(s, y, 0, l) else 0.0
        remember(s, y, known, v, e if begun else 0.0, l)
        if (first_f > 0) & (s.usable[l] < SETTLING * n):
            s.signals[OWN + W, 0, l] = responding(s, y, s.signals[OWN + W, 0, l], l)

    return push  # type: ignore[no-any-return]


@lru_cache
def steps(p: Places, held: bool) -> ModelSteps:
    """The compiled steps of a model with these orders, linearised at the last estimate or at a point that is held."""
    gradient, place = gradient_of(p), staying if held else at_theta

    @kernel
    def regressors(s: State, y_hat: float, l: int) -> float:
        gradient(s, l)
        return y_hat

    return ModelSteps(regressing(p, place, regressors), pushing(p, place))
