"""Check the types of the arguments model and tracker; messages recognise a class in place of an instance, and a wrong
order."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from inspect import signature
from typing import Any

from driftfit.engine.settings import Settings
from driftfit.models.base import Model
from driftfit.trackers.base import Tracker

ARTICLE = {Model: "a model, such as ARX(2, 2) or Regression(3)", Tracker: "a tracker, such as AdaptiveKalman()"}


def check_roles(owner: str, model: Any, tracker: Any, several: bool = False) -> bool:
    """Whether ``tracker`` is one `Tracker`, and not, with ``several``, a list or mapping of them.

    Raises TypeError for anything else, and unless ``model`` is a `Model`. The message says what was passed, and what to
    write instead.
    """
    kinds: tuple[type, type] = type(model), type(tracker)
    if _fit(*kinds):
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
def _fit(model: type, tracker: type) -> bool:
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
    return f"{text if len(text) < 60 else f'{text[:57]}...'}, a {type(value).__name__}"
