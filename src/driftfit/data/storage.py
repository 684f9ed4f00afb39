"""Files of states and results: arrays and a header of plain JSON, without pickle.

Results are .npz files. States are small and there may be millions of them, so they have a separate format, in which
the names and sizes of the arrays are in the header: with all numbers little-endian,

    bytes 0 .. 7      "driftfit"
          8, 9        format, 3
         10, 11       0
         12 .. 15     CRC-32 of all that follows
         16 .. 19     length of the header
         20 ..        the header, and the arrays one after the other

A file is written under a temporary name and then moved into place, so it is complete or absent. Classes are stored by
module and class name; loading imports that module, so load only files from people whose code you would run.
"""

from __future__ import annotations

import json
import math
import os
import secrets
import zlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields as dataclass_fields
from datetime import date, datetime, timedelta
from importlib import import_module
from io import BytesIO
from os import PathLike
from struct import Struct
from typing import Any, ClassVar, Self

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.engine.settings import Settings
from driftfit.engine.tiles import held_in

FORMAT = 2
"""Version of the format of .npz files."""
MAGIC, COMPACT = b"driftfit", 3
"""The first bytes of a packed state, and the version of its format."""
REMEDY = "whose trackers judged readings by rules of their own: run the record again"
"""Why older states and results are refused, and what to do."""
HEAD = Struct("<8sHHII")
CHECKED = 16
"""Number of the first byte that the CRC covers."""


def describe(settings: Settings) -> dict[str, Any]:
    """A model or tracker as plain data.

    Settings that are None are omitted, so that a setting which a later version adds changes nothing.
    """
    absent = {field.name for field in dataclass_fields(settings) if field.default is None}  # type: ignore[arg-type]
    given = {name: one for name, one in settings.settings().items() if one is not None or name not in absent}
    return {"class": f"{type(settings).__module__}:{type(settings).__qualname__}", "settings": given}


def rebuild(description: Mapping[str, Any], kind: type) -> Any:
    """The inverse of `describe`; the class must be of the given kind."""
    module, _, name = str(description["class"]).partition(":")
    try:
        found = getattr(import_module(module), name)
    except (ImportError, AttributeError):
        raise ValueError(
            f"the file needs the class {name} of the module {module}, which cannot be imported here."
        ) from None
    if not (isinstance(found, type) and issubclass(found, kind)):
        raise ValueError(f"the file names {module}:{name} as its {kind.__name__.lower()}, which it is not.")
    assert issubclass(found, Settings)
    try:
        return found.from_settings(dict(description["settings"]))
    except TypeError as error:  # a setting that this version does not have
        raise ValueError(f"the file was written by another version: {error}.") from None


def write(path: str | PathLike[str], header: Mapping[str, Any], arrays: Mapping[str, Array]) -> None:
    """Write a header and arrays as .npz, completely or not at all."""
    _write(path, lambda file: _put(file, header, arrays))


def _write(path: str | PathLike[str], put: Callable[[Any], Any]) -> None:
    """Let ``put`` write a file that is complete or absent."""
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
        return _take(handle, os.fspath(path), kinds)


def _put(file: Any, header: Mapping[str, Any], arrays: Mapping[str, Array]) -> None:
    # the names of the arrays, because the check sums of a zip cover what it holds, not what that is called
    text = json.dumps({"format": FORMAT, "arrays": [*arrays], **header}, default=_encode)
    named: dict[str, Any] = dict(arrays)
    np.savez(file, header=np.array(text), **named)


def compact(header: Mapping[str, Any], arrays: Mapping[str, Array]) -> bytes:
    """A header and arrays as bytes."""
    little = {name: array.astype(array.dtype.newbyteorder("<"), copy=False) for name, array in arrays.items()}
    described = [[name, array.dtype.str, array.shape] for name, array in little.items()]
    text = json.dumps({**header, "arrays": described}, default=_encode, separators=(",", ":")).encode()
    body = b"".join([text, *(array.tobytes() for array in little.values())])
    return HEAD.pack(MAGIC, COMPACT, 0, zlib.crc32(body, zlib.crc32(_length(text))), len(text)) + body


def _length(text: bytes) -> bytes:
    return len(text).to_bytes(4, "little")


def _expand(data: bytes) -> tuple[dict[str, Any], dict[str, Array]]:
    """The inverse of `compact`; ValueError if it is damaged."""
    _, version, unused, check, length = HEAD.unpack_from(data)
    if version <= COMPACT and (zlib.crc32(data[CHECKED:]) != check or unused):
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


def expand(data: bytes, kinds: Sequence[str]) -> tuple[dict[str, Any], dict[str, Array]]:
    """Header and arrays of bytes that hold one of the ``kinds``; ValueError where they do not."""
    return _take(BytesIO(data), "what was given", kinds)


def _take(file: Any, name: str, kinds: Sequence[str]) -> tuple[dict[str, Any], dict[str, Array]]:
    try:
        data, reads = file.read(), COMPACT
        if data.startswith(MAGIC):
            header, arrays = _expand(data)
        else:
            reads = FORMAT
            with np.load(BytesIO(data), allow_pickle=False) as archive:
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
    def _read(cls, source: str, header: Mapping[str, Any], arrays: Mapping[str, Array]) -> Self:
        """The inverse of `_written`; ``source`` is named in error messages."""

    def save(self, path: str | PathLike[str]) -> None:
        """Write model, settings and state to one file without pickle, completely or not at all."""
        _write(path, lambda file: file.write(self.to_bytes()))

    @classmethod
    def _kinds(cls) -> Mapping[str, type[Kept]]:
        """Classes that `load` accepts: the class that each kind of file becomes."""
        return {cls._kind: cls}

    @classmethod
    def load(cls, path: str | PathLike[str]) -> Any:
        """Continue from a file as if never stopped."""
        header, arrays = read(path, *cls._kinds())
        return cls._kinds()[header["kind"]]._read(os.fspath(path), header, arrays)

    def to_bytes(self) -> bytes:
        """The content of a saved file as bytes, for a queue or a database."""
        return compact(*self._written())

    @classmethod
    def from_bytes(cls, data: bytes) -> Any:
        """The inverse of `to_bytes`."""
        header, arrays = expand(data, list(cls._kinds()))
        return cls._kinds()[header["kind"]]._read("what was given", header, arrays)


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


def fields(tile: Array) -> list[str]:
    """Names of the fields that contain state."""
    return held_in(tile.dtype)
