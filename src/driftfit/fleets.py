"""Many results with their verbs: fleets and records of several outputs."""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Mapping
from os import PathLike
from typing import TYPE_CHECKING, Any

from driftfit.engine.kernel import Array
from driftfit.judge.alarms.fleet_alarms import ManyAlarms, alarms
from driftfit.judge.fleet_verdict import ManyDiagnoses, ManyVerdicts, diagnoses, verdicts
from driftfit.judge.joint_noise import JointNoise
from driftfit.judge.on_all_cores import on_all_cores
from driftfit.readings.left_out import LeftOut
from driftfit.results import Exported, Track
from driftfit.run import fleet, result
from driftfit.show.plots import plot_fleet, plot_outputs
from driftfit.show.report import page_of_many, written
from driftfit.show.summary import FleetSummary, Summary, summarise_fleet, summarise_outputs
from driftfit.show.text import ByOutput
from driftfit.smooth.smoothed import Smoothed
from driftfit.use.crossing import crossings
from driftfit.use.forecast import Forecast, forecast_outputs

if TYPE_CHECKING:
    import polars
    from matplotlib.figure import Figure


def smoothed_path(run: Track) -> tuple[Array, Array]:
    """theta and std of a run from its complete record, (T, n) each."""
    found = run.smooth()
    return found.theta, found.std


class Judged(fleet.KeyedResults, Exported):
    """Verbs of results by key; see `driftfit.judge.fleet_verdict`."""

    def values(self) -> Iterator[Track]:
        """The results."""
        return map(_public, super().values())

    def items(self) -> Iterator[tuple[Hashable, Track]]:
        """Keys and results."""
        return ((key, _public(run)) for key, run in super().items())

    def _rows(self) -> dict[Hashable, result.Track]:
        """The results sample by sample: of outputs that share one theta their rows."""
        return {key: run.rows for key, run in self.items()}

    def verdict(self, level: float = 0.05, lags: int | None = None, burn: int | None = None) -> ManyVerdicts:
        """Which runs have parameters that move, at a false discovery rate of ``level``, and where does tracking pay?"""
        return verdicts(self._rows(), self.by, level, lags, burn)

    def diagnose(self) -> ManyDiagnoses:
        """Diagnose every run, and count how often each diagnostic is out of bounds."""
        return diagnoses(self._rows(), self.by)

    def detect(
        self, kind: str = "glr", *, every: float = 10_000.0, level: float = 0.05, reference: Any = None,
        **settings: Any,
    ) -> ManyAlarms:  # fmt: skip
        """Alarms of all runs, one false alarm in ``every`` samples of all together, and which runs had a fault.

        ``level`` is a false discovery rate; ``reference`` is one for all runs or a mapping from every key to its own.
        Kinds and other settings are those of `driftfit.judge.alarms.detect`.
        """
        return alarms(self._rows(), self.by, kind, every=every, level=level, reference=reference, **settings)

    def report(
        self, path: str | PathLike[str], title: str | None = None, *, alarms: ManyAlarms | None = None,
        labels: Mapping[Hashable, Array] | None = None, since: Any = None,
    ) -> None:  # fmt: skip
        """Write one self-contained HTML page with all runs in one table, and pictures of the clearest.

        ``alarms`` of `detect`, and ``labels`` by key, true where something was wrong, have a separate section. With
        ``since``, a time or the number of a sample, the page begins with what changed from then on: where, which
        parameter, when, from what to what. ValueError if it is no time of these records.
        """
        text = page_of_many(self._rows(), self.by, title, self.failed, self.dropped, alarms, labels, since)
        written(text, path)

    def crossing(
        self, what: str, *, below: Any = None, above: Any = None, horizon: int | None = None, u: Any = None,
        level: float = 0.9,
    ) -> polars.DataFrame:  # fmt: skip
        """When a parameter or the output of every run crosses a limit, as one polars table, earliest first.

        Limits are the same for all, or a mapping from every key. Columns: those that identify the runs, ``probability``
        within the horizon, ``median``, ``low`` and ``high`` in samples after the end, with their times if the
        record has them; NaN, as the last rows, for runs that do not determine it. See `driftfit.use.crossing`.
        """
        return crossings(self._rows(), self.by, what, below, above, horizon, u, level)


