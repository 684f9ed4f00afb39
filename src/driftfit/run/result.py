"""Track as plain data: the result of a run, the same for every mode. Its verbs are in `driftfit.results`."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from functools import cached_property
from os import PathLike
from typing import Any, ClassVar, Self

import numpy as np

from driftfit.data.record import Known, Record, Records, time_text
from driftfit.engine.kernel import Array
from driftfit.models.arx import ARX
from driftfit.models.base import Model
from driftfit.readings.left_out import NOTHING_LEFT_OUT, LeftOut
from driftfit.run.columns import OfRecord, attribute
from driftfit.run.gating import left_out_of
from driftfit.run.lanes import Lane, Lanes, Results, decided_record, names_of, read_results, write_results
from driftfit.run.live.conformal import quantile, widened
from driftfit.run.program import Program, State, kept, lanes_of, state_of
from driftfit.run.warm_start import End
from driftfit.trackers.base import Tracker
from driftfit.trackers.student import band_ratio, log_student, residuals_before


class Plain:
    """A result or a stream as data: ``Kind(...)`` makes an instance of its public class.

    A verb such as `smooth` takes a result and is in a higher layer, so a result cannot have it as a method without a
    circular import. The facade (`driftfit.results`, `driftfit.streams`) declares a class of each kind that also has the
    verbs as methods, with ``public=True``; from then on the plain class makes instances of that class.
    """

    _public: ClassVar[dict[type, type]] = {}

    def __init_subclass__(cls, public: bool = False, **settings: Any) -> None:
        super().__init_subclass__(**settings)
        if public:
            plain = next(one for one in cls.__mro__[1:] if one.__name__ == cls.__name__)
            Plain._public[plain] = cls

    def __new__(cls, *args: Any, **kwargs: Any) -> Self:
        return object.__new__(Plain._public.get(cls, cls))

    @classmethod
    def public(cls) -> type[Self]:
        """The class that users get."""
        return Plain._public.get(cls, cls)


KIND = "track"
"""The kind of a file that holds one run."""


class Track(Plain, OfRecord):
    """Parameters of a record, sample by sample.

    Outputs that share one theta, ``Regression(n, ny=2, shared=True)``, are one Track whose samples are instants: theta
    is that after all outputs of an instant, and what belongs to each output is (T, ny). `rows` is the Track of the
    T ny rows, one after the other.

    Attributes
    ----------
    theta, std : (T, n)
        Parameters after each sample, and their standard deviations: inf for parameters that are not determined yet, NaN
        if the tracker has no covariance.
    prediction, innovation, innovation_std : (T,)
        One-step prediction made before the output was observed, its error, and the standard deviation of that error.
    ok : (T,) bool
        Which samples were used.
    y, u, time : (T,), (T, m), (T,) or None
        The record.
    names : tuple of str
        Names of the parameters.
    """

    record: Record
    model: Model = attribute("program.whole")
    tracker: Tracker = attribute("program.tracker")
    outputs: tuple[str, ...] = attribute("program.whole.outputs", "Names of the outputs of the model.")
    names: tuple[str, ...] = attribute("program.names")
    known: Known = attribute("record.known", "The known factors of every row.")

    def __init__(
        self,
        program: Program,
        record: Record,
        lane: Lane,
        start: State | None = None,
        left_out: LeftOut = NOTHING_LEFT_OUT,
    ) -> None:
        """``left_out`` was decided before: the record of a program without a gate is then without it."""
        self.program, self.record, self.start = program, record, start
        self._lane, self._left_out = lane, left_out

    def __reduce__(self) -> Any:
        """A copy, or a run sent to another process, does not contain the other series of a fleet's tile."""
        return type(self), (self.program, self.record, self._lane.alone(self.program), self.start, self._left_out)

    @property
    def rows_per_instant(self) -> int:
        return 1 if self.program.shared is None else len(self.outputs)

    @property
    def rows(self) -> Track:
        """A sample for each output: the T ny rows of outputs that share one theta, otherwise the run itself."""
        return self if self.program.shared is None else self._rows

    @cached_property
    def _rows(self) -> Track:
        return Track(replace(self.program, shared=None), self.record, self._lane, self.start, self._left_out)

    @property
    def keeps_cov(self) -> bool:
        """Whether the covariance of every sample was stored (``keep="cov"``)."""
        return "P" in names_of(self._lane.out)

    @property
    def last(self) -> Any:
        """The time of the last sample; None if samples have no times."""
        return None if self.record.time is None else self.record.time[-1]

    @property
    def state(self) -> dict[str, Array]:
        """The state after the last sample, field by field; these are views and must not be written to."""
        return state_of(self._lane.tile, self._lane.lane)

    @property
    def undetermined(self) -> Array:
        """Which parameters the record does not determine, (n,) bool: their std after the last sample is inf."""
        return np.isinf(self.last_var)

    @property
    def last_var(self) -> Array:
        """Variances of the parameters after the last sample, (n,): a view."""
        return np.asarray(self._lane.tile["var"][0, :, self._lane.lane])

    def in_rows(self, name: str) -> Array:
        """A field of the driver's output; replays the record, once, if only theta was kept."""
        return (self._lane if name in self.stores() else self._complete).written(name)

    @cached_property
    def _complete(self) -> Lane:
        """The results with everything that ``keep="std"`` stores."""
        if kept(self._lane.out.dtype)[0] != "theta":
            return self._lane
        tile = self.fresh()
        return Lane(self.program.run(tile, self.record), tile)

    def stores(self) -> tuple[str, ...]:
        """Names of the fields that ``keep="std"`` stores."""
        return names_of(self._lane.out)

    def __len__(self) -> int:
        return len(self.record) // self.rows_per_instant

    def __repr__(self) -> str:
        of = "" if self.program.shared is None else f" of {len(self.outputs)} outputs"
        return f"Track of {len(self)} samples{of}, {int(self.ok.sum())} used: {self.model!r}, {self.tracker!r}"

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the parameters, empty if they are not known."""
        model = self.program.model
        dimensions = model.dimensions
        if dimensions is None or self.names != model.names:
            return ("",) * len(self.names)
        return tuple(self.labels.unit(*dimension) for dimension in dimensions)

    def time_text(self, t: int) -> str:
        """The time of sample t, in the time zone of the table that it came from."""
        return time_text(self.time[t], self.labels.zone)

    @cached_property
    def loglik(self) -> float:
        """Log-likelihood of the record: the sum of `log_density`; the diffuse likelihood after a diffuse start.

        For each sample that determined a new direction -1/2 log F is added. NaN for trackers without an innovation
        variance.
        """
        if not self.tracker.covariance:
            return float("nan")
        if self.decided is not self:
            return self.decided.loglik
        total = np.nansum(self.log_density)
        if "F" in self.state:
            total -= 0.5 * np.sum(np.log(self.state["F"]))
        return float(total)

    @cached_property
    def log_density(self) -> Array:
        """(T,): log density of each used sample given earlier ones, NaN where there is none.

        It is the Gaussian density of the forecast, -1/2 (log 2 pi s + e^2 / s), or Student's if the tracker estimates
        the noise variance (`driftfit.trackers.student`); for a tracker that weighs hypotheses it is that of their
        mixture. A model whose innovation is not that of y adds its log Jacobian.
        """
        if self.program.shared is not None:
            return self.by_row(self.rows.log_density)
        if self.decided is not self:
            return self.decided.log_density
        s, e = (np.asarray(part, dtype=np.float64) for part in (self.innovation_var, self.innovation))
        counted = self.ok & np.isfinite(s) & (s > 0.0)
        own = self.tracker.log_density(self._complete.out)
        if own is not None:
            terms = own[:, self._complete.lane]
        elif self.tracker.learns_noise:
            terms = log_student(e, s, residuals_before(self.ok, s, float((self.start or {}).get("count", 0.0))))
        else:
            with np.errstate(invalid="ignore", divide="ignore"):
                terms = -0.5 * (np.log(2.0 * np.pi * s) + e**2 / s)
        terms = np.where(counted, terms, np.nan)
        if self.model.implicit and not self.tracker.output_error:
            terms[counted] += self.model.implicit.log_jacobian(self.theta[counted], self.y[counted])
        return terms

    def band(self, level: float = 0.95, conformal: bool = False) -> tuple[Array, Array]:
        """(low, high), each (T, n): pointwise bands of theta at this level, under the tracker's own model.

        They are Student's where the noise variance is estimated (`Tracker.learns_noise`). With ``conformal`` they are
        normal, and widened by the factor by which bands of the output had to be widened so far (`output_band`).
        """
        half = quantile(level) * self.std
        if conformal:
            half = half * self.after_rows(self._widened(level, "band")[1:, None])
        else:
            half = half * self.after_rows(self._student(level, 1)[:, None])
        return self.theta - half, self.theta + half

    def output_band(self, level: float = 0.95, conformal: bool = False) -> tuple[Array, Array]:
        """(low, high), each (T,): bands of each output before it is known, for models whose innovation is that of y.

        With ``conformal`` they are widened or narrowed by a factor that keeps the share of outputs within them at
        ``level`` in any record (`driftfit.ConformalFactor`, which does the same for a stream, bit for bit). A warning
        is issued where it exceeds 2. ValueError for a model whose innovation is not that of y.
        """
        if self.model.implicit and not self.tracker.output_error:
            raise ValueError(
                "output_band: the innovation of this model is that of its equation, and not that of y; "
                "use run.forecast() for bands of the output."
            )
        half = quantile(level, "output_band") * self.innovation_std
        half = half * self.by_row(self._widened(level, "output_band")[:-1] if conformal else self._student(level, 0))
        return self.prediction - half, self.prediction + half

    def _student(self, level: float, own: int) -> Array:
        """Student's quantile over the normal one, by the residuals before each row and its ``own`` (0 or 1); 1 for
        trackers to which the noise variance is given, or which enlarge their variances themselves.
        """
        ok, s = self.in_rows("ok") > 0.0, self.in_rows("s")
        if not self.tracker.learns_noise:
            return np.ones(len(s))
        return band_ratio(
            residuals_before(ok, s, float((self.start or {}).get("count", 0.0))) + own * (ok & ~np.isinf(s)), level
        )

    def _widened(self, level: float, verb: str) -> Array:
        """The conformal factor before each row and after the last."""
        return widened(self.in_rows("e"), self.in_rows("s"), level, verb)

    @cached_property
    def left_out(self) -> LeftOut:
        """What the gate decided of samples that it did not use as they are; empty without a gate."""
        if self.program.gate is None:
            return self._left_out
        used = self.decided.in_rows("ok") > 0.0
        return left_out_of(self.program, self.in_rows("reason"), self.record.y, used, self._start_decided)

    @cached_property
    def _start_decided(self) -> Any:
        return decided_record([self.program], self.record, {0: self.start or {}}, self.in_rows)

    @cached_property
    def decided(self) -> Track:
        """The run without the codes that its gate found among the first samples, for smoothers and judgements."""
        if self._start_decided is None:
            return self
        record, (start,), _ = self._start_decided
        return track_record(self.program, record, start=start)

    @cached_property
    def used_record(self) -> Record:
        """The record with the decisions of the gate: refused readings are missing, and samples with a refused input
        have no weight, so that others learn from the same readings.
        """
        if self.program.gate is None or not len(self.left_out):
            return self.record
        y, noise = self.left_out.applied(self.record.y, self.known.noise)
        if self.model.implicit:  # the reading is in the regressor, too
            y = np.where(np.isinf(noise), np.nan, y)
        return replace(self.record, y=y, known=self.known.changed(noise=noise))

    def cov(self, t: int) -> Array:
        """Covariance (n, n) of theta after sample t (negative t counts from the end).

        Replays the record up to t, O(t), unless the run was made with keep="cov".
        """
        T = len(self)
        if not -T <= t < T:
            raise IndexError(f"cov: t must be within the record of {T} samples; got {t}.")
        t %= T
        if self.keeps_cov:
            return np.array(self.written("P")[t])
        return self.tracker.cov(self.lane(t))

    def covariances(self) -> Array:
        """Covariances (T, n, n) of theta after every sample; replays the record unless they were stored."""
        if self.keeps_cov:
            return self.written("P")
        return self.after_rows(self.program.run(self.fresh(), self.record, "cov")["P"][..., 0])

    def lane(self, t: int) -> dict[str, Array]:
        """The state after sample t, field by field; replays the record up to t, O(t)."""
        tile = self.fresh()
        record = self.record.part(slice(0, (t % len(self) + 1) * self.rows_per_instant))
        self.program.drivers().run(tile, *lanes_of(record), self.program.written(tile, len(record)))
        return state_of(tile)

    def fresh(self) -> Array:
        """A tile of one lane at its start, before the first sample."""
        return self.program.tile(self.start)

    def again(self, y: Array) -> Self:
        """The same run over another output, without its times."""
        tile, record = self.fresh(), replace(self.record, y=y, time=None)
        return type(self)(self.program, record, Lane(self.program.run(tile, record), tile), self.start)

    def run_by(self, program: Program) -> Self:
        """The same record, run by another program from its start."""
        other = track_record(program, self.record)
        return type(self)(program, self.record, other._lane, other.start)

    def end(self) -> End:
        """The end of the run, from which another one can continue (`warm_start`)."""
        state = {name: value.copy() for name, value in self.state.items()}
        return End((self.program,), (state,), self.last, dt=self.labels.dt, zone=self.labels.zone)

    def polynomials(self) -> tuple[Array, list[Array]]:
        """A(z) and B(z) of an ARX model in powers of z^-1, (T, .) each; see `ARX.polynomials`."""
        if not isinstance(self.model, ARX):
            raise ValueError(f"polynomials: {type(self.model).__name__} has no polynomials; use ARX.")
        return self.model.polynomials(self.theta)

    def save(self, path: str | PathLike[str]) -> None:
        """Write the result to one file without pickle, completely or not at all."""
        one, number = Records.of(self.record), np.zeros(1, int)
        lanes = Lanes(
            [(self._lane.out, self._lane.tile, number, number + self._lane.lane)], np.array([len(self.record)])
        )
        records = one._replace(left_out={0: self._left_out} if len(self._left_out) else {})
        results = Results((self.program,), records, lanes, {}, {} if self.start is None else {0: self.start})
        write_results(path, KIND, results)

    @classmethod
    def load(cls, path: str | PathLike[str], classes: Iterable[Any] = ()) -> Self:
        """Read a file that `save` wrote; ``classes`` are classes and functions of your own that it needs."""
        (program,), records, lanes, _, starts = read_results(path, KIND, classes)
        left_out = records.left_out.get(0, NOTHING_LEFT_OUT)
        return cls(program, records.part(0), lanes[0], starts.get(0), left_out)


def track_record(program: Program, record: Record, keep: str = "std", start: State | None = None) -> Track:
    """Run a checked record from the tracker's start, or from given fields."""
    tile = program.tile(start)
    return Track(program, record, Lane(program.run(tile, record, keep), tile), start)


def burn_in(n: int) -> int:
    """Number of samples at the start of a run of n parameters that are not judged, because they depend on the start."""
    return max(50, 5 * n)


def root_mean_square(values: Any) -> float:
    """sqrt(mean(values^2)); NaN for none."""
    values = np.asarray(values, dtype=float)
    return float(np.sqrt(np.mean(values * values))) if values.size else float("nan")
