"""Track with its verbs: the result of `driftfit.track`. Each verb is a separate module that works on plain data."""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike
from typing import TYPE_CHECKING, Any

from driftfit.bank.results.events import Event
from driftfit.bank.results.results import Hypotheses
from driftfit.bank.results.smoothed import SmoothedMixture
from driftfit.engine.kernel import Array
from driftfit.judge.alarms.detect import Alarms, detect
from driftfit.judge.diagnose import Diagnosis, diagnose
from driftfit.judge.segment import Segmentation, segmented
from driftfit.judge.verdict import Verdict, verdict
from driftfit.models.hammerstein_wiener.blocks import Blocks
from driftfit.run import result
from driftfit.run.live.rule import AlarmRule
from driftfit.show.plots import plot_track
from driftfit.show.report import report
from driftfit.show.summary import Summary, cell_of, summarise
from driftfit.smooth.changes import changes
from driftfit.smooth.smoothed import Smoothed
from driftfit.tune import inference
from driftfit.tune.refine import refine
from driftfit.use import simulate, system
from driftfit.use.blocks import blocks_of
from driftfit.use.constrained import Constrained, constrain
from driftfit.use.conversion import Transfer, transfer
from driftfit.use.crossing import Crossing, crossing
from driftfit.use.forecast import Forecast, forecast
from driftfit.use.plots import plot_blocks, plot_system, plot_validation
from driftfit.use.simulate import Prediction
from driftfit.use.system import FrequencyResponse, LongRun, Response

if TYPE_CHECKING:
    import xarray
    from matplotlib.figure import Figure


class Exported:
    """Tables, datasets, files, and what a notebook shows: the same for one result and for many."""

    def _repr_html_(self: Any) -> str:
        return cell_of(self)

    def to_table(self: Any, kind: str = "polars", arrays: bool = False) -> Any:
        """The result as a table of "polars", "pandas" or "pyarrow", one row per sample, keys first; see
        `driftfit.show.export`.

        With ``arrays`` the columns ``theta`` and ``std`` hold all parameters of a sample.
        """
        from driftfit.show.export import to_table  # importing polars takes as long as all other imports

        return to_table(self, kind, arrays)

    def to_xarray(self: Any) -> xarray.Dataset:
        """The result as an xarray dataset with the dimensions time and parameter, and one more for keys; see
        `driftfit.show.export`.
        """
        from driftfit.show.export import to_xarray

        return to_xarray(self)

    def __arrow_c_stream__(self: Any, requested_schema: object | None = None) -> object:
        """The same table as an Arrow stream, for any program that reads one."""
        return self.to_table().__arrow_c_stream__(requested_schema)

    def to_parquet(self: Any, path: str | PathLike[str]) -> None:
        """Write the same table as Parquet."""
        from driftfit.show.export import to_parquet

        to_parquet(self, path)


