"""Tuning for several outputs: each output separately, or all rows of a shared theta together.

Outputs with a separate theta have separate noise, so each gets its own settings: `TunedOutputs.tracker` maps the name
of an output to its tracker, in the form that `track` and `Live` take. Regressors are those of constant parameters,
whose predictions also fill missing lags.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from rich.console import Console, ConsoleOptions, RenderResult
from rich.text import Text

from driftfit.data.record import Reading
from driftfit.models.base import Model
from driftfit.run.fleet import Fleet
from driftfit.run.outputs import Outputs
from driftfit.run.result import Track
from driftfit.run.shared_outputs import Shared
from driftfit.run.track import track
from driftfit.show.parts.text import Printed
from driftfit.trackers.base import Tracker
from driftfit.trackers.kalman import Kalman
from driftfit.tune.lanes import Task
from driftfit.tune.tuned import Tuned

STILL = Kalman(q=0.0, r=1.0)
"""Constant parameters with a diffuse start."""


class TunedOutputs(Mapping[str, Tuned], Printed):
    """The result of `tune` for a model with several outputs: one `driftfit.tune.tuned.Tuned` for each."""

    def __init__(self, each: Mapping[str, Tuned]) -> None:
        self._each = dict(each)

    def __getitem__(self, output: str) -> Tuned:
        return self._each[output]

    def __iter__(self) -> Iterator[str]:
        return iter(self._each)

    def __len__(self) -> int:
        return len(self._each)

    def __repr__(self) -> str:
        return f"TunedOutputs({', '.join(f'{name}: {one.tracker!r}' for name, one in self.items())})"

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        for place, (name, one) in enumerate(self.items()):
            yield Text(f"\n{name}" if place else name, "bold")
            yield one

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
    model: Model, tracker: Any, y: Any, u: Any, known: Mapping[str, Any], data: Any, by: Any,
    one: Callable[[Task], Tuned],
) -> Tuned | TunedOutputs:  # fmt: skip
    """Tune every output with ``one(task)``, or the rows of a shared theta at once."""
    if not isinstance(tracker, Tracker):
        raise ValueError(f"tune: several outputs are tuned for one kind of tracker; got {tracker!r}.")
    run = track(model, STILL, y, u, Reading(**known), data=data, by=by)
    if isinstance(run, Shared):
        return one(Task(run.rows.model, (run.rows.record,)))
    if model.shared:
        assert isinstance(run, Fleet)
        return one(_together(list(run.values())))
    assert isinstance(run, Outputs | Fleet)
    lanes = list(run.values())
    names = run.outputs if isinstance(run, Outputs) else run.records.outputs
    return TunedOutputs({name: one(_together(lanes[k :: len(names)])) for k, name in enumerate(names)})


def _together(runs: Sequence[Track]) -> Task:
    """The records of some runs with one model."""
    return Task(runs[0].model, tuple(run.record for run in runs))
