"""Control from a stream: the next inputs that bring the output to a target, while the parameters are uncertain.

With theta ~ (m_k, P_k) k samples ahead, as the tracker predicts it, and y_k affine in the inputs for every theta,

    J(u)    = sum_k E (y_k(theta, u) - target_k)^2 + effort |u_k - u_(k-1)|^2
    theta_k = m_k +- c sqrt(n) L_k e_i,    L_k L_k' = P_k          2 n points with this mean and covariance

subject to low <= u_k <= high and |u_k - u_(k-1)| <= move. One sample ahead J is exact:

    E (y - target)^2 = (phi' m - target)^2 + c^2 phi' P phi + r

so that c = 0 is certainty equivalence, which takes the estimate for the truth, and c = 1 is cautious control. P_k
contains the drift and the jumps that the tracker expects until then. J is convex and quadratic, |A u - b|^2 with
G u >= h: a problem of least distance, which non-negative least squares solve.

Caution learns little, because it makes inputs small where parameters are uncertain. Dual control learns on purpose. The
first input may differ from the cautious one by d, if that costs at most ``probe`` times the part of J that is due to
the uncertainty of theta; of the two ends of this interval, within the limits, it takes the one after which the next
output that it acts on is the more uncertain, and so tells more.

Source: Astrom and Wittenmark, Adaptive Control (1995), chapter 7 (caution); Filatov and Unbehauen, Survey of adaptive
dual control methods, IEE Proc. Control Theory Appl. 147 (2000) (two criteria); Lawson and Hanson, Solving Least Squares
Problems (1974), chapter 23 (least distance). Departures: the interval of the second criterion is given by its cost,
which has no unit to choose. Cost: O(h n^3 + n (h m)^2 + (h m)^3).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from rich.console import Console, ConsoleOptions, RenderResult

from driftfit.engine.drivers import one_or_all
from driftfit.engine.kernel import Array
from driftfit.engine.settings import numbers
from driftfit.engine.tiles import as_compiled
from driftfit.models.arx import ARX
from driftfit.run.live.live import Live
from driftfit.run.program import state_of
from driftfit.show.text import printing, table_of
from driftfit.use.forecast import future

LIGHT = 1e-8
"""Cost of changing an input, as a share of the curvature of J: one without effect stays as it is."""

SCALINGS, MISSED = 3, 0.01
"""Solutions of a problem of least distance, each in the unit of the one before; the share of a move by which rounding
may miss an input that is given."""


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


class Inputs(NamedTuple):
    """What is known of the inputs before they are chosen."""

    last: Array
    """(m,): the input before; 0 within the limits if it is not known."""
    given: Array
    """(h, m): inputs that are not to be chosen; NaN elsewhere."""
    low: Array
    high: Array
    """(h, m), infinite without limits; an input that is outside returns by its moves."""
    move: Array
    """(m,): largest change, infinite without one."""

    @property
    def held(self) -> Array:
        """(h m,): every input stays as it is."""
        return np.where(np.isfinite(self.given), self.given, self.last).ravel()


def control(
    live: Live, target: Any, horizon: int, limits: Any, *,
    move: Any, effort: float, caution: float, probe: float, u: Any,
) -> Plan:  # fmt: skip
    """See `driftfit.Live.control`."""
    model, tracker = live.model, live.tracker
    if not isinstance(model, ARX) or len(model.outputs) > 1 or not model.m or tracker.slopes:
        raise ValueError(
            "control: needs a stream of an ARX model with inputs and one output, whose parameters have no slopes; "
            f"got {model!r} with {tracker!r}."
        )
    cost, c, share = (
        float(numbers("control", name, one, ndim=0, low=0.0))
        for name, one in (("effort", effort), ("caution", caution), ("probe", probe))
    )
    if c and not tracker.covariance:
        raise ValueError(f"control: {type(tracker).__name__} carries no covariance; give caution=0.")
    given, lane, late = future(model, horizon, u), live.lane(), int(live.awaits)
    goal = np.broadcast_to(np.asarray(numbers("control", "target", target)), horizon)
    inputs = _inputs(limits, move, lane["u_lag"][:, late], given)
    if held := _held(live, lane, late):
        nothing = np.full(horizon, np.nan)
        return Plan(_shaped(inputs.held, model.m), nothing, nothing.copy(), held)
    rest, effect = _responses(model, lane, _points(live, lane, horizon, c), late)
    v = _cheapest(goal - rest, effect, cost, inputs)
    if share:
        for j in np.flatnonzero(np.isnan(given[0])).tolist():
            v[j] = _probing(v, j, share, rest, effect, inputs)
    outputs = rest + effect @ v
    return Plan(_shaped(v, model.m), outputs.mean(axis=0), outputs.std(axis=0))


def _shaped(v: Array, m: int) -> Array:
    return v if m == 1 else v.reshape(-1, m)


def _inputs(limits: Any, move: Any, last: Array, given: Array) -> Inputs:
    """The inputs within limits, after the last (m,), NaN if it is not known."""
    ends = (-np.inf, np.inf) if limits is None else [numbers("control", "limits", one) for one in limits]
    if len(ends) != 2 or not np.all(np.asarray(ends[0]) <= np.asarray(ends[1])):
        raise ValueError(f"control: limits are (low, high), numbers or one for each input; got {limits!r}.")
    most = np.inf if move is None else numbers("control", "move", move, low=0.0, strict=True)
    low, high, step = (np.broadcast_to(np.asarray(one, float), len(last)) for one in (*ends, most))
    last = np.where(np.isfinite(last), last, np.clip(0.0, low, high))
    reach = np.arange(1, len(given) + 1)[:, None] * step
    return Inputs(last, given, np.minimum(low, last + reach), np.maximum(high, last - reach), step)


def _held(live: Live, lane: Any, late: int) -> str:
    """Why nothing can be planned, if so."""
    if not np.isfinite(live.theta).all() or (live.tracker.covariance and not np.isfinite(live.std).all()):
        return "the data do not determine all parameters yet; apply a test signal"
    lags = [
        lane["y_lag"][0, :lag] if what == "y" else lane["u_lag"][j, late:lag] for what, j, lag in live.model.terms or ()
    ]
    return "" if all(np.isfinite(one).all() for one in lags) else "outputs or inputs of the last samples are missing"


def _points(live: Live, lane: Any, h: int, c: float) -> Array:
    """(S, h, n): points with the mean and covariance of theta at the next samples."""
    program = live.programs[0]
    tile = program.resting(lane)
    update, nothing = program.drivers().updater(tile, program.model.m), one_or_all(np.full(program.model.m, np.nan))
    n, lane = program.model.n, state_of(tile)
    found = np.empty((2 * n if c else 1, h, n))
    for k in range(h):
        update(as_compiled(tile), np.nan, nothing)
        found[:, k] = lane["theta"]
        if c:
            values, vectors = np.linalg.eigh(live.tracker.cov(lane))
            off = c * np.sqrt(n * np.maximum(values, 0.0)) * vectors
            found[:n, k] += off.T
            found[n:, k] -= off.T
    return found


def _responses(model: ARX, lane: Any, points: Array, late: int) -> tuple[Array, Array]:
    """Outputs (S, h) without inputs, and their derivatives (S, h, h m) by the inputs, for points (S, h, n) of theta."""
    S, h = points.shape[:2]
    rest, effect = np.zeros((S, h)), np.zeros((S, h, h, model.m))
    for k in range(h):
        for theta, (what, j, lag) in zip(points[:, k].T, model.terms, strict=True):
            past = lag - k - 1
            if what == "1":
                rest[:, k] += theta
            elif what == "y" and past < 0:
                rest[:, k] += theta * rest[:, k - lag]
                effect[:, k] += theta[:, None, None] * effect[:, k - lag]
            elif what == "u" and past < late:
                effect[:, k, late - past - 1, j] += theta
            else:
                rest[:, k] += theta * (lane["y_lag"][0, past] if what == "y" else lane["u_lag"][j, past])
    return rest, effect.reshape(S, h, -1)


def _cheapest(short: Array, effect: Array, cost: float, inputs: Inputs) -> Array:
    """The inputs (h m,) that make J smallest, where ``short`` (S, h) is what the outputs lack without them."""
    v, free = inputs.held, np.isnan(inputs.given).ravel()
    D = np.eye(v.size) - np.eye(v.size, k=-len(inputs.last))
    before = np.zeros(v.size)
    before[: len(inputs.last)] = inputs.last
    A = effect.reshape(-1, v.size)  # a sum over the points; J has a mean
    weight = np.sqrt(len(short) * cost + LIGHT * (float(np.max(np.sum(A**2, axis=0))) or 1.0))
    A, b = np.vstack([A, weight * D]), np.concatenate([short.ravel(), weight * before])
    moves = np.tile(inputs.move, len(inputs.given))
    G = np.vstack([np.eye(v.size), -np.eye(v.size), D, -D])
    h = np.concatenate([inputs.low.ravel(), -inputs.high.ravel(), before - moves, -before - moves])
    b, h = b - A[:, ~free] @ v[~free], h - G[:, ~free] @ v[~free]
    used = np.isfinite(h) & G[:, free].any(axis=1)
    v[free] = _least_distance(A[:, free], b, G[np.ix_(used, free)], h[used])
    return _kept(v.reshape(inputs.given.shape), inputs).ravel()


def _kept(v: Array, inputs: Inputs) -> Array:
    """The inputs (h, m), exactly within limits and moves, which a solution may miss by rounding."""
    before, room = inputs.last, (1.0 + MISSED) * inputs.move
    for k, free in enumerate(np.isnan(inputs.given)):
        low, high = np.maximum(inputs.low[k], before - inputs.move), np.minimum(inputs.high[k], before + inputs.move)
        before_free = free if k == 0 else np.isnan(inputs.given[k - 1])
        if (free & (low > high + MISSED * inputs.move)).any() or (
            ~free & before_free & (k > 0) & (np.abs(v[k] - before) > room)
        ).any():
            raise ValueError("control: the inputs given as u= leave none within the limits and moves.")
        v[k] = np.where(free, np.clip(v[k], low, high), v[k])
        before = v[k]
    return v


def _least_distance(A: Array, b: Array, G: Array, h: Array) -> Array:
    """The x for which |A x - b| is smallest, subject to G x >= h; A has full column rank."""
    from scipy.optimize import nnls  # with others a third of the time of importing the package

    Q, R = np.linalg.qr(A)
    x = np.linalg.solve(R, Q.T @ b)
    if (G @ x >= h).all():
        return x
    rows = np.linalg.solve(R.T, G.T).T  # z = R x - Q' b:  rows z >= short, |z| as small as possible
    short = h - G @ x
    size = np.linalg.norm(rows, axis=1)
    rows, short = rows / size[:, None], short / size
    distance, z = float(np.max(short)), np.zeros(len(x))
    for _ in range(SCALINGS):  # digits are lost unless |z| is about 1 in the unit of the problem
        E = np.vstack([rows.T, short / distance])
        r = E @ nnls(E, np.eye(len(E))[-1], maxiter=100 * len(h))[0] - np.eye(len(E))[-1]
        if not -r[-1] > 0.0:
            break
        z = -distance * r[:-1] / r[-1]
        distance = max(float(np.linalg.norm(z)), distance)
    return np.asarray(x + np.linalg.solve(R, z))


def _probing(v: Array, j: int, share: float, rest: Array, effect: Array, inputs: Inputs) -> float:
    """The first value of input j, moved to where it tells more."""
    outputs, by = rest + effect @ v, effect[:, :, j]
    acts = np.flatnonzero(by.any(axis=0))
    if not len(acts):
        return float(v[j])
    d = np.sqrt(share * outputs.var(axis=0).sum() / np.sum(np.mean(by**2, axis=0)))
    last, step = inputs.last[j], inputs.move[j]
    ends = max(inputs.low[0, j], last - step), min(inputs.high[0, j], last + step)
    around = [float(np.clip(v[j] + off, *ends)) for off in (-d, d)]
    told = [np.var(outputs[:, acts[0]] + by[:, acts[0]] * (one - v[j])) for one in around]
    return around[int(np.argmax(told))]
