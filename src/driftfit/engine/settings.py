"""Settings: frozen dataclasses whose values are checked at construction and can be written down as plain data.

Also the conversion of other numbers that users pass: arrays of floats, missing values as NaN, factors of variances.
"""

from __future__ import annotations

import math
import sys
import warnings
from collections.abc import Collection, Hashable, Iterable, Mapping, Sequence
from dataclasses import fields
from difflib import get_close_matches
from importlib import import_module
from inspect import isabstract
from pkgutil import walk_packages
from typing import Any, Self

import numpy as np

from driftfit.engine.drivers import ROUNDING
from driftfit.engine.kernel import Array


class DataWarning(UserWarning):
    """A property of the data that makes a result less reliable than it seems; the message names it and the remedy."""


def warn(message: str, kind: type[Warning] = DataWarning) -> None:
    """Warn of data, at the line of the user's program that called the library."""
    level, frame = 2, sys._getframe(1)
    while frame.f_back is not None and frame.f_globals.get("__name__", "").split(".")[0] == "driftfit":
        level, frame = level + 1, frame.f_back
    warnings.warn(message, kind, stacklevel=level)


class Settings:
    """Base of models and trackers: a frozen dataclass, equal by value, hashable, saved without pickle."""

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        if "__repr__" not in vars(cls):  # a dataclass does not replace a method that its class defines
            cls.__repr__ = Settings.__repr__  # type: ignore[method-assign]

    def __repr__(self) -> str:
        """The expression that constructs it again: settings without a default, and those that differ from it."""
        own = [field for field in fields(self) if field.init]  # type: ignore[arg-type]
        given = [f"{f.name}={getattr(self, f.name)!r}" for f in own if getattr(self, f.name) != f.default]
        return f"{type(self).__name__}({', '.join(given)})"

    def settings(self) -> dict[str, Any]:
        """The fields as plain data (numbers, strings, None, nested tuples)."""
        return {field.name: getattr(self, field.name) for field in fields(self) if field.init}  # type: ignore[arg-type]

    def _set(self, name: str, value: Any) -> None:
        """Write a normalised value into a frozen field; for ``__post_init__`` only."""
        object.__setattr__(self, name, value)

    @classmethod
    def from_settings(cls, settings: dict[str, Any]) -> Self:
        """The inverse of `settings`, also after a passage through JSON (lists become tuples)."""
        return cls(**{name: _tuples(value) for name, value in settings.items()})


def _tuples(value: Any) -> Any:
    return tuple(_tuples(v) for v in value) if isinstance(value, list | tuple) else value


def place_of(made: Any) -> str:
    """The module and name of a class or function, as files name it."""
    source = getattr(made, "py_func", made)
    return f"{source.__module__}:{source.__qualname__}"


def plain(value: Any) -> Any:
    """A number, sequence or array as float, tuple of floats, or tuple of tuples, so that it hashes and prints."""
    array = np.asarray(value, dtype=float)
    return float(array) if array.ndim == 0 else _tuples(array.tolist())


def numbers(owner: str, name: str, value: Any, *, ndim: int = 1, low: float = -math.inf, strict: bool = False) -> Any:
    """Check that value is a number, or an array of at most ``ndim`` axes, all finite and above ``low``.

    Returns the value as plain data; raises ValueError that names the setting, the value and the rule.
    """
    try:
        array = np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        raise ValueError(f"{owner}: {name} must be numeric; got {value!r}.") from None
    if array.ndim > ndim:
        raise ValueError(f"{owner}: {name} has {array.ndim} axes, shape {array.shape}; at most {ndim} are allowed.")
    if array.ndim < 2 or low == -math.inf:
        bad = ~np.isfinite(array) | (array <= low if strict else array < low)
        rule = "finite" if low == -math.inf else f"finite and {'above' if strict else 'at least'} {low:g}"
        if bad.any():
            raise ValueError(f"{owner}: {name} must be {rule}; got {value!r}.")
    elif not np.isfinite(array).all():
        raise ValueError(f"{owner}: {name} must be finite; got {value!r}.")
    return plain(array)


