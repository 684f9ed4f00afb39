"""What users pass: models and trackers, arrays of numbers, series and data frames with their names and index.

Messages recognise a class in place of an instance, and a wrong order of model and tracker. Series and data frames may
be anything that narwhals reads (pandas, polars, pyarrow), or mappings from name to column. Columns are matched with the
inputs of a model by name if both have names. Rows are matched by position; if two indices of pandas differ, the rows do
not match and an error is raised. An index of dates becomes the labels of the samples.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from inspect import signature
from typing import Any, NamedTuple, TypeVar

import numpy as np

from driftfit.data.clock import LABEL, Clock
from driftfit.data.instants import instants, warn_of_counted_years, warn_of_written_numbers, zone_name
from driftfit.engine.kernel import Array
from driftfit.engine.settings import Settings, as_numbers, factor, missing_settings, warn
from driftfit.models.base import Model
from driftfit.trackers.base import Tracker

ARTICLE = {Model: "a model, such as ARX(2, 2) or Regression(3)", Tracker: "a tracker, such as AdaptiveKalman()"}


def check_roles(owner: str, model: Any, tracker: Any, several: bool = False) -> bool:
    """Whether ``tracker`` is one `Tracker`, and not, with ``several``, a list or mapping of them.

    Raises TypeError for anything else, and unless ``model`` is a `Model`. The message says what was passed, and what to
    write instead.
    """
    kinds: tuple[type, type] = type(model), type(tracker)
    if fits(*kinds):
        return True
    if _is(model, Tracker) and _is(tracker, Model):
        raise TypeError(
            f"{owner}: model and tracker are in the wrong order; the model comes first: "
            f"{owner}({_called(tracker)}, {_called(model)}, ...)."
        )
    check_role(owner, "model", model, Model)
    given = tracker.values() if isinstance(tracker, Mapping) else tracker
    listed = several and isinstance(given, Sequence | type({}.values())) and not isinstance(given, str)
    for one in given if listed else [tracker]:
        for own in one.values() if several and isinstance(one, Mapping) else [one]:
            check_role(owner, "tracker", own, Tracker)
    return False


@lru_cache(maxsize=256)
def fits(model: type, tracker: type) -> bool:
    """Whether these are a model and a tracker; asked once for each pair, because abstract classes answer slowly."""
    return issubclass(model, Model) and issubclass(tracker, Tracker)


def check_role(owner: str, name: str, value: Any, kind: type[Settings]) -> None:
    """Raise TypeError unless ``value`` is an instance of ``kind``."""
    if isinstance(value, kind):
        return
    if isinstance(value, type) and issubclass(value, kind):
        raise TypeError(f"{owner}: {name} is the class {value.__name__} itself; create an instance: {_called(value)}.")
    raise TypeError(f"{owner}: {name} must be {ARTICLE[kind]}; got {_shown(value)}.")


def _is(value: Any, kind: type) -> bool:
    return isinstance(value, kind) or (isinstance(value, type) and issubclass(value, kind))


def _called(value: Any) -> str:
    """The expression that makes an instance; for a class, one with its required settings."""
    if not isinstance(value, type):
        return repr(value)
    needed = [p.name for p in signature(value).parameters.values() if p.default is p.empty]
    needed += [name for name in getattr(value, "required", ()) if name not in needed]
    return f"{value.__name__}({', '.join(f'{name}=...' for name in needed)})"


def _shown(value: Any) -> str:
    """A short description of what was passed."""
    if value is None:
        return "None"
    if isinstance(getattr(value, "shape", None), tuple):
        return f"an array of shape {tuple(value.shape)}"
    text = repr(value)
    return f"{text if len(text) < 60 else f'{text[:57]}...'} ({type(value).__name__})"


PLAIN = (np.ndarray, list, tuple, float, int)
"""Types that have neither names nor an index."""


class Held(NamedTuple):
    """What a user passed: values as an array, names of its columns (may be empty), and its index or None."""

    values: Any
    names: tuple[str, ...] = ()
    index: Any = None


NOTHING = Held(None)
"""What was not passed."""


def held(what: str, given: Any) -> Held:
    """Values (T,) or (T, m) with their names, from anything that a user may pass."""
    if given is None or isinstance(given, PLAIN):
        return Held(given)
    if isinstance(given, Mapping):
        parts = {str(name): held(f"{what}[{name!r}]", column) for name, column in given.items()}
        together(**parts)
        index = next((part.index for part in parts.values() if part.index is not None), None)
        return Held(np.column_stack([part.values for part in parts.values()]), tuple(parts), index)
    import narwhals as nw  # this import takes as long as all others together

    try:
        frame = nw.from_native(given, pass_through=True, allow_series=True)
    except nw.exceptions.DuplicateError as error:
        raise ValueError(f"{what}: column names must be different. {error}") from None
    if isinstance(frame, nw.LazyFrame):
        frame = frame.collect()
    if not isinstance(frame, nw.Series | nw.DataFrame):
        return Held(given)
    from driftfit.data.columns import numbers_of

    index = getattr(given, "index", None) if frame.implementation.is_pandas_like() else None
    if isinstance(frame, nw.Series):
        return Held(numbers_of(frame, what, 0), _names([frame.name]), index)
    columns = [numbers_of(frame[:, j], what, 0) for j in range(frame.shape[1])]
    return Held(np.column_stack([np.zeros((len(frame), 0)), *columns]), _names(frame.columns), index)


def _names(given: Sequence[Any]) -> tuple[str, ...]:
    """Names of columns; no names at all if one of them is not text, such as the numbers that pandas gives to unnamed
    columns.
    """
    return tuple(given) if all(isinstance(name, str) and name for name in given) else ()


def together(**parts: Held) -> None:
    """ValueError if the indices of signals of one length differ, because their rows then do not match."""
    first, other = "", NOTHING
    for name, part in parts.items():
        if part.index is None:
            continue
        if other.index is None:
            first, other = name, part
            continue
        if len(part.index) != len(other.index) or part.index.equals(other.index):
            continue
        row = int(np.argmax(np.asarray(part.index != other.index)))
        same = part.index.sort_values().equals(other.index.sort_values())
        way = f"{name} = {name}.loc[{first}.index]" if same else f"{first}, {name} = {first}.align({name}, 'inner', 0)"
        raise ValueError(
            f"the rows of {first} and {name} do not match: in row {row} their indices are "
            f"{other.index[row]} and {part.index[row]}. Align them by label with {way}, or by position with "
            f"{name}.to_numpy()."
        )


class Times(NamedTuple):
    """When the samples were taken: times (T,) or None, their zone and name, and whether they are only labels."""

    axis: Array | None = None
    zone: str | None = None
    name: str | None = None
    labels: bool = False


def times_of(time: Any, parts: Sequence[Held], dt: Any = None) -> Times:
    """The times that a user passed, or the first index of dates among the signals."""
    if time is None:
        for part in parts:
            if part.index is not None and dated(part.index):
                if dt is None:
                    warn_of_skipped_periods(part.index)
                return _dates(part.index)._replace(labels=True)
        return Times()
    if dated(time):
        return _dates(time)
    if isinstance(time, np.ndarray | list | tuple):
        return Times(*instants(time))
    import narwhals as nw

    series = nw.from_native(time, pass_through=True, allow_series=True)
    if not isinstance(series, nw.Series):
        return Times(*instants(time))
    from driftfit.data.columns import times_of_column

    axis, zone = times_of_column(series, "time", 0)
    return Times(axis, zone, (_names([series.name]) or (None,))[0])


def dated(index: Any) -> bool:
    """Whether the index consists of dates or of periods."""
    return hasattr(index, "to_series") and (hasattr(index, "to_timestamp") or getattr(index.dtype, "kind", "") == "M")


def warn_of_order(name: str) -> None:
    """Warn that rows were sorted by dates that nobody named as the time."""
    warn(
        f"data: the rows are not in the order of {name!r}, and are sorted by it; sort the table, or give "
        f"time={name!r}, to avoid this warning."
    )


def warn_of_repeats(count: int, rows: int) -> None:
    """Warn that ``count`` rows were left out."""
    warn(
        f"time: {count} of {rows} rows repeat the time of another row and are left out. Give times of a finer clock, "
        "by= the column that tells series apart, or the mean of the rows at each time; local times that repeat the "
        "hour at the end of summer time need their zone, such as 2024-10-27 02:30+01:00, or UTC."
    )


def chronological(index: Any) -> Array | slice:
    """The rows sorted by an index of dates, of several with one date the first; all of them if it holds no dates.

    Warns if they are not in order, or left out.
    """
    if not dated(index) or (index.is_monotonic_increasing and index.is_unique):
        return slice(None)
    if not index.is_monotonic_increasing:
        warn_of_order(index.name if isinstance(index.name, str) else "index")
    order = np.argsort(index.asi8, kind="stable")
    again = np.append(False, np.diff(index.asi8[order]) == 0)
    if again.any():
        warn_of_repeats(int(again.sum()), len(index))
    return np.asarray(order[~(again | index.isna()[order])])


PERIODS = {"Q": "quarter", "M": "month", "Y": "year", "A": "year"}
"""The step of the calendar, as `dt` names it, by the first letter of the frequency of an index of periods.

