"""What can be asked of a run once it is there; `Track` inherits these."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

if TYPE_CHECKING:
    from driftfit.diagnose import Diagnosis
    from driftfit.result import Track
    from driftfit.verdict import Verdict


class Judged:
    """Questions to a run. Each is a module of its own, imported when it is asked."""

    def verdict(self, level: float = 0.05, lags: int = 0) -> Verdict:
        """Is the time variation real, which parameters move, and does following them pay? See `driftfit.verdict`."""
        from driftfit.verdict import verdict

        return verdict(cast("Track", self), level, lags)

    def diagnose(self) -> Diagnosis:
        """Whiteness, noise level, distribution, excitation, constancy, with limits; see `driftfit.diagnose`."""
        from driftfit.diagnose import diagnose

        return diagnose(cast("Track", self))
