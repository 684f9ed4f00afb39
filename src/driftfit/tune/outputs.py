"""Tuning for several outputs: each output separately, or all rows of a shared theta together.

Outputs with a separate theta have separate noise, so each gets its own settings: `TunedOutputs.tracker` maps the name
of an output to its tracker, in the form that `track` and `Live` take. Regressors are those of constant parameters,
whose predictions also fill missing lags.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from driftfit.data.record import Reading
from driftfit.judge.constant_fit import constant_outputs
from driftfit.models.base import Model
from driftfit.show.parts.by_output import ByOutput
from driftfit.trackers.base import Tracker
from driftfit.tune.lanes import Task
from driftfit.tune.tuned import Tuned


class TunedOutputs(ByOutput[Tuned]):
    """The result of `tune` for a model with several outputs: one `driftfit.tune.tuned.Tuned` for each."""

    def __repr__(self) -> str:
        return f"TunedOutputs({', '.join(f'{name}: {one.tracker!r}' for name, one in self.items())})"

    @property
    def tracker(self) -> dict[str, Tracker]:
        """The tracker of each output, by name, ready for `track` and `Live`."""
        return {name: one.tracker for name, one in self.items()}

    @property
    def loglik(self) -> float:
        """Sum over the outputs."""
        return sum(one.loglik for one in self.values())

    @property
    def at_bound(self) -> dict[str, tuple[str, ...]]:
        """Settings that ended at a bound of the search, by output."""
        return {name: one.at_bound for name, one in self.items() if one.at_bound}


def tune_outputs(
    model: Model, tracker: Any, y: Any, u: Any, reading: Reading, data: Any, by: Any,
    one: Callable[[Task], Tuned],
) -> Tuned | TunedOutputs:  # fmt: skip
    """Tune every output with ``one(task)``, or the rows of a shared theta at once."""
    if not isinstance(tracker, Tracker):
        raise ValueError(f"tune: several outputs are tuned for one kind of tracker; got {tracker!r}.")
    runs = constant_outputs(model, y, u, reading, data, by)
    tuned = {name: one(Task(some[0].model, tuple(run.record for run in some))) for name, some in runs.items()}
    return tuned["rows"] if model.shared else TunedOutputs(tuned)
