"""Control from a stream: the next inputs that bring the output to a target, while the parameters are uncertain.

With theta ~ (m_k, P_k) k samples ahead, as the tracker predicts it, and y_k affine in the inputs for every theta,

    J(u)    = sum_k E (y_k(theta, u) - target_k)^2 + effort |u_k - u_(k-1)|^2
    theta_k = m_k +- c sqrt(n) L_k e_i,    P_k = L_k L_k'      2 n points with this mean and covariance

subject to low <= u_k <= high and |u_k - u_(k-1)| <= move, with L_k the Cholesky factor. One sample ahead J is exact:

    E (y - target)^2 = (phi' m - target)^2 + c^2 phi' P phi + r

so that c = 0 is certainty equivalence, which takes the estimate for the truth, and c = 1 is cautious control. P_k
contains the drift and the jumps that the tracker expects until then.

J is convex and quadratic. From inputs that keep all limits it is minimised by coordinate descent: every run u_k .. u_e
of an input moves, all by the same amount, to where J is least within limits and moves, by turns until none moves any
more. The minimum is the only point from which no run leads down, because the directions that limits of inputs and of
their moves leave open are sums of runs. The number of sweeps is bounded, and what they have reached can be applied.

Caution learns little, because it makes inputs small where parameters are uncertain. Dual control learns on purpose. The
first input may differ from the cautious one by d, if that costs at most ``probe`` times the part of J that is due to
the uncertainty of theta; of the two ends of this interval, within the limits, it takes the one after which the next
output that it acts on is the more uncertain, and so tells more.

Source: Astrom and Wittenmark, Adaptive Control (1995), chapter 7 (caution); Filatov and Unbehauen, Survey of adaptive
dual control methods, IEE Proc. Control Theory Appl. 147 (2000) (two criteria). Departures: runs take the place of
single coordinates, at which limits of moves would stop a descent; the interval of the second criterion is given by its
cost, which has no unit to choose. Cost: O(h n^3 + n (h m)^2), and O(h^3 m^2) for each sweep. `plan` is translated to
C (`driftfit.embedded.export_c`), which gives the same bits.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from rich.console import Console, ConsoleOptions, RenderResult

from driftfit.engine.drivers import ROUNDING, one_or_all
from driftfit.engine.kernel import Array, Driver, State, shared
from driftfit.engine.settings import numbers
from driftfit.engine.tiles import as_compiled
from driftfit.models.arx import ARX
from driftfit.run.live.live import Live
from driftfit.run.program import state_of
from driftfit.show.text import printing, table_of
from driftfit.use.forecast import future

OUTPUT, INPUT = 1, 2
"""Kinds of regressors; 0: a constant."""

LIGHT = 1e-8
"""Cost of changing an input, as a share of the curvature of J: one without effect stays as it is."""

SWEEPS, NEAR = 200, 1e-6
"""Sweeps at most, and the share of an input or of its largest move that does not matter. Of 120 random problems 116
came within 1e-6 of the least J, after 23 sweeps on average; the others lacked at most 0.1 % of what J had been before.
"""


def room(model: ARX, tracker: Any, h: int) -> dict[str, tuple[int, ...]]:
    """What `plan` works in: results and working arrays, with their shapes."""
    S, m = 2 * model.n if tracker.covariance else 1, model.m
    return {
        "u": (h, m), "y_hat": (h,), "theta_std": (h,), "points": (S, h, model.n), "rest": (S, h),
        "effect": (S, h, h, m), "outputs": (S, h), "last": (m,), "least": (h, m), "most": (h, m), "slope": (h, m),
        "column": (h, m), "H": (h, m, h, m),
    }  # fmt: skip


def terms_of(model: ARX) -> Array:
    """(n, 3): which signal every regressor is (`OUTPUT`, `INPUT` or none), its number, and its lag."""
    return np.array([("1yu".index(what), j, lag) for what, j, lag in model.terms])


@shared
def points_around(theta: Array, P: Array, c: float, k: int, points: Array) -> None:
    """theta +- c sqrt(n) L e_i at sample k; the lower triangle of P becomes L, 0 in columns where P is semidefinite.

    Theta alone where there is room for one point.
    """
    n = theta.shape[0]
    for p in range(points.shape[0]):
        for i in range(n):
            points[p, k, i] = theta[i]
    for j in range(n if points.shape[0] > 1 else 0):
        least = ROUNDING * P[j, j]
        for i in range(j, n):
            for q in range(j):
                P[i, j] -= P[i, q] * P[j, q]
        scale = 0.0 if P[j, j] <= least else 1.0 / np.sqrt(P[j, j])
        for i in range(j, n):
            P[i, j] *= scale
            points[j, k, i] += c * np.sqrt(n) * P[i, j]
            points[n + j, k, i] -= c * np.sqrt(n) * P[i, j]


@Driver
def spread(theta: Array, P: Array, c: float, k: int, points: Array) -> None:
    """`points_around`, for Python."""
    points_around(theta, P, c, k, points)


def spread_of_state(s: State, P: Array, c: float, k: int, points: Array) -> None:
    """`points_around`, for C: from the state itself, with the covariance of `driftfit.trackers.base.Tracker.cov`."""
    if points.shape[0] > 1:
        for i in range(P.shape[0]):
            for j in range(i):
                P[i, j] = s.P[i, j, 0] * s.scale[0]
            P[i, i] = s.var[i, 0]
    points_around(s.theta[:, 0], P, c, k, points)


@shared
def respond(points: Array, terms: Array, y_lag: Array, u_lag: Array, late: int, rest: Array, effect: Array) -> bool:
    """Outputs without inputs and their derivatives by the inputs; returns whether they are known."""
    known = True
    for p in range(points.shape[0]):
        for k in range(points.shape[1]):
            rest[p, k] = 0.0
            for e in range(points.shape[1]):
                for j in range(effect.shape[3]):
                    effect[p, k, e, j] = 0.0
            for i in range(points.shape[2]):
                theta, what, source, lag = points[p, k, i], terms[i, 0], terms[i, 1], terms[i, 2]
                past = lag - k - 1
                if what == OUTPUT and past < 0:
                    rest[p, k] += theta * rest[p, k - lag]
                    for e in range(k):
                        for j in range(effect.shape[3]):
                            effect[p, k, e, j] += theta * effect[p, k - lag, e, j]
                elif what == INPUT and past < late:
                    effect[p, k, late - past - 1, source] += theta
                elif what == OUTPUT:
                    rest[p, k] += theta * y_lag[0, past]
                elif what == INPUT:
                    rest[p, k] += theta * u_lag[source, past]
                else:
                    rest[p, k] += theta
            known = known and abs(rest[p, k]) < np.inf
    return known


@shared
def outcome(rest: Array, effect: Array, v: Array, outputs: Array) -> None:
    """Outputs with the inputs v."""
    for p in range(rest.shape[0]):
        for k in range(rest.shape[1]):
            outputs[p, k] = rest[p, k]
            for e in range(k + 1):
                for j in range(v.shape[1]):
                    outputs[p, k] += effect[p, k, e, j] * v[e, j]


@shared
def moments(outputs: Array, effect: Array, k: int, j: int, more: float) -> tuple[float, float]:
    """Mean and variance over the points of the output at sample k, with so much more of the first value of input j."""
    S, mean, variance = outputs.shape[0], 0.0, 0.0
    for p in range(S):
        mean += (outputs[p, k] + effect[p, k, 0, j] * more) / S
    for p in range(S):
        variance += (outputs[p, k] + effect[p, k, 0, j] * more - mean) ** 2 / S
    return mean, variance


@shared
def start_within(
    given: Array, last: Array, lower: Array, upper: Array, move: Array, least: Array, most: Array, v: Array
) -> bool:
    """Inputs v that keep limits and moves, near the last; returns whether there are any.

    ``least`` and ``most`` are the limits, within which the inputs that are given can be reached; both are those where
    one is given. After an input that is outside, they are as far as it has come back.
    """
    h, possible = v.shape[0], True
    for j in range(v.shape[1]):
        for k in range(h - 1, -1, -1):
            if abs(given[k, j]) < np.inf:
                least[k, j], most[k, j] = given[k, j], given[k, j]
            else:
                reach = (k + 1) * move[j]
                least[k, j], most[k, j] = min(lower[j], last[j] + reach), max(upper[j], last[j] - reach)
                if k < h - 1:
                    least[k, j] = max(least[k, j], least[k + 1, j] - move[j])
                    most[k, j] = min(most[k, j], most[k + 1, j] + move[j])
        for k in range(h):
            v[k, j] = given[k, j]
            if not abs(given[k, j]) < np.inf:
                before = last[j] if k == 0 else v[k - 1, j]
                low, high = max(least[k, j], before - move[j]), min(most[k, j], before + move[j])
                possible = possible and not low - high > NEAR * move[j]
                v[k, j] = min(max(before, low), high)
    return possible


@shared
def curvature(
    effect: Array, outputs: Array, target: Array, last: Array, effort: float, v: Array, slope: Array, H: Array
) -> None:
    """H and the slope of J / 2 at v, for the sum over the points."""
    S, h, m, dearest = outputs.shape[0], v.shape[0], v.shape[1], 0.0
    for e in range(h):
        for j in range(m):
            slope[e, j] = 0.0
            for f in range(h):
                for i in range(m):
                    H[e, j, f, i] = 0.0
            for p in range(S):
                for k in range(e, h):
                    slope[e, j] += effect[p, k, e, j] * (outputs[p, k] - target[k])
                    for f in range(k + 1):
                        for i in range(m):
                            H[e, j, f, i] += effect[p, k, e, j] * effect[p, k, f, i]
            dearest = max(dearest, H[e, j, e, j])
    weight = S * effort + LIGHT * (dearest if dearest > 0.0 else 1.0)
    for e in range(h):
        for j in range(m):
            change = weight * (v[e, j] - (last[j] if e == 0 else v[e - 1, j]))
            slope[e, j] += change
            H[e, j, e, j] += weight
            if e > 0:
                slope[e - 1, j] -= change
                H[e - 1, j, e - 1, j] += weight
                H[e - 1, j, e, j] -= weight
                H[e, j, e - 1, j] -= weight


@shared
def sweep(
    H: Array, slope: Array, column: Array, last: Array, move: Array, least: Array, most: Array, v: Array
) -> float:
    """Move every run of an input to where J is least; returns the largest movement. ``column``: H times the run."""
    h, m, largest = v.shape[0], v.shape[1], 0.0
    for j in range(m):
        for k in range(h):
            curve, gradient, down, up = 0.0, 0.0, -np.inf, np.inf
            for q in range(h):
                for i in range(m):
                    column[q, i] = 0.0
            for e in range(k, h):
                if least[e, j] == most[e, j]:
                    break
                before = last[j] if k == 0 else v[k - 1, j]
                gradient += slope[e, j]
                curve += 2.0 * column[e, j] + H[e, j, e, j]
                for q in range(h):
                    for i in range(m):
                        column[q, i] += H[q, i, e, j]
                down, up = max(down, least[e, j] - v[e, j]), min(up, most[e, j] - v[e, j])
                low, high = max(down, before - move[j] - v[k, j]), min(up, before + move[j] - v[k, j])
                if e < h - 1:
                    low = max(low, v[e + 1, j] - move[j] - v[e, j])
                    high = min(high, v[e + 1, j] + move[j] - v[e, j])
                step = min(max(-gradient / curve, low), high)
                for f in range(k, e + 1):
                    v[f, j] += step
                for q in range(h):
                    for i in range(m):
                        slope[q, i] += step * column[q, i]
                gradient += step * curve
                down -= step
                up -= step
                largest = max(largest, abs(step))
    return largest


@shared
def probing(probe: float, effect: Array, outputs: Array, low: float, high: float, j: int, v: float) -> float:
    """The first value v of input j, moved to where it tells more, between low and high."""
    S, h = outputs.shape
    uncertain, power, acts = 0.0, 0.0, -1
    for k in range(h - 1, -1, -1):
        uncertain += moments(outputs, effect, k, j, 0.0)[1]
        for p in range(S):
            power += effect[p, k, 0, j] ** 2 / S
            acts = k if effect[p, k, 0, j] != 0.0 else acts
    if acts < 0:
        return v
    d = np.sqrt(probe * uncertain / power)
    less, more = min(max(v - d, low), high), min(max(v + d, low), high)
    told = moments(outputs, effect, acts, j, more - v)[1] > moments(outputs, effect, acts, j, less - v)[1]
    return float(more if told else less)


@Driver
def plan(terms: Array, lags: Any, late: int, wanted: Any, limits: Any, effort: float, probe: float, work: Any) -> int:
    """Inputs v (h, m) from points of theta. ``lags`` are those of outputs and inputs, ``wanted`` outputs (h,) and the
    inputs that are given (h, m), ``limits`` the lowest and highest inputs and their largest move (m,); see `room` for
    ``work``, and `HELD` of `control` for what is returned.
    """
    y_lag, u_lag = lags
    target, given = wanted
    lower, upper, move = limits
    v, y_hat, theta_std, points, rest, effect, outputs, last, least, most, slope, column, H = work
    h, m = v.shape
    for j in range(m):
        one = u_lag[j, late]
        last[j] = one if abs(one) < np.inf else min(max(0.0, lower[j]), upper[j])
        for k in range(h):
            v[k, j] = given[k, j] if abs(given[k, j]) < np.inf else last[j]
    for k in range(h):
        y_hat[k], theta_std[k] = np.nan, np.nan
    for p in range(points.shape[0]):
        for i in range(points.shape[2]):
            if not abs(points[p, h - 1, i]) < np.inf:
                return 1
    if not respond(points, terms, y_lag, u_lag, late, rest, effect):
        return 2
    if not start_within(given, last, lower, upper, move, least, most, v):
        return 3
    outcome(rest, effect, v, outputs)
    curvature(effect, outputs, target, last, effort, v, slope, H)
    for _turn in range(SWEEPS):
        largest = 0.0
        moved = sweep(H, slope, column, last, move, least, most, v)
        for k in range(h):
            for j in range(m):
                largest = max(largest, abs(v[k, j]))
        if moved <= NEAR * largest:
            break
    for j in range(m):
        outcome(rest, effect, v, outputs)
        if probe > 0.0 and least[0, j] < most[0, j]:
            low, high = max(least[0, j], last[j] - move[j]), min(most[0, j], last[j] + move[j])
            v[0, j] = probing(probe, effect, outputs, low, high, j, v[0, j])
    outcome(rest, effect, v, outputs)
    for k in range(h):
        mean, variance = moments(outputs, effect, k, 0, 0.0)
        y_hat[k], theta_std[k] = mean, np.sqrt(variance)
    return 0


HELD = (
    "",
    "the data do not determine all parameters yet; apply a test signal",
    "outputs or inputs of the last samples are missing",
)
"""What `plan` returns, as text; after these, that the inputs that are given leave none within the limits."""


@printing
class Plan(NamedTuple):
    """Inputs for the next samples, and the outputs that they are expected to cause."""

    u: Array
    """(h,) or (h, m): apply the first, and plan again at the next sample."""
    y_hat: Array
    """(h,): expected outputs."""
    theta_std: Array
    """(h,): their standard deviation due to theta, times the caution; `Live.forecast` adds that due to noise."""
    held: str = ""
    """Why the inputs stay as they are, if nothing can be planned."""

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        inputs = self.u.reshape(len(self.u), -1)
        heads = ["u"] if inputs.shape[1] == 1 else [f"u{j + 1}" for j in range(inputs.shape[1])]
        table = table_of(f"Plan for {len(inputs)} samples", "ahead", *heads, "y", "+-")
        for k, (row, y, std) in enumerate(zip(inputs, self.y_hat, self.theta_std, strict=True)):
            table.add_row(str(k + 1), *(f"{one:.4g}" for one in row), f"{y:.4g}", f"{std:.2g}")
        yield table
        if self.held:
            yield f" The inputs are held: {self.held}."


def check_plannable(owner: str, model: Any, tracker: Any) -> None:
    """Refuse a model or tracker from which no inputs can be planned."""
    if not isinstance(model, ARX) or len(model.outputs) > 1 or not model.m or tracker.slopes:
        raise ValueError(
            f"{owner}: needs a stream of an ARX model with inputs and one output, whose parameters have no slopes; "
            f"got {model!r} with {tracker!r}."
        )


def control(
    live: Live, target: Any, horizon: int, limits: Any, *,
    move: Any, effort: float, caution: float, probe: float, u: Any,
) -> Plan:  # fmt: skip
    """See `driftfit.Live.control`."""
    model, tracker = live.model, live.tracker
    check_plannable("control", model, tracker)
    assert isinstance(model, ARX)
    cost, c, share = (
        float(numbers("control", name, one, ndim=0, low=0.0))
        for name, one in (("effort", effort), ("caution", caution), ("probe", probe))
    )
    if c and not tracker.covariance:
        raise ValueError(f"control: {type(tracker).__name__} carries no covariance; give caution=0.")
    given, lane, late = future(model, horizon, u), live.lane(), int(live.awaits)
    goal = np.broadcast_to(np.asarray(numbers("control", "target", target)), horizon)
    ends = (-np.inf, np.inf) if limits is None else [numbers("control", "limits", one) for one in limits]
    if len(ends) != 2 or not np.all(np.asarray(ends[0]) <= np.asarray(ends[1])):
        raise ValueError(f"control: limits are (low, high), numbers or one for each input; got {limits!r}.")
    most = np.inf if move is None else numbers("control", "move", move, low=0.0, strict=True)
    low, high, step = (np.array(np.broadcast_to(np.asarray(one, float), model.m)) for one in (*ends, most))
    work = {name: np.zeros(shape) for name, shape in room(model, tracker, horizon).items()}
    program = live.programs[0]
    tile = program.resting(lane)
    update, nothing = program.drivers().updater(tile, program.model.m), one_or_all(np.full(program.model.m, np.nan))
    ahead = state_of(tile)
    for k in range(horizon):  # theta at the next samples
        update(as_compiled(tile), np.nan, nothing)
        spread(ahead["theta"], tracker.cov(ahead), c, k, work["points"])
    wanted = np.array(goal, float), np.array(given, float)
    lags = lane["y_lag"], lane["u_lag"]
    why = plan(terms_of(model), lags, late, wanted, (low, high, step), cost, share, tuple(work.values()))
    if why == len(HELD):
        raise ValueError("control: the inputs given as u= leave none within the limits and moves.")
    chosen = work["u"]
    return Plan(chosen[:, 0] if model.m == 1 else chosen, work["y_hat"], work["theta_std"], HELD[why])
