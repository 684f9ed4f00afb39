"""Files of states and results: arrays and a header of plain JSON, without pickle.

Results are .npz files. States are small and there may be millions of them, so they have a separate format, in which
the names and sizes of the arrays are in the header: with all numbers little-endian,

    bytes 0 .. 7      "driftfit"
          8, 9        format, 3
         10, 11       0
         12 .. 15     CRC-32 of all that follows
         16 .. 19     length of the header
         20 ..        the header, and the arrays one after the other

A file is written under a temporary name and then moved into place, so it is complete or absent. Classes and functions
are stored by module and name, and nothing is imported by what a file says: only classes of the library are found by
their names, and those of your own, and your functions, that you hand in (``classes=``).
"""

from __future__ import annotations

import json
import math
import os
import secrets
import zlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields as dataclass_fields
from datetime import date, datetime, timedelta
from io import BytesIO
from os import PathLike
from struct import Struct
from typing import Any, ClassVar, Self

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.engine.settings import Settings, place_of
from driftfit.engine.tiles import held_in

FORMAT = 3
"""Version of the format of .npz files."""
MAGIC, COMPACT = b"driftfit", 3
"""The first bytes of a packed state, and the version of its format."""
REMEDY = "which stored results and states otherwise: run the record again"
"""Why older states and results are refused, and what to do."""
HEAD = Struct("<8sHHII")
CRC_BEGIN = 16
"""Number of the first byte that the CRC covers."""


def describe(settings: Settings) -> dict[str, Any]:
    """A model or tracker as plain data.

    Settings that are None are omitted, so that a setting which a later version adds changes nothing.
    """
    absent = {field.name for field in dataclass_fields(settings) if field.default is None}  # type: ignore[arg-type]
    given = {name: one for name, one in settings.settings().items() if one is not None or name not in absent}
    return {"class": place_of(type(settings)), "settings": given}


def rebuild(description: Mapping[str, Any], kind: type, classes: Iterable[Any] = ()) -> Any:
    """The inverse of `describe`: the library's class of the given kind, or one of ``classes``, with its settings.

    Functions among the settings are those of ``classes``. ValueError says what the file needs.
    """
    given = {place_of(one): one for one in classes}
    library: dict[str, Any] = {place_of(one): one for one in _within(kind)}
    found = _found(str(description["class"]), library | given)
    if not (isinstance(found, type) and issubclass(found, kind)):
        raise ValueError(f"the file names {place_of(found)} as its {kind.__name__.lower()}, which it is not.")
    assert issubclass(found, Settings)
    try:
        return found.from_settings(_filled(dict(description["settings"]), given))
    except TypeError as error:  # a setting that this version does not have
        raise ValueError(f"the file was written by another version: {error}.") from None


def _within(kind: type[Any]) -> Iterator[type[Any]]:
    """The classes of the library that are of a kind."""
    if kind.__module__.partition(".")[0] == __name__.partition(".")[0]:
        yield kind
    for one in kind.__subclasses__():
        yield from _within(one)


def _found(place: str, known: Mapping[str, Any]) -> Any:
    if place not in known:
        raise ValueError(
            f"the file needs {place}, which is not a part of this version of driftfit. If it is your own, hand it in: "
            f"classes=[{place.replace(':', '.')}]; nothing is imported by what a file says."
        )
    return known[place]


def _filled(value: Any, given: Mapping[str, Any]) -> Any:
    """Settings as plain data, with functions in place of their names."""
    if isinstance(value, Mapping):
        if value.keys() == {"function"}:
            return _found(str(value["function"]), given)
        return {name: _filled(one, given) for name, one in value.items()}
    return [_filled(one, given) for one in value] if isinstance(value, list | tuple) else value


def parts_of(value: Any) -> Iterator[Any]:
    """The classes and functions that a model or tracker is made of: ``classes`` for files that hold the same."""
    if isinstance(value, Settings):
        yield type(value)
        for field in dataclass_fields(value):  # type: ignore[arg-type]
            yield from parts_of(getattr(value, field.name))
    elif isinstance(value, tuple):
        for part in value:
            yield from parts_of(part)
    elif callable(value):
        yield value


