"""Streams with their verbs: `driftfit.Live` for users."""

from __future__ import annotations

from typing import Any

from driftfit.bank.results.live_results import LiveHypotheses
from driftfit.models.hammerstein_wiener.blocks import separated
from driftfit.models.hammerstein_wiener.separation import Groups
from driftfit.run.live import live
from driftfit.use.constrained import Constrained, constrain
from driftfit.use.control import Plan, control
from driftfit.use.forecast import Forecast, forecast_stream
from driftfit.use.system import LiveSystem


class Live(live.Live, public=True):
    __doc__ = live.Live.__doc__

    @property
    def hypotheses(self) -> LiveHypotheses:
        """The events of a `Bank` now: probabilities, events as they are decided, the mixture for control."""
        return LiveHypotheses(self)

    def blocks(self, method: str = "svd-joint") -> Groups:
        """a, b, c, d of a `HammersteinWiener` model now; ``method`` as in `Track.blocks`, except "gls"."""
        return separated(self.model, self.names, self.theta, method)

    def forecast(self, h: int, u: Any = None) -> Forecast:
        """theta and y at the next h nominal samples, as `Track.forecast`; u (h,) or (h, m) are the future inputs.

        Of several outputs theta and std are (h, ny, n), y_hat and y_std (h, ny). While `apply` is
        outstanding the first row of u is the input that it would receive.
        """
        return forecast_stream(self, h, u)

    def control(
        self, target: Any, horizon: int = 10, limits: Any = None, *, move: Any = None, effort: float = 0.0,
        caution: float = 1.0, probe: float = 0.0, u: Any = None,
    ) -> Plan:  # fmt: skip
        """The next inputs that bring the output of an `ARX` model to a target; see `driftfit.use.control`.

        Parameters
        ----------
        target : number or (horizon,)
            The outputs that are wanted at the next samples.
        horizon : int
            Samples ahead; longer than the delays of the inputs.
        limits : (low, high) or None
            Of the inputs, each a number or one for every input.
        move : number, (m,) or None
            Largest change of an input in a sample.
        effort : number
            Cost of a squared change of an input, where a squared error of the output costs 1.
        caution : number
            Factor of the standard deviations of theta: 0 is certainty equivalence, 1 cautious control.
        probe : number
            How much the first input may cost for what it teaches, as a share of the cost of the uncertainty of theta.
        u : (horizon, m) or None
            Inputs that are known, NaN where they are to be chosen; None: all are chosen.

        The first of the inputs is that which `apply` expects, or else that of the next sample. Where nothing can be
        planned yet the inputs stay as they are, and ``held`` says why.

        Raises
        ------
        ValueError
            For another model, a tracker without a covariance unless caution is 0, or limits that cannot be kept.
        """
        return control(self, target, horizon, limits, move=move, effort=effort, caution=caution, probe=probe, u=u)

    def constrain(self, *constraints: str) -> Constrained:
        """The present theta within constraints, as `Track.constrain`, with T = 1."""
        return constrain(self, *constraints)

    @property
    def system(self) -> LiveSystem:
        """The present `ARX` system: poles, gains, responses with bands; see `driftfit.use.system`."""
        return LiveSystem(self)
