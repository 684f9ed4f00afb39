"""Track: the result of a run, the same whatever ran."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import cached_property
from os import PathLike
from statistics import NormalDist
from typing import TYPE_CHECKING, Any, Self, cast

import numpy as np

from driftfit.data import storage
from driftfit.data.record import PLAIN, Labels, time_text
from driftfit.engine.drivers import drivers, output_type
from driftfit.engine.kernel import Array
from driftfit.models.base import Model
from driftfit.results import Judged
from driftfit.run.warm_start import End, fresh_tile
from driftfit.trackers.base import Tracker

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from driftfit.models.hammerstein_wiener.separation.paths import Blocks
    from driftfit.show.summary import Summary
    from driftfit.smooth.smoothed import Smoothed
    from driftfit.trackers.bank.results.results import Hypotheses
    from driftfit.use.forecast import Forecast


class Track(Judged):
    """Parameters of a record, sample by sample.

    Attributes
    ----------
    theta, std : (T, n)
        Parameters after each sample, and their standard deviations: inf for what has not been seen yet, NaN where the
        tracker carries no covariance.
    prediction, innovation, innovation_std : (T,)
        One-step prediction made before the output was seen, its error, and the standard deviation of that error.
    ok : (T,) bool
        Which samples were used.
    y, u, time : (T,), (T, m), (T,) or None
        The record.
    names : tuple of str
        Names of the parameters.
    """

    def __init__(
        self,
        model: Model,
        tracker: Tracker,
        y: Array,
        u: Array,
        time: Array | None,
        known: Array,
        out: Array,
        tile: Array,
        lane: int = 0,
        labels: Labels = PLAIN,
        start: Mapping[str, Array] | None = None,
    ) -> None:
        self.model = model
        self.tracker = tracker
        self.y = y
        self.u = u
        self._time = time
        self._known = known
        self._out = out
        self._tile = tile
        self._lane = lane
        self.labels = labels
        self._start = start

    def __reduce__(self) -> Any:
        """A copy, and what is sent to another process, leaves the other series of a fleet's tile behind."""
        out, tile = self._out, self._tile
        if tile["theta"].shape[-1] > 1:
            tile = fresh_tile(self.model, self.tracker)
            for name in storage.fields(tile):
                tile[name][0, ..., 0] = self._tile[name][0, ..., self._lane]
            out = np.empty(len(self), output_type(tile, self.tracker.outputs, "cov" if "P" in _names(out) else "std"))
            for name in _names(out):
                out[name][..., 0] = self._written(name)
        signals = (self.y, self.u, self._time, self._known)
        return type(self), (self.model, self.tracker, *signals, out, tile, 0, self.labels, self._start)

    def _written(self, name: str) -> Array:
        """A field of what the driver wrote, for this lane."""
        field: Array = self._out[name][..., self._lane]
        return field

    def __len__(self) -> int:
        return len(self.y)

    def __repr__(self) -> str:
        return f"Track of {len(self)} samples, {int(self.ok.sum())} used: {self.model!r}, {self.tracker!r}"

    @property
    def names(self) -> tuple[str, ...]:
        return self.tracker.names_for(self.model)

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the parameters, empty where they are not known."""
        dimensions = self.model.dimensions
        if dimensions is None or self.names != self.model.names:
            return ("",) * len(self.names)
        return tuple(self.labels.unit(*dimension) for dimension in dimensions)

    @property
    def time(self) -> Array:
        """Times given, or sample numbers."""
        return np.arange(len(self)) if self._time is None else self._time

    def time_text(self, t: int) -> str:
        """The time of sample t, in the time zone of the table that it came from."""
        return time_text(self.time[t], self.labels.zone)

    @property
    def theta(self) -> Array:
        return self._written("theta")

    @cached_property
    def std(self) -> Array:
        return np.sqrt(self._written("var"))

    @property
    def prediction(self) -> Array:
        return self._written("y_hat")

    @property
    def innovation(self) -> Array:
        return self._written("e")

    @cached_property
    def innovation_std(self) -> Array:
        return np.sqrt(self._written("s"))

    @cached_property
    def ok(self) -> Array:
        return self._written("ok") > 0.0

    @cached_property
    def loglik(self) -> float:
        """Log-likelihood of the record: the sum of `log_density`; the diffuse likelihood after a diffuse start.

        To the sum comes -1/2 log F for each sample that determined a new direction. NaN for trackers without an
        innovation variance.
        """
        if not self.tracker.covariance:
            return float("nan")
        total = np.nansum(self.log_density)
        if "F" in _names(self._tile):
            total -= 0.5 * np.sum(np.log(self._tile["F"][..., self._lane]))
        return float(total)

    @cached_property
    def log_density(self) -> Array:
        """(T,): log density of each used sample given those before it, NaN where there is none.

        The Gaussian one of the forecast, -1/2 (log 2 pi s + e^2 / s); for a tracker that weighs hypotheses that of
        their mixture. A model whose innovation is not that of y adds its log Jacobian.
        """
        s = self._written("s")
        counted = self.ok & np.isfinite(s) & (s > 0.0)
        own = self.tracker.log_density(self._out)
        with np.errstate(invalid="ignore", divide="ignore"):
            gaussian = -0.5 * (np.log(2.0 * np.pi * s) + self.innovation**2 / s)
        terms = np.where(counted, gaussian if own is None else own[:, self._lane], np.nan)
        if hasattr(self.model, "log_jacobian") and not self.tracker.output_error:
            terms[counted] += self.model.log_jacobian(self.theta[counted], self.y[counted])
        return terms

    def band(self, level: float = 0.95) -> tuple[Array, Array]:
        """(low, high), each (T, n): pointwise bands of theta at this level, under the tracker's own model."""
        if not 0.0 < level < 1.0:
            raise ValueError(f"band: level must be between 0 and 1, such as 0.95; got {level!r}.")
        half = NormalDist().inv_cdf(0.5 + level / 2.0) * self.std
        return self.theta - half, self.theta + half

    def cov(self, t: int) -> Array:
        """Covariance (n, n) of theta after sample t (negative t counts from the end).

        Replays the record up to t, O(t), unless the run was made with keep="cov".
        """
        T = len(self)
        if not -T <= t < T:
            raise IndexError(f"cov: t must be within the record of {T} samples; got {t}.")
        t %= T
        if "P" in _names(self._out):
            return np.array(self._written("P")[t])
        return self.tracker.cov(self.lane(t))

    def lane(self, t: int) -> dict[str, Array]:
        """The state after sample t, field by field; replays the record up to t, O(t)."""
        t %= len(self)
        tile = self._fresh_tile()
        out = np.empty(t + 1, output_type(tile, self.tracker.outputs))
        known = self._known if len(self._known) == 1 else self._known[: t + 1]
        run = drivers(self.model.steps, self.tracker.steps_for(self.model)).run
        run(tile, self.y[: t + 1, None], self.u[: t + 1, :, None], known[:, :, None], out)
        return {name: tile[name][0, ..., 0] for name in storage.fields(tile)}

    @property
    def hypotheses(self) -> Hypotheses:
        """What a `Bank` says of events: probabilities, evidence, alarms, events, the mixture."""
        if not self.tracker.weighs:
            raise ValueError(f"hypotheses: {type(self.tracker).__name__} has no hypotheses; track with a Bank.")
        from driftfit.trackers.bank.results.results import Hypotheses

        return Hypotheses(self)

    def smooth(self, keep: str = "std", order_by: Any = None, undetermined: str = "min_norm") -> Smoothed:
        """Every theta_t from the whole record, past and future: the exact fixed-interval smoother.

        The regressors that the filter used are held fixed. keep="cov" also stores the covariances, n * n numbers for
        each sample and each pair of neighbours. ``order_by`` (T,): theta changes with this variable instead of with
        time; the samples are sorted by it, smoothed in that order, and put back. ``undetermined``: what to give for
        parameters that the record does not determine, whose std is inf: "min_norm", the answer nearest to theta0;
        "nan"; or "raise". A `Bank` is smoothed given the events that it found
        (`driftfit.trackers.bank.results.decided_path.EventSmoothed`). ValueError for another tracker that is no random
        walk in Gaussian noise.
        """
        from driftfit.smooth.smoothed import Smoothed

        if self._start is not None:
            raise ValueError("smooth: a run with a warm start cannot be smoothed; track the whole record.")
        if self.tracker.weighs:
            return cast("Smoothed", self.hypotheses.smooth())
        return Smoothed.of(self, keep, order_by, undetermined)

    def forecast(self, h: int, u: Any = None) -> Forecast:
        """theta and y at the h nominal samples after the record, u (h,) or (h, m) being the inputs then."""
        from driftfit.use.forecast import forecast

        return forecast(self, h, u)

    def _fresh_tile(self) -> Array:
        """A tile of one lane as it was before the first sample."""
        return fresh_tile(self.model, self.tracker, self._start)

    def end(self) -> End:
        """Where the run ended, for another one to begin (`warm_start`)."""
        state = {name: self._tile[name][0, ..., self._lane].copy() for name in storage.fields(self._tile)}
        return End(self.model, self.tracker, state, None if self._time is None else self._time[-1])

    def summary(self) -> Summary:
        """Parameters now, and one-step errors beside what one would otherwise do; print it."""
        from driftfit.show.summary import summarise

        return summarise(self)

    def plot(self, level: float = 0.95) -> Figure:
        """Parameters with bands, prediction against output, innovations; a matplotlib figure."""
        from driftfit.show.plots import plot_track

        return plot_track(self, level)

    def to_table(self, kind: str = "polars") -> Any:
        """The result as a table of "polars", "pandas" or "pyarrow", one row a sample; see `driftfit.data.export`."""
        from driftfit.data.export import to_table

        return to_table(self, kind)

    def __arrow_c_stream__(self, requested_schema: object | None = None) -> object:
        """The same table as an Arrow stream, for whatever reads one."""
        return self.to_table().__arrow_c_stream__(requested_schema)

    def to_parquet(self, path: str | PathLike[str]) -> None:
        """Write the same table as Parquet."""
        from driftfit.data.export import to_parquet

        to_parquet(self, path)

    def polynomials(self) -> tuple[Array, list[Array]]:
        """A(z) and B(z) of an ARX model in powers of z^-1, (T, .) each; see `ARX.polynomials`."""
        convert = getattr(self.model, "polynomials", None)
        if convert is None:
            raise ValueError(f"polynomials: {type(self.model).__name__} has no polynomials; use ARX.")
        return cast("tuple[Array, list[Array]]", convert(self.theta))

    def blocks(
        self, method: str = "svd-joint", input: str | None = None, output: str = "d1", at: float = 0.0
    ) -> Blocks:
        """Coefficients of the blocks of a `HammersteinWiener` model, sample by sample: ``.a``, ``.b``, ``.c``, ``.d``.

        ``method`` is "average", "svd", "svd-joint" or "gls" (with standard deviations), see
        `driftfit.models.hammerstein_wiener.separation.separate`; ``input``, ``output`` and ``at`` choose the gauge,
        see `driftfit.models.hammerstein_wiener.separation.paths.Blocks.gauge`; None is "unit", or "c1" for a tracker
        that follows the minimal parameters.
        """
        from driftfit.models.hammerstein_wiener.results.run_blocks import blocks_of

        return blocks_of(self, method, input, output, at)

    def plot_blocks(self, method: str = "svd-joint", times: Sequence[int] | None = None) -> Figure:
        """The static curves at some samples, and the coefficients over time; a matplotlib figure."""
        from driftfit.models.hammerstein_wiener.results.plots import plot_blocks

        return plot_blocks(self, method, times)

    def save(self, path: str | PathLike[str]) -> None:
        """Write the result to one file, without pickle; complete or not at all."""
        storage.write(path, *self.written())

    def written(self) -> tuple[dict[str, Any], dict[str, Array]]:
        """(header, arrays): what `save` writes."""
        header = {
            "kind": "track",
            "model": storage.describe(self.model),
            "tracker": storage.describe(self.tracker),
            "labels": asdict(self.labels),
            "keep": "cov" if "P" in _names(self._out) else "std",
        }
        arrays = {"y": self.y, "u": self.u, "known": self._known}
        if self._time is not None:
            arrays["time"] = self._time
        arrays |= {f"out_{name}": self._written(name) for name in _names(self._out)}
        arrays |= {f"state_{name}": self._tile[name][0, ..., self._lane] for name in storage.fields(self._tile)}
        arrays |= {f"start_{name}": value for name, value in (self._start or {}).items()}
        return header, arrays

    @classmethod
    def load(cls, path: str | PathLike[str]) -> Self:
        """Read what `save` wrote."""
        return cls.from_written(path, *storage.read(path, "track"))

    @classmethod
    def from_written(cls, path: str | PathLike[str], header: Mapping[str, Any], arrays: Mapping[str, Array]) -> Self:
        """The inverse of `written`; ``path`` is for the message of an error."""
        model, tracker = storage.rebuild(header["model"], Model), storage.rebuild(header["tracker"], Tracker)
        tile = fresh_tile(model, tracker)
        state = {name: tile[name][0, ..., 0] for name in storage.fields(tile)}
        storage.restore(path, tracker, arrays, "state_", state)
        out = np.empty(len(arrays["y"]), output_type(tile, tracker.outputs, header["keep"]))
        storage.restore(path, tracker, arrays, "out_", {name: out[name][..., 0] for name in _names(out)})
        start = {name.removeprefix("start_"): arrays[name] for name in arrays if name.startswith("start_")}
        return cls(
            model, tracker, arrays["y"], arrays["u"], arrays.get("time"), arrays["known"], out, tile,
            labels=Labels(**header["labels"]), start=start or None,
        )  # fmt: skip


def _names(records: Array) -> tuple[str, ...]:
    return records.dtype.names or ()


def root_mean_square(values: Any) -> float:
    """sqrt(mean(values^2)); NaN for none."""
    values = np.asarray(values, dtype=float)
    return float(np.sqrt(np.mean(values * values))) if values.size else float("nan")
