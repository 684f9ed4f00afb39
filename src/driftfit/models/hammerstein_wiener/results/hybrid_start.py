"""Hybrid start: stage one until the record has excited every product, then a filter on the minimal parameters.

Stage one finds the basin of attraction from any initial value; within it the extended Kalman and output-error filters
are more accurate. The second filter starts from the separation by generalised least squares, with its covariance, with
the lags of the model, and at the time when the first one ended.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from rich.text import Text

from driftfit.data.arguments import as_inputs, as_output
from driftfit.data.record import Known, Record
from driftfit.engine.kernel import Array
from driftfit.engine.settings import whole
from driftfit.models.hammerstein_wiener.model import HammersteinWiener
from driftfit.models.hammerstein_wiener.results.diagnostics import LEAST, excitation_of
from driftfit.models.hammerstein_wiener.results.run_blocks import WEAK, blocks_of
from driftfit.models.hammerstein_wiener.step_memory import MINIMAL
from driftfit.models.hammerstein_wiener.trackers.extended_kalman import ExtendedKalman
from driftfit.models.hammerstein_wiener.trackers.output_error import OutputError
from driftfit.run.program import Program
from driftfit.run.result import Track, track_record
from driftfit.run.track import track_one
from driftfit.show.text import digits, facts, printed, table_of
from driftfit.smooth.problem import replay
from driftfit.trackers.base import Tracker


@dataclass(frozen=True, repr=False)
class HandOff:
    """``first``, the run of stage one until sample ``at``, and ``then``, that of the second filter after it."""

    first: Track
    then: Track
    at: int

    def __repr__(self) -> str:
        """Both runs, and the last estimates of the second."""
        table = table_of("Parameters after the last sample", "", "theta", "std")
        for name, value, std in zip(self.then.names, self.then.theta[-1], self.then.std[-1], strict=True):
            table.add_row(Text(name), digits(value, std), f"{std:.4g}")
        runs = facts(("First", f"{self.first!r}, until sample {self.at}"), ("Then", repr(self.then)))
        return printed(runs, table).strip("\n")

    @property
    def xi(self) -> Array:
        """The minimal parameters over the whole record, (T, n_x): separated, then filtered."""
        return np.concatenate([blocks_of(self.first, "gls").xi, self.then.theta])


def hand_off(
    model: HammersteinWiener, first: Tracker, then: ExtendedKalman | OutputError, y: Any, u: Any, *,
    at: int | None = None, widen: float = 1.0, limit: float = LEAST,
) -> HandOff:  # fmt: skip
    """Track a record with ``first`` on the products and hand over to ``then``.

    Parameters
    ----------
    model : HammersteinWiener
    first : Tracker with a covariance
        Such as `Kalman`.
    then : ExtendedKalman or OutputError
        Its theta0 and p0 are replaced by the separation and ``widen`` times its covariance.
    y, u : (T,), and (T,) or (T, m)
    at : int or None
        The last sample of stage one. None: the first at which a window of 3 n samples excites every product, its
        scaled Gram matrix having no eigenvalue below ``limit``.

    Raises
    ------
    ValueError
        If the record never excites every product, or the covariance is not finite there.
    """
    output, inputs = as_output(y), as_inputs(u, len(as_output(y)))
    last = _sufficient(model, first, output, inputs, limit) if at is None else whole("hand_off", "at", at, 1)
    if not last < len(output) - 1:
        raise ValueError(f"hand_off: at={last} leaves none of the {len(output)} samples for the second filter.")
    before = track_one(model, first, output[: last + 1], inputs[: last + 1])
    found = blocks_of(before, "gls")
    assert found.cov is not None
    bound = before.model
    head = min(abs(found.of_input(i)[1][-1, 0]) for i in range(bound.m))
    if head < WEAK:
        raise ValueError(
            f"hand_off: {type(then).__name__} has c_1 = 1, but with |c| = 1 the curve has c_1 = {head:.1g}; order the "
            "functions of the input block so that the first matters."
        )
    if not np.isfinite(found.cov[-1]).all():
        raise ValueError(f"hand_off: the covariance of stage one is not finite at sample {last}; hand over later.")
    cov = found.xi_cov
    assert cov is not None
    P = widen * 0.5 * (cov[-1] + cov[-1].T)
    tracker = replace(then, theta0=found.xi[-1], p0=P)
    ends, own = before.state, tracker.state_for(bound)
    lags = {name: ends[name] for name in bound.memory() if name not in own}
    blocks = np.array(ends["blocks"])
    blocks[MINIMAL] = 1.0
    start = {**lags, "blocks": blocks}
    rest = Record(output[last + 1 :], inputs[last + 1 :], Known.of())
    return HandOff(before, track_record(Program(bound, tracker), rest, start=start), last)


def _sufficient(model: HammersteinWiener, first: Tracker, y: Array, u: Array, limit: float) -> int:
    """The first sample at which a window of 3 n samples has excited every product."""
    n = model.n
    for T in (20 * n, len(y)):  # most records are excited early
        run = track_one(model, first, y[:T], u[:T])
        replayed = replay(run)
        phi = np.where(replayed["ok"][:, :1] > 0.0, replayed["phi"][..., 0], 0.0)
        at = np.arange(3 * n, len(run))
        found = np.flatnonzero(excitation_of(phi, at, 3 * n, limit)[0] > limit)
        if found.size:
            return int(at[found[0]])
    raise ValueError(
        f"hand_off: no window of {3 * n} samples excites all {n} products; see diagnose_blocks(run).dull(), or pass "
        "at=."
    )