class Fleet(fleet.Fleet, Judged, public=True):
    __doc__ = fleet.Fleet.__doc__

    def forecast(self, h: int, u: Any = None) -> polars.DataFrame:
        """The h nominal samples after the end of every series as one polars table, one row per sample.

        Columns: those that identify the results, and those of `Forecast.table`: ``step`` (1 .. h), the time if the
        record has one, ``y_hat``, ``y_std``, the 95 % band ``low`` and ``high``, and for every parameter
        ``theta_<name>`` and ``std_<name>``. ``u`` is a mapping from series to future inputs (h,) or (h, m), or one
        array for all; a missing key has no inputs. See `driftfit.use.forecast`.
        """
        from driftfit.show.export import forecasts_table

        return forecasts_table(self, h, u)

    def smooth(self) -> polars.DataFrame:
        """Every result smoothed, on all cores, as one polars table, one row per sample; see `Track.smooth`.

        Columns: those that identify the results, the time or ``sample``, and for every parameter ``theta_<name>`` and
        ``std_<name>``. Memory: that of the table twice. ValueError as for `Track.smooth`.
        """
        from driftfit.show.export import paths_table

        runs = dict(self.items())
        return paths_table(self, on_all_cores(runs, lambda key: (runs[key],), smoothed_path, "smoothing"))

    def summary(self) -> FleetSummary:
        """Results ranked by how much their parameters moved; print it."""
        return summarise_fleet(self)

    def plot(self, which: str | None = None, most: int = 12, level: float = 0.95, ax: Any = None) -> Figure:
        """Small multiples of one parameter for the results that moved most; a matplotlib figure.

        ``ax`` as for `Track.plot`.
        """
        return plot_fleet(self, which, most, level, ax)


class Outputs(fleet.Outputs, Judged, public=True):
    __doc__ = fleet.Outputs.__doc__

    def __getitem__(self, output: str | int) -> Track:
        """The record of one output, by name or index."""
        return _public(super().__getitem__(output))

    @property
    def left_out(self) -> dict[str, LeftOut]:
        """What the gate left out of each output, by its name; ``track(.., gate=run.left_out)`` applies it again."""
        return {name: self[name].left_out for name in self.outputs}

    def smooth(self, keep: str = "std", order_by: Any = None, undetermined: str = "min_norm") -> dict[str, Smoothed]:
        """The smoothed path of each output, by name; the arguments are those of `Track.smooth`."""
        return {name: Smoothed.of(self[name], keep, order_by, undetermined) for name in self.outputs}

    def forecast(self, h: int, u: Any = None) -> Forecast:
        """The h nominal samples after the record, u (h,) or (h, m): theta, std (h, ny, n), y_hat, y_std (h, ny)."""
        return forecast_outputs(self, h, u)

    def joint_noise(self, memory: float | None = None) -> JointNoise:
        """One noise covariance for all outputs, and their joint density; see `driftfit.judge.joint_noise`."""
        return JointNoise(self, memory)

    def summary(self) -> ByOutput[Summary]:
        """The summaries of all outputs, by name; print it."""
        return summarise_outputs(self)

    def plot(self, level: float = 0.95, ax: Any = None) -> Figure:
        """Parameters with bands: one row of panels for each output. ``ax`` as for `Track.plot`."""
        return plot_outputs(self, level, ax)


def _public(run: result.Track) -> Track:
    """A run of the class that users know: once the facade is imported, every run is made so
    (`driftfit.run.columns`).
    """
    assert isinstance(run, Track)
    return run
