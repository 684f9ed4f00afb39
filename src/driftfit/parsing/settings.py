"""Models and trackers from text, as on the command line: ``arx:2,2,nk=1``, or an expression ``ARX(2, 2, nk=1)``."""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from dataclasses import MISSING, Field, fields
from importlib import import_module
from typing import Any, TypeVar

from driftfit import models, trackers
from driftfit.engine.settings import Settings, near
from driftfit.models.base import Model
from driftfit.parsing import expressions
from driftfit.trackers.base import Tracker

Kind = TypeVar("Kind", bound=Settings)


def given_fields(kind: type[Settings]) -> list[Field[Any]]:
    """The settings of a model or tracker, in the order of their positions."""
    return [field for field in fields(kind) if field.init]  # type: ignore[arg-type]


def default(field: Field[Any]) -> str:
    """The default of a setting as a user would type it in Python."""
    if isinstance(field.default, float):
        return f"{field.default:g}"
    if field.default is not MISSING:
        return repr(field.default)
    return "..." if field.default_factory is MISSING else repr(field.default_factory())


def lookup(what: str, name: str, known: dict[str, type[Kind]]) -> type[Kind]:
    """A class by its name, in upper or lower case, with - or _ between words."""
    plain = {key.lower(): kind for key, kind in known.items()}
    wanted = re.sub(r"[-_\s]", "", name).lower()
    if wanted not in plain:
        raise ValueError(f"there is no {what} {name!r}: {near(wanted, known)}")
    return plain[wanted]


def parse_model(text: str) -> Model:
    """``arx:2,2,nk=1,intercept`` as ARX(2, 2, nk=1, intercept=True).

    An expression such as ``ARX(2, 2)`` is read as well. ValueError with the reason if the text is wrong.
    """
    if "(" in text:
        return expressions.read(text, Model, models.found())  # type: ignore[type-abstract]
    name, _, rest = text.partition(":")
    kind = lookup("model", name, models.found())
    known = {field.name: field for field in given_fields(kind)}
    places = [key for key, field in known.items() if field.type not in ("bool", bool)]
    settings: dict[str, Any] = {}
    for position, entry in enumerate(entry.strip() for entry in rest.split(",") if entry.strip()):
        key, is_named, value = entry.partition("=")
        key = key.strip()
        if not is_named and key not in known:
            if not re.fullmatch(r"[\d./]+", key):
                raise ValueError(f"model {text}: {key!r} is neither a number nor a setting; {near(key, known)}")
            if position >= len(places):
                raise ValueError(f"model {text}: too many numbers; {kind.__name__} takes {', '.join(known)}.")
            key, value = places[position], key
        add_setting(f"model {text}", settings, known, key, parse_value(value, "/") if value else True)
    return build(f"model {text}", kind, settings)


def own_tracker(place: str) -> type[Tracker]:
    """The class that ``module:Class`` names; modules in the current folder are found."""
    module, _, name = place.partition(":")
    if not module or not name:
        raise ValueError(f"tracker {place}: name the module and the class, such as mine:MyTracker.")
    sys.path.insert(0, "")
    kind = getattr(import_module(module), name, None)
    if not (isinstance(kind, type) and issubclass(kind, Tracker)):
        raise ValueError(f"tracker {place}: {module} has no Tracker of the name {name}.")
    return kind


def parse_tracker(name: str, given: Sequence[str], own: str | None = None) -> Tracker:
    """A tracker from its name, or its place in a user's module, and ``key=value`` settings; or from an expression."""
    if "(" in name:
        if given:
            raise ValueError(f"tracker {name} has its settings in the brackets; leave {given[0]} out.")
        return expressions.read(name, Tracker, trackers.found())  # type: ignore[type-abstract]
    kind = own_tracker(own) if own else lookup("tracker", name, trackers.found())
    known = [field.name for field in given_fields(kind)]
    settings: dict[str, Any] = {}
    for entry in given:
        key, is_named, value = entry.partition("=")
        if not is_named or not value.strip():
            raise ValueError(f"setting {entry} of the tracker: write name=value, such as {known[0]}=1e-4.")
        others = [other for other, at in trackers.found().items() if key.strip() in {f.name for f in given_fields(at)}]
        if key.strip() not in known and others:
            raise ValueError(
                f"setting {entry}: {kind.__name__} has no setting {key.strip()!r}; that is one of {', '.join(others)}."
            )
        add_setting(f"setting {entry}", settings, known, key.strip(), parse_value(value, ","))
    return build(f"tracker {own or name}", kind, settings)


def tracker_of(text: str) -> Tracker:
    """A tracker from one text, ``Kalman(q=1e-4, r=0.1)`` or ``kalman:q=1e-4;r=0.1``; ValueError with the reason if it
    is wrong.
    """
    if "(" in text:
        return parse_tracker(text, [])
    name, _, settings = text.partition(":")
    return parse_tracker(name, [one for one in settings.split(";") if one.strip()])


def add_setting(where: str, settings: dict[str, Any], known: Any, key: str, value: Any) -> None:
    """Store a setting under an existing name; it may be given only once."""
    if key not in known:
        raise ValueError(f"{where}: there is no setting {key!r}; {near(key, known)}")
    if key in settings:
        raise ValueError(f"{where}: {key} is given twice.")
    settings[key] = value


def build(where: str, kind: type[Kind], settings: dict[str, Any]) -> Kind:
    """Construct a model or tracker; a wrong or missing value is reported as the user's error."""
    try:
        return kind(**settings)
    except TypeError as error:
        raise ValueError(f"{where}: {str(error).replace('.__init__()', '')}.") from None


def parse_value(text: str, separator: str) -> Any:
    """A number, several numbers with the separator between them, true, false, none, or otherwise the text itself."""
    words = {"none": None, "true": True, "false": False}
    text = text.strip()
    if text.lower() in words:
        return words[text.lower()]
    if separator in text:
        return tuple(parse_value(part, separator) for part in text.split(separator) if part.strip())
    for number in (int, float):
        try:
            return number(text)
        except ValueError:
            pass
    return text
