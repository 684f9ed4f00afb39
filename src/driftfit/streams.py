"""Streams with their verbs: `driftfit.Live` for users."""

from __future__ import annotations

from typing import Any

from driftfit.bank.results.live_results import LiveHypotheses
from driftfit.models.hammerstein_wiener.blocks import separated
from driftfit.models.hammerstein_wiener.separation import Groups
from driftfit.run.live import live
from driftfit.use.constrained import Constrained, constrain
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

    def constrain(self, *constraints: str) -> Constrained:
        """The present theta within constraints, as `Track.constrain`, with T = 1."""
        return constrain(self, *constraints)

    @property
    def system(self) -> LiveSystem:
        """The present `ARX` system: poles, gains, responses with bands; see `driftfit.use.system`."""
        return LiveSystem(self)