class Track(result.Track, Exported, public=True):
    __doc__ = result.Track.__doc__

    @property
    def hypotheses(self) -> Hypotheses:
        """The events of a `Bank`: probabilities, evidence, alarms, events, the mixture."""
        return Hypotheses(self.rows)

    def smooth(
        self, keep: str = "std", order_by: Any = None, undetermined: str = "min_norm"
    ) -> Smoothed | SmoothedMixture:
        """Every theta_t estimated from the whole record, past and future: the exact fixed-interval smoother.

        The regressors that the filter used are held fixed. keep="fit" also stores what residuals and leverages are
        made of; otherwise the problem is solved again when they are read. keep="cov" also stores the covariances,
        n * n numbers for each sample and each pair of neighbours. ``order_by`` (T,): theta changes with this variable
        instead of with time; the samples are sorted by it, smoothed in that order, and returned in time order. This
        needs a tracker whose drift is given.
        ``undetermined``: the value of parameters that the record does not determine, whose std is inf: "min_norm", the
        solution nearest to theta0; "nan"; or "raise". A `Bank` is smoothed over all its
        hypotheses (`driftfit.bank.results.smoothed.SmoothedMixture`). ValueError for other trackers that do
        not describe a random walk in Gaussian noise. Of outputs that share one theta, theta is (T, n) and residuals are
        (T, ny).
        """
        if self.tracker.weighs and self.start is None:
            return Hypotheses(self.rows).smoothed
        return Smoothed.of(self, keep, order_by, undetermined)

    def changes(self, threshold: float = 0.5) -> list[Event]:
        """The changes of parameters that are more probable than the threshold, given the whole record.

        Each has the interval that contains its date with probability 0.95, its probability, the most likely of the
        changes of the `Bank`, and by how much every parameter moved. Those of `AdaptiveKalman` are named by what they
        move, "all" or a group of its parameters. ValueError for trackers without hypotheses, and at a warm start.
        Cost: that of `smooth`.
        """
        if self.tracker.adapts:
            return changes(self.rows, threshold)
        return Hypotheses(self.rows).changes(threshold)

    def forecast(self, h: int, u: Any = None) -> Forecast:
        """theta and y at the h nominal samples after the record, with future inputs u (h,), (h, m) or (h, ny, m)."""
        return forecast(self, h, u)

    def summary(self) -> Summary:
        """Present parameters, and one-step errors compared with those of simpler methods; print it."""
        return summarise(self)

    def plot(self, level: float = 0.95, ax: Any = None) -> Figure:
        """Parameters with bands, prediction against output, innovations; a matplotlib figure.

        ``ax``: None for a new figure; one matplotlib axes, whose place the panels share (a picture of one panel is
        drawn in it); or as many axes as the picture has panels, here n + 2. The figure of the axes is returned.
        ValueError for another number.
        """
        return plot_track(self.rows, level, ax)

    def blocks(
        self, method: str = "svd-joint", input: str | None = None, output: str = "d1", at: float = 0.0
    ) -> Blocks:
        """Coefficients of the blocks of a `HammersteinWiener` model, sample by sample: ``.a``, ``.b``, ``.c``, ``.d``.

        ``method`` is "average", "svd", "svd-joint" or "gls" (with standard deviations), see
        `driftfit.models.hammerstein_wiener.separation`; ``input``, ``output`` and ``at`` choose the gauge,
        see `driftfit.models.hammerstein_wiener.blocks.Blocks.gauge`; None is "unit", or "c1" for a tracker
        of the minimal parameters.
        """
        return blocks_of(self, method, input, output, at)

    def plot_blocks(self, method: str = "svd-joint", times: Sequence[int] | None = None, ax: Any = None) -> Figure:
        """The static curves at some samples, and the coefficients over time; ``ax`` as for `plot`."""
        return plot_blocks(self, method, times, ax)

    def verdict(self, level: float = 0.05, lags: int | None = None, burn: int | None = None) -> Verdict:
        """Is the time variation real, which parameters move, and does tracking them pay? See
        `driftfit.judge.verdict`.
        """
        return verdict(self.rows, level, lags, burn)

    def segment(self, **settings: Any) -> Segmentation:
        """Segments of the record with constant parameters, with dates and their intervals; `driftfit.segment`."""
        return segmented(self.rows, **settings)

    def wald(self, *equations: str, at: int = -1) -> inference.Tested:
        """Test linear equations of theta after a sample, such as "income == 1", jointly; `driftfit.tune.inference`."""
        return inference.wald(self.rows, *equations, at=at)

    def constants(self, **settings: Any) -> Any:
        """statsmodels' least squares of the same regression with constant parameters, for HAC errors and all its tests;
        ``settings`` as cov_type="HAC", cov_kwds={"maxlags": 4}.
        """
        return inference.constants(self.rows, **settings)

    def aic(self, settings: int = 0) -> float:
        """-2 loglik + 2 p; p counts the parameters whose start is unknown, and the settings that were estimated."""
        return inference.information(self.rows, settings, 2.0)

    def bic(self, settings: int = 0) -> float:
        """-2 loglik + p log N, with p as for `aic` and N the samples that were used."""
        return inference.information(self.rows, settings)

    def diagnose(self) -> Diagnosis:
        """Whiteness, noise level, distribution, excitation, constancy, with limits; see `driftfit.judge.diagnose`."""
        return diagnose(self.rows)

    def ahead(self, k: int) -> Prediction:
        """Every output predicted from k samples before it, given the inputs; see `driftfit.use.simulate`."""
        return simulate.ahead(self._single("ahead"), k)

    def simulate(self, u: Any, at: int = -1, y: Any = None) -> Prediction:
        """Outputs that inputs u would cause in the system of a sample, with bands; see `driftfit.use.simulate`."""
        return simulate.simulate(self._single("simulate"), u, at, y)

    def crossing(
        self,
        what: str,
        *,
        below: float | None = None,
        above: float | None = None,
        horizon: int | None = None,
        u: Any = None,
        level: float = 0.9,
    ) -> Crossing:
        """When a parameter or the output crosses a limit, with an interval; see `driftfit.use.crossing`."""
        return crossing(self._single("crossing"), what, below=below, above=above, horizon=horizon, u=u, level=level)

    def refine(self, passes: int = 20, drifting: bool = False) -> Track:
        """Estimate off line: the record again, linearised where the estimate settles (`driftfit.tune.refine`)."""
        return refine(self, passes, drifting)

    def constrain(self, *constraints: str) -> Constrained:
        """theta known to be within bounds or on planes, as "b1 >= 0", "0 <= a1 + a2 <= 1", "b1 + b2 == 1".

        The result has ``theta``, ``std``, ``band()``, ``cov(t)`` and ``prob``; see
        `driftfit.use.constrained`.
        """
        return constrain(self, *constraints)

    def poles(self, at: Any = None) -> Array:
        """Poles of the ARX system at every sample, (T, na), the largest first; see `driftfit.use.system`."""
        return system.poles(self, at)

    def largest_pole(self, at: Any = None) -> Response:
        """Magnitude (T,) of the largest pole, with its standard deviation; below 1 the system is stable."""
        return system.largest_pole(self, at)

    def dc_gain(self, at: Any = None) -> Response:
        """Static gain (T, m) of every input, with its standard deviation."""
        return system.dc_gain(self, at)

    def step_response(self, h: int, input: int | str = 0, at: Any = -1) -> Response:
        """Response (., h) to a unit step of an input, at the samples ``at`` (None: all), with std."""
        return system.step_response(self, h, input, at)

    def impulse_response(self, h: int, input: int | str = 0, at: Any = -1) -> Response:
        """Response (., h) to a unit impulse of an input, at the samples ``at`` (None: all), with std."""
        return system.impulse_response(self, h, input, at)

    def frequency_response(self, w: Any = None, input: int | str = 0, at: Any = -1) -> FrequencyResponse:
        """Magnitude and phase at w radians per sample, with std; see `driftfit.use.system`."""
        return system.frequency_response(self, w, input, at)

    def to_scipy(self, at: int = -1, dt: float = 1.0, input: int | str = 0) -> Any:
        """The system at a sample as `scipy.signal.dlti`, from one input to y."""
        return system.to_scipy(self, at, dt, input)

    def transfer(self, dt: float = 1.0, input: int | str = 0, at: int = -1) -> Transfer:
        """The transfer function of one sample from an input, with bands, which converts itself to continuous time.

        ``run.transfer(dt=0.1).continuous()`` has coefficients in the unit of dt, `time_constants` and the way back.
        """
        return transfer(self, dt, input, at)

    def long_run(self, at: int = -1, level: float = 0.95) -> tuple[LongRun, ...]:
        """Long-run effect b / (1 - a) of every input, with standard error and Fieller's interval."""
        return system.long_run(self, at, level)

    def detect(self, kind: str | AlarmRule = "glr", **settings: Any) -> Alarms:
        """Alarms at a set rate of false alarms, one in ``every`` samples; see `driftfit.judge.alarms.detect`.

        ``kind`` may also be the rule of another run, ``alarms.rule``. Of outputs that share one theta the rows are
        judged, and samples are numbered as in ``run.rows``.
        """
        return detect(self.rows, kind, **settings)

    def plot_system(self, input: int | str = 0, at: Any = None, ax: Any = None, **settings: Any) -> Figure:
        """Step and frequency response over time with bands, poles in the plane, gain; see
        `driftfit.use.plots`. ``ax`` as for `plot`.
        """
        return plot_system(self, input, at, ax=ax, **settings)

    def plot_validation(self, y: Any, u: Any = None, at: int = -1, level: float = 0.95, ax: Any = None) -> Figure:
        """Simulated and measured outputs of a record that was not used, with bands and the fit in per cent."""
        return plot_validation(self._single("plot_validation"), y, u, at, level, ax)

    def report(
        self,
        path: str | PathLike[str],
        title: str | None = None,
        *,
        alarms: Alarms | None = None,
        labels: Array | None = None,
    ) -> None:
        """Write one self-contained HTML page: verdict, tables, pictures, settings; see `driftfit.show.report`.

        ``alarms`` of `detect` and ``labels`` (T,), true where something was wrong, have a separate section.
        """
        report(self.rows, path, title, alarms, labels)

    def _single(self, verb: str) -> result.Track:
        """The run; ValueError if its samples are instants of several rows."""
        if self.rows_per_instant > 1:
            raise ValueError(
                f"{verb}: a sample of this run holds {self.rows_per_instant} outputs; run.rows.{verb}(...) takes them "
                "one after the other."
            )
        return self
