"""The methods of a result that judge and use it; `Track` inherits them."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from os import PathLike
from typing import TYPE_CHECKING, Any, cast

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from driftfit.engine.kernel import Array
    from driftfit.judge.alarms.detect import Alarms
    from driftfit.judge.alarms.many import ManyAlarms
    from driftfit.judge.alarms.rule import AlarmRule
    from driftfit.judge.diagnose import Diagnosis
    from driftfit.judge.many import ManyDiagnoses, ManyVerdicts
    from driftfit.judge.segment import Segmentation
    from driftfit.judge.verdict import Verdict
    from driftfit.run.result import Track
    from driftfit.use.crossing import Crossing
    from driftfit.use.simulate import Prediction
    from driftfit.use.system import FrequencyResponse, LongRun, Response


class JudgedMany:
    """Methods of many runs with keys, a fleet or the outputs of one record; see `driftfit.judge.many`."""

    def _runs(self) -> dict[Hashable, Track]:
        raise NotImplementedError

    def verdict(self, level: float = 0.05, lags: int | None = None, burn: int | None = None) -> ManyVerdicts:
        """Which runs have parameters that move, at a false discovery rate of ``level``, and where does tracking pay?"""
        from driftfit.judge.many import verdicts

        return verdicts(self._runs(), level, lags, burn)

    def diagnose(self) -> ManyDiagnoses:
        """Diagnose every run, and count how often each diagnostic is out of bounds."""
        from driftfit.judge.many import diagnoses

        return diagnoses(self._runs())

    def detect(
        self,
        kind: str = "band",
        *,
        every: float = 10_000.0,
        level: float = 0.05,
        reference: Any = None,
        **settings: Any,
    ) -> ManyAlarms:
        """Alarms of all runs, one false alarm in ``every`` samples of all together, and which runs had a fault.

        ``level`` is a false discovery rate; ``reference`` is one for all runs or a mapping from every key to its own.
        Kinds and other settings are those of `driftfit.judge.alarms.detect`.
        """
        from driftfit.judge.alarms.many import alarms

        return alarms(self._runs(), kind, every=every, level=level, reference=reference, **settings)

    def report(
        self,
        path: str | PathLike[str],
        title: str | None = None,
        *,
        alarms: ManyAlarms | None = None,
        labels: Mapping[Hashable, Array] | None = None,
    ) -> None:
        """Write one self-contained HTML page with all runs in one table, and pictures of the clearest.

        ``alarms`` of `detect`, and ``labels`` by key, true where something was wrong, have a separate section.
        """
        from driftfit.show.report import check_path
        from driftfit.show.report_many import page_of_many

        text = page_of_many(self._runs(), title, getattr(self, "failed", {}), alarms, labels)
        check_path(path).write_text(text, encoding="utf-8")


class Judged:
    """Methods of a run. Each is implemented in its own module, which is imported when it is called."""

    def verdict(self, level: float = 0.05, lags: int | None = None, burn: int | None = None) -> Verdict:
        """Is the time variation real, which parameters move, and does tracking them pay? See
        `driftfit.judge.verdict`.
        """
        from driftfit.judge.verdict import verdict

        return verdict(cast("Track", self), level, lags, burn)

    def segment(self, **settings: Any) -> Segmentation:
        """Segments of the record with constant parameters, with dates and their intervals; `driftfit.segment`."""
        from driftfit.judge.segment import segmented

        return segmented(cast("Track", self), **settings)

    def diagnose(self) -> Diagnosis:
        """Whiteness, noise level, distribution, excitation, constancy, with limits; see `driftfit.judge.diagnose`."""
        from driftfit.judge.diagnose import diagnose

        return diagnose(cast("Track", self))

    def ahead(self, k: int) -> Prediction:
        """Every output predicted from k samples before it, given the inputs; see `driftfit.use.simulate`."""
        from driftfit.use.simulate import ahead

        return ahead(cast("Track", self), k)

    def simulate(self, u: Any, at: int = -1, y: Any = None) -> Prediction:
        """Outputs that inputs u would cause in the system at a sample, with bands; see `driftfit.use.simulate`."""
        from driftfit.use.simulate import simulate

        return simulate(cast("Track", self), u, at, y)

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
        from driftfit.use.crossing import crossing

        return crossing(cast("Track", self), what, below=below, above=above, horizon=horizon, u=u, level=level)

    def poles(self, at: Any = None) -> Array:
        """Poles of the ARX system at every sample, (T, na), the largest first; see `driftfit.use.system`."""
        from driftfit.use.system import poles

        return poles(cast("Track", self), at)

    def largest_pole(self, at: Any = None) -> Response:
        """Magnitude (T,) of the largest pole, with its standard deviation; below 1 the system is stable."""
        from driftfit.use.system import largest_pole

        return largest_pole(cast("Track", self), at)

    def dc_gain(self, at: Any = None) -> Response:
        """Static gain (T, m) of every input, with its standard deviation."""
        from driftfit.use.system import dc_gain

        return dc_gain(cast("Track", self), at)

    def step_response(self, h: int, input: int | str = 0, at: Any = -1) -> Response:
        """Response (., h) to a unit step of an input, at the samples ``at`` (None: all), with std."""
        from driftfit.use.system import step_response

        return step_response(cast("Track", self), h, input, at)

    def impulse_response(self, h: int, input: int | str = 0, at: Any = -1) -> Response:
        """Response (., h) to a unit impulse of an input, at the samples ``at`` (None: all), with std."""
        from driftfit.use.system import impulse_response

        return impulse_response(cast("Track", self), h, input, at)

    def frequency_response(self, w: Any = None, input: int | str = 0, at: Any = -1) -> FrequencyResponse:
        """Magnitude and phase at w radians per sample, with std; see `driftfit.use.system`."""
        from driftfit.use.system import frequency_response

        return frequency_response(cast("Track", self), w, input, at)

    def to_scipy(self, at: int = -1, dt: float = 1.0, input: int | str = 0) -> Any:
        """The system at a sample as `scipy.signal.dlti`, from one input to y."""
        from driftfit.use.system import to_scipy

        return to_scipy(cast("Track", self), at, dt, input)

    def long_run(self, at: int = -1, level: float = 0.95) -> tuple[LongRun, ...]:
        """Long-run effect b / (1 - a) of every input, with standard error and Fieller's interval."""
        from driftfit.use.system import long_run

        return long_run(cast("Track", self), at, level)

    def detect(self, kind: str | AlarmRule = "band", **settings: Any) -> Alarms:
        """Alarms at a set rate of false alarms, one in ``every`` samples; see `driftfit.judge.alarms.detect`.

        ``kind`` may also be the rule of another run, ``alarms.rule``.
        """
        from driftfit.judge.alarms.detect import detect

        return detect(cast("Track", self), kind, **settings)

    def plot_system(self, input: int | str = 0, at: Any = None, **settings: Any) -> Figure:
        """Step and frequency response over time with bands, poles in the plane, gain; see
        `driftfit.use.system_plots`.
        """
        from driftfit.use.system_plots import plot_system

        return plot_system(cast("Track", self), input, at, **settings)

    def plot_validation(self, y: Any, u: Any = None, at: int = -1, level: float = 0.95) -> Figure:
        """Simulated and measured outputs of a record that was not used, with bands and the fit in per cent."""
        from driftfit.use.system_plots import plot_validation

        return plot_validation(cast("Track", self), y, u, at, level)

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
        from driftfit.show.report import report

        report(cast("Track", self), path, title, alarms, labels)