Days are not among them: an index of days usually leaves out weekends on purpose.
"""


def warn_of_skipped_periods(index: Any) -> None:
    """Warn if an index of periods, which labels samples that are one step apart, leaves some periods out."""
    step = PERIODS.get(str(getattr(index, "freqstr", ""))[:1])
    if not hasattr(index, "to_timestamp") or step is None or len(index) < 2:
        return
    steps = np.diff(index.asi8)
    if (places := np.flatnonzero(steps > 1)).size:
        warn(
            f"time: the index leaves out {int((steps[places] - 1).sum())} periods, the first after {index[places[0]]}, "
            f"but its samples are taken as one step apart, also by lags. Give dt={step!r}, or dt='label' if that is "
            "meant."
        )


def _dates(index: Any) -> Times:
    stamps = index.to_timestamp() if hasattr(index, "to_timestamp") else index
    zone = getattr(stamps, "tz", None)
    return Times(
        np.asarray(stamps.tz_convert(None) if zone is not None else stamps),
        None if zone is None else zone_name(zone),
        index.name if isinstance(index.name, str) else None,
    )


def order_of(owner: str, wanted: Sequence[str], given: Sequence[str], what: str = "inputs") -> list[int]:
    """The position of each wanted name among the given ones; ValueError if the two sets of names differ."""
    letter = "u" if what == "inputs" else "y"
    absent = [name for name in wanted if name not in given]
    more = [name for name in given if name not in wanted]
    if not absent and not more:
        return [list(given).index(name) for name in wanted]
    problems = [f"{absent[0]!r} is missing"] if absent else []
    problems += [f"{more[0]!r} is none of them"] if more else []
    raise ValueError(
        f"{owner} has the {what} {', '.join(wanted)}, but {letter} has the columns {', '.join(given)}; "
        f"{'; '.join(problems)}. Named signals are matched by name: rename or select columns, or give {letter} as an "
        "array to match by position."
    )


def ordered(model: Any, u: Array, names: Sequence[str]) -> tuple[Array, tuple[str, ...]]:
    """The columns of u (T, m) and their names, in the order of the inputs of a model, if both have names."""
    if not names:
        return u, ()
    wanted = model.input_names
    if not wanted or tuple(names) == wanted:
        return u, tuple(names)
    return np.ascontiguousarray(u[:, order_of(type(model).__name__, wanted, names)]), wanted


def inputs_for(model: Any, u: Any, T: int) -> Array:
    """Inputs (T, m) in the order of a model, from an array, a data frame or a mapping."""
    given = held("u", u)
    if len(shape := np.shape(given.values)) and shape[0] != T:
        raise ValueError(f"u has shape {shape}, but {T} samples are asked for: the first axis must be time.")
    return ordered(model, as_inputs(given.values, T), given.names)[0]


def by_name(model: Any, u: Any) -> Any:
    """One sample of inputs in the order of the model: a mapping or a labelled row by name, anything else unchanged."""
    if not hasattr(u, "keys"):
        return u
    given = tuple(u.keys())
    if not all(isinstance(name, str) for name in given):
        return np.asarray(u)
    if not model.input_names:
        raise ValueError(
            f"u names its values ({', '.join(given)}), but the inputs of the model have no names; give them, as in "
            "ARX(2, 1, inputs=[..]) or Regression([..]), or give u as numbers in order."
        )
    order_of(type(model).__name__, model.input_names, given)
    return [u[name] for name in model.input_names]


S = TypeVar("S", bound=Settings)


def check_ready(tracker: S) -> S:
    """Raise an error for a tracker with missing settings."""
    missing = missing_settings(tracker)
    if missing:
        name = type(tracker).__name__
        raise ValueError(
            f"{name}: {', '.join(missing)} must be given: {name}({', '.join(f'{m}=...' for m in missing)})."
        )
    return tracker


def as_output(y: Any) -> Array:
    """The output as an array (T,)."""
    array = as_numbers("y", y)
    if array.ndim == 2 and array.shape[1] == 1:
        array = array[:, 0]
    if array.ndim != 1:
        hint = " Several outputs are for a model with ny=; elsewhere take one column." if array.ndim == 2 else ""
        raise ValueError(f"y must have one axis, (T,); got shape {array.shape}.{hint}")
    if len(array) == 0:
        raise ValueError("y is empty: there is nothing to track.")
    return array


def as_inputs(u: Any, T: int) -> Array:
    """The inputs as an array (T, m); None means that there are none."""
    if u is None:
        return np.zeros((T, 0))
    array = as_numbers("u", u)
    if array.ndim == 1:
        array = array[:, None]
    if array.ndim != 2:
        raise ValueError(f"u must be (T,) or (T, m); got shape {array.shape}.")
    if len(array) != T:
        hint = f" u.T has shape {array.T.shape}." if array.shape[1] == T else ""
        raise ValueError(f"y has {T} samples but u has shape {array.shape}: the first axis must be time.{hint}")
    return array


def noise_of(weights: Any, T: int | None = None) -> Any:
    """Factor of the noise variance, 1 / w; a weight of 0 makes it infinite, which makes the sample unusable."""
    given = factor("weights", weights, T)
    if type(weights) is float and weights > 0.0:
        return 1.0 / weights
    with np.errstate(divide="ignore"):
        return np.divide(1.0, given)


def intervals(time: Any, dt: Any, T: int) -> tuple[Array, Array]:
    """(time, nominal intervals (T,)) of a record; the first interval is 1. Unsorted or repeated times raise errors."""
    axis, _ = instants(time)
    if axis.shape != (T,):
        raise ValueError(f"time has shape {axis.shape}, but y has {T} samples.")
    bad = np.flatnonzero(~(axis[1:] > axis[:-1])) + 1
    if bad.size:
        i = int(bad[0])
        raise ValueError(
            f"time must increase: time[{i - 1}] = {axis[i - 1]} is followed by time[{i}] = {axis[i]}; "
            "sort the record and drop repeated times first."
        )
    clock = Clock.of(dt)
    warn_of_counted_years(axis)
    if clock.kind != LABEL:
        warn_of_written_numbers(axis)
    return axis, clock.steps(axis)
