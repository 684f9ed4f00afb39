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
cost, which has no unit to choose. Cost: O(h n^3 + n (h m)^2), and O(h^3 m^2) for each sweep. `planning` is translated
to C (`driftfit.embedded.export_c`), which gives the same bits.
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
from driftfit.use.planning import plan, room, spread, terms_of

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