def covariance(owner: str, name: str, value: Any) -> Any:
    """Check a covariance given as a number, variances (n,), or a matrix (n, n): finite, symmetric, not negative."""
    checked = numbers(owner, name, value, ndim=2, low=0.0)
    array = np.asarray(checked)
    if array.ndim == 2:
        if array.shape[0] != array.shape[1]:
            raise ValueError(f"{owner}: {name} must be square as a matrix; got shape {array.shape}.")
        spread = float(np.abs(array).max(initial=0.0))
        if not np.allclose(array, array.T, rtol=0.0, atol=ROUNDING * spread):
            raise ValueError(f"{owner}: {name} must be symmetric; the given matrix is not.")
        lowest = float(np.linalg.eigvalsh(array).min(initial=0.0))
        if lowest < -ROUNDING * spread:
            raise ValueError(
                f"{owner}: {name} must be positive semi-definite; the given matrix has an eigenvalue {lowest:.3g}."
            )
    return checked


def check_numbers(
    of: Settings, covariances: Sequence[str] = (), positive: Sequence[str] = (), values: Sequence[str] = ()
) -> None:
    """Check and normalise settings: covariances, positive numbers, and numbers; None is accepted as a default."""
    kind = type(of)
    for name in (*covariances, *positive, *values):
        value = getattr(of, name)
        if value is None and getattr(kind, name) is None:
            continue
        if name in covariances:
            of._set(name, covariance(kind.__name__, name, value))
        else:
            rule = {"ndim": 0, "low": 0.0, "strict": True} if name in positive else {}
            of._set(name, numbers(kind.__name__, name, value, **rule))  # type: ignore[arg-type]


def vector(owner: str, name: str, value: Any, n: int) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Spread a number over n entries, or check that a sequence has n of them."""
    array = np.asarray(value, dtype=float)
    if array.ndim == 0:
        return np.full(n, float(array))
    if array.shape != (n,):
        raise ValueError(
            f"{owner}: {name} has shape {array.shape}, but the model has {n} parameters: give a number or {n}."
        )
    return array


def matrix(owner: str, name: str, value: Any, n: int) -> np.ndarray[Any, np.dtype[np.float64]]:
    """A covariance as a full matrix: a number means that number times the identity, never a full array of it."""
    array = np.asarray(value, dtype=float)
    if array.ndim < 2:
        return np.diag(vector(owner, name, value, n))
    if array.shape != (n, n):
        raise ValueError(f"{owner}: {name} has shape {array.shape}, but the model has {n} parameters: give ({n}, {n}).")
    return array


def whole(owner: str, name: str, value: Any, low: int) -> int:
    """Check a whole number of at least ``low``."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < low:
        raise ValueError(f"{owner}: {name} must be a whole number of at least {low}; got {value!r}.")
    return int(value)


def one_of(owner: str, name: str, value: str, choices: Sequence[str]) -> str:
    """Check a choice."""
    if value not in choices:
        raise ValueError(f"{owner}: {name} must be one of {', '.join(map(repr, choices))}; got {value!r}.")
    return value


def missing_settings(owner: Settings) -> list[str]:
    """Names of settings that were left None although they have no default meaning, those of its ``laws`` too."""
    missing = [name for name in getattr(owner, "required", ()) if getattr(owner, name) is None]
    laws = getattr(owner, "laws", None) or ()
    return missing + [f"{law.title}[{name}].{one}" for name, law in laws for one in missing_settings(law)]


def classes_in(package: str, path: Iterable[str], kind: type) -> dict[str, Any]:
    """The classes of a kind that a package and the packages in it hold, by class name; abstract ones are left out."""
    classes = {}
    for module in walk_packages(path, f"{package}."):
        for value in vars(import_module(module.name)).values():
            if isinstance(value, type) and issubclass(value, kind) and not isabstract(value):
                classes[value.__name__] = value
    return dict(sorted(classes.items()))


def near(wrong: str, known: Collection[str]) -> str:
    """A sentence that helps with a wrong name: the nearest right ones, else all of them."""
    by_lower = {name.lower(): name for name in known}
    close = [by_lower[name] for name in get_close_matches(wrong.lower(), by_lower, n=3)]
    return f"did you mean {' or '.join(close)}?" if close else f"there is {', '.join(known) or 'none'}."