def check_size(source: str | PathLike[str], model: Any, tracker: Any, size: int) -> None:
    """ValueError if model and tracker have more parameters than a file has room for: what they need is made later."""
    n = len(tracker.names_for(model))
    if n > size:
        raise ValueError(
            f"{os.fspath(source)} does not fit {type(tracker).__name__} in this version: it has room for {size} "
            f"parameters, the model has {n}."
        )


@contextmanager
def reading(name: str) -> Iterator[None]:
    """Errors of a file that holds what no driftfit writes, as ValueError."""
    try:
        yield
    except (ArithmeticError, AssertionError, AttributeError, LookupError, MemoryError, TypeError) as error:
        raise ValueError(f"{name} holds what driftfit does not write: {type(error).__name__}: {error}.") from error


def write(path: str | PathLike[str], header: Mapping[str, Any], arrays: Mapping[str, Array]) -> None:
    """Write a header and arrays as .npz, completely or not at all."""
    # the names of the arrays, because the check sums of a zip cover what it holds, not what that is called
    text = json.dumps({"format": FORMAT, "arrays": [*arrays], **header}, default=_encode)
    named: dict[str, Any] = dict(arrays)
    replace_file(path, lambda file: np.savez(file, header=np.array(text), **named))


def replace_file(path: str | PathLike[str], put: Callable[[Any], Any]) -> None:
    """Let ``put`` write a file, which takes the place of an older one once it is complete and on the disk."""
    target = os.path.abspath(os.fspath(path))
    name = os.path.join(os.path.dirname(target), f".driftfit-{secrets.token_hex(8)}")
    try:
        file = open(name, "xb")  # noqa: SIM115  (with the rights of any new file, unlike one of tempfile)
    except OSError as error:
        raise type(error)(error.errno, error.strerror, target) from None
    try:
        with file:
            put(file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(name, target)
    except BaseException:
        os.unlink(name)
        raise


def read(path: str | PathLike[str], *kinds: str) -> tuple[dict[str, Any], dict[str, Array]]:
    """Header and arrays of a file that holds one of the ``kinds`` ("state", "track"); ValueError where it does not."""
    with open(path, "rb") as handle:
        return expand(handle.read(), kinds, os.fspath(path))


def compact(header: Mapping[str, Any], arrays: Mapping[str, Array]) -> bytes:
    """A header and arrays as bytes."""
    little = {name: array.astype(array.dtype.newbyteorder("<"), copy=False) for name, array in arrays.items()}
    described = [[name, array.dtype.str, array.shape] for name, array in little.items()]
    text = json.dumps({**header, "arrays": described}, default=_encode, separators=(",", ":")).encode()
    body = b"".join([text, *(array.tobytes() for array in little.values())])
    return HEAD.pack(MAGIC, COMPACT, 0, zlib.crc32(body, zlib.crc32(len(text).to_bytes(4, "little"))), len(text)) + body


def _expand(data: bytes) -> tuple[dict[str, Any], dict[str, Array]]:
    """The inverse of `compact`; ValueError if it is damaged."""
    _, version, unused, check, length = HEAD.unpack_from(data)
    if version <= COMPACT and (zlib.crc32(data[CRC_BEGIN:]) != check or unused):
        raise ValueError("its check sum does not fit its content")
    if version != COMPACT:
        return {"format": version}, {}
    header = json.loads(data[HEAD.size : HEAD.size + length], object_hook=_decode)
    arrays, at = {}, HEAD.size + length
    for name, kind, shape in header.pop("arrays"):
        array = np.frombuffer(data, kind, math.prod(shape), at)
        arrays[name] = array.astype(array.dtype.newbyteorder("="), copy=False).reshape(shape)
        at += array.nbytes
    return header, arrays


def expand(data: bytes, kinds: Sequence[str], name: str = "what was given") -> tuple[dict[str, Any], dict[str, Array]]:
    """Header and arrays of bytes that hold one of the ``kinds``; ValueError where they do not."""
    try:
        reads = COMPACT
        if data.startswith(MAGIC):
            header, arrays = _expand(data)
        else:
            reads = FORMAT
            with np.load(BytesIO(data), allow_pickle=False) as archive:
                if sum(one.file_size for one in archive.zip.infolist()) > len(data):  # none is compressed
                    raise ValueError("it would unpack to more than it has")
                arrays = {name: archive[name] for name in archive.files}
            header = dict(json.loads(str(arrays.pop("header")), object_hook=_decode))
            if header.pop("arrays", [*arrays]) != [*arrays]:
                raise ValueError("its arrays have other names than those that were written")
    except Exception as error:  # zipfile, NumPy and JSON raise a dozen kinds of errors for damaged files
        raise ValueError(f"{name} is not a driftfit file, or it is damaged.") from error
    if header.get("format", 0) > reads:
        raise ValueError(f"{name} was written by a newer driftfit (format {header['format']}); this one reads {reads}.")
    if header.get("format", reads) < reads:
        raise ValueError(f"{name} was written by an older driftfit (format {header['format']}), {REMEDY}.")
    if header.get("kind") not in kinds:
        raise ValueError(f"{name} holds a {header.get('kind')}, not a {' or a '.join(kinds)}.")
    return header, arrays


class Kept(ABC):
    """A stream that can be saved, or sent as bytes, and continues as if it had never stopped."""

    _kind: ClassVar[str]

    @abstractmethod
    def _written(self) -> tuple[dict[str, Any], dict[str, Array]]:
        """Header and arrays."""

    @classmethod
    @abstractmethod
    def _read(cls, source: str, header: Mapping[str, Any], arrays: Mapping[str, Array], classes: Iterable[Any]) -> Self:
        """The inverse of `_written`; ``source`` is named in error messages."""

    def save(self, path: str | PathLike[str]) -> None:
        """Write model, settings and state to one file without pickle, completely or not at all."""
        replace_file(path, lambda file: file.write(self.to_bytes()))

    @classmethod
    def _kinds(cls) -> Mapping[str, type[Kept]]:
        """Classes that `load` accepts: the class that each kind of file becomes."""
        return {cls._kind: cls}

    @classmethod
    def load(cls, path: str | PathLike[str], classes: Iterable[Any] = ()) -> Any:
        """Continue from a file as if never stopped.

        Nothing is imported or run by what the file says: a model or tracker of your own, and functions among its
        settings, are those that you hand in as ``classes``. The ValueError names what a file needs.
        """
        with open(path, "rb") as file:
            return cls._taken(os.fspath(path), file.read(), classes)

    def to_bytes(self) -> bytes:
        """The content of a saved file as bytes, for a queue or a database."""
        return compact(*self._written())

    @classmethod
    def from_bytes(cls, data: bytes, classes: Iterable[Any] = ()) -> Any:
        """The inverse of `to_bytes`; ``classes`` as for `load`."""
        return cls._taken("what was given", data, classes)

    @classmethod
    def _taken(cls, source: str, data: bytes, classes: Iterable[Any]) -> Any:
        header, arrays = expand(data, list(cls._kinds()), source)
        with reading(source):
            return cls._kinds()[header["kind"]]._read(source, header, arrays, classes)


def _encode(value: Any) -> Any:
    """Encode values that JSON does not support: times, days and intervals."""
    if isinstance(value, datetime):
        return {"datetime": value.isoformat()}
    if isinstance(value, date):
        return {"date": value.isoformat()}
    if isinstance(value, timedelta):
        return {"seconds": value.total_seconds()}
    if isinstance(value, np.datetime64 | np.timedelta64):
        return {"numpy": [value.dtype.str, int(value.astype(np.int64))]}
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"cannot write {value!r}, a {type(value).__name__}, as plain data")


def _decode(value: dict[str, Any]) -> Any:
    if value.keys() == {"datetime"}:
        return datetime.fromisoformat(value["datetime"])
    if value.keys() == {"date"}:
        return date.fromisoformat(value["date"])
    if value.keys() == {"seconds"}:
        return timedelta(seconds=value["seconds"])
    if value.keys() == {"numpy"}:
        kind, count = value["numpy"]
        return np.array([count], dtype=np.int64).view(kind)[0]
    return value


def restore(
    source: str | PathLike[str], tracker: Settings, arrays: Mapping[str, Array], prefix: str, into: Mapping[str, Array]
) -> None:
    """Write stored arrays into the fields of a record; ValueError where one is missing or of another shape."""
    for name, field in into.items():
        stored = arrays.get(prefix + name)
        if stored is None or stored.shape != field.shape:
            raise ValueError(
                f"{os.fspath(source)} does not fit {type(tracker).__name__} in this version: field {name!r}."
            )
        field[...] = stored


def fields(tile: Array) -> tuple[str, ...]:
    """Names of the fields that contain state."""
    return held_in(tile.dtype)