def of_series(owner: str, name: str, given: Any, keys: Collection[Hashable], every: bool = False) -> None:
    """Check a mapping from the key of a series to a value, with ``every`` for all of them; other values pass.

    A series without a value, and a value without a series, are usually one mistake: 7 and '7'.
    """
    absent = [key for key in keys if key not in given] if isinstance(given, Mapping) else []
    unknown = [key for key in given if key not in keys] if absent else []
    if absent and (every or unknown):
        instead = f", but the key {unknown[0]!r}, which no series has" if unknown else ""
        raise ValueError(f"{owner}: {name} has no {absent[0]!r}{instead}; give one for all series, or one for each.")


def input_names(owner: str, name: str, given: Sequence[str]) -> tuple[str, ...]:
    """Names of inputs, each once: parameters and columns of tables are called after them."""
    names = tuple(str(one) for one in given)
    if len(set(names)) < len(names):
        raise ValueError(f"{owner}: {name} must be different names; got {names!r}.")
    return names


def output_names(owner: str, ny: Any) -> tuple[str, ...]:
    """Names of the outputs, given their number or the names themselves: ("y",), or ("y1", "y2", ..)."""
    if type(ny) is int and ny == 1:
        return ("y",)
    if isinstance(ny, int | np.integer):
        count = whole(owner, "ny", ny, 1)
        return ("y",) if count == 1 else tuple(f"y{i + 1}" for i in range(count))
    names = (ny,) if isinstance(ny, str) else tuple(str(name) for name in ny)
    if not names or len(set(names)) < len(names):
        raise ValueError(f"{owner}: ny must be the number of outputs or their names, all different; got {ny!r}.")
    return names


ABSENT = ("", "None", "NaT", "<NA>")
"""How what holds no value is written: an empty text, None, and the NaT and NA of pandas and NumPy."""


def as_numbers(name: str, values: Any) -> Array:
    """Values as floats; `ABSENT` and masked entries become NaN, whole numbers beyond all floats infinite.

    For text the error names its position.
    """
    if isinstance(values, (np.ndarray, np.generic)):  # a union of types would take four times as long
        if isinstance(values, np.ma.MaskedArray):
            values = np.ma.filled(values.astype(float), np.nan)
        elif values.dtype.kind in "mM":  # no dates as nanoseconds
            values = values.astype(str)
        elif values.dtype.kind == "c":
            raise ValueError(f"{name} is complex; give its real and imaginary parts as two signals.")
    try:
        return np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        pass
    given = np.asarray(values, dtype=object)
    out = np.empty(given.shape)
    for place, value in np.ndenumerate(given):
        try:
            out[place] = np.nan if str(value) in ABSENT else float(value)
        except OverflowError:  # a whole number beyond all floats
            out[place] = math.inf if value > 0 else -math.inf
        except (TypeError, ValueError):
            where = f"{name}: entry {place[0] if len(place) == 1 else place}" if place else name
            raise ValueError(f"{where} is {value!r}, which is not a number.") from None
    return out


def marks(owner: str, labels: Any, T: int) -> Array:
    """Labels (T,) of samples, 0 or 1, as truth values; a missing one is false, as where nothing is marked."""
    values = as_numbers("labels", labels)
    if values.shape != (T,):
        raise ValueError(f"{owner}: labels have shape {values.shape}, but the record has {T} samples.")
    odd = np.flatnonzero((values != 0.0) & (values != 1.0) & ~np.isnan(values))
    if len(odd):
        raise ValueError(f"{owner}: labels are 0 or 1 (or true, false); that of sample {odd[0]} is {values[odd[0]]:g}.")
    return np.asarray(values == 1.0)


def axes(value: Any) -> int:
    """The number of axes of what a user passed; for a number, which most pass, at a tenth of the cost."""
    return 0 if type(value) is float else np.ndim(value)


def factor(name: str, value: Any, T: int | None = None) -> Any:
    """A known factor of a variance: finite and not negative, one number or one per sample."""
    if type(value) is float and 0.0 <= value < math.inf:  # what most calls give, at a tenth of the cost
        return value
    array = as_numbers(name, value)
    if array.ndim > 1 or (array.ndim == 1 and len(array) != T):
        raise ValueError(f"{name} must be one number or one per sample ({T}); got shape {array.shape}.")
    if not (np.isfinite(array) & (array >= 0.0)).all():
        raise ValueError(f"{name} must be finite and not negative everywhere.")
    return array
