"""Compiled code on disk: one file for each function and signature, found by a name that is a digest of everything on
which it depends.

Numba keeps the signatures of a function in one index and numbers its files by the length of the index when it was read:
two processes that compile different layouts at the same moment may store both under one number, and a third runs the
wrong code. Here there is no index. The name of a file is a digest of the function's identity, the signature, the
processor, and the versions of everything that makes code, so that two processes can only ever write the same content; a
file is written completely or not at all, and the contents of a damaged file are compiled again.

The folder is ``NUMBA_CACHE_DIR`` where that is set, else ``__pycache__`` of the package, else the user's cache folder.
Code is found in any of them, as in an image that was filled by ``driftfit warm`` and can only be read, and written to
the first that can be written. If no folder can be written, every process compiles in memory, and a warning is issued
once.
"""

from __future__ import annotations

import hashlib
import os
import pickle
import platform
import tempfile
import time
import warnings
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numba

from driftfit.engine.numba_internals import dumps, target

PACKAGE = Path(__file__).parent
ENDING = ".compiled"
MAKERS = (
    "kernel.py",
    "numba_internals.py",
    "compile_time/lowering.py",
    "compile_time/lookups.py",
    "compile_time/open_record.py",
    "simd.py",
)
"""Files that decide how a function is compiled, in addition to its own code."""


@cache
def folders() -> tuple[Path, ...]:
    """Folders in which compiled code may be stored, the first choice first."""
    given = numba.config.CACHE_DIR
    if given:
        return (Path(given) / "driftfit",)
    own = PACKAGE / "__pycache__" / "compiled"
    home = os.environ.get("LOCALAPPDATA" if os.name == "nt" else "XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    return (own,) if home.startswith("~") else (own, Path(home) / "driftfit")  # ~: nobody knows whose home


@cache
def folder() -> Path | None:
    """The folder in which compiled code is stored: the first that can be written, or None."""
    for place in folders():
        try:
            place.mkdir(parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=place).close()
        except OSError:
            continue
        return place
    return None


@cache
def makers() -> str:
    """Everything that determines the generated code: versions, processor, and the files that emit code by hand."""
    build = hashlib.sha256()
    for name in MAKERS:
        build.update((PACKAGE / name).read_bytes())
    return f"{platform.python_version()}{target()}{build.hexdigest()}"


def name_of(function: str, identity: str, signature: Any) -> str:
    """The name of a file: the function's, and a digest of all that its code depends on."""
    digest = hashlib.sha256("\n".join((identity, str(signature), makers())).encode()).hexdigest()
    return f"{function}-{hashlib.sha256(makers().encode()).hexdigest()[:8]}-{digest[:40]}{ENDING}"


def read(name: str) -> Any:
    """The code stored under a name in any of the folders; None if there is none, or if it is damaged."""
    for place in folders():
        try:
            data = (place / name).read_bytes()
            if hashlib.sha256(data[32:]).digest() != data[:32]:
                continue
            found = pickle.loads(data[32:])
        except (OSError, EOFError, pickle.UnpicklingError, ImportError, AttributeError):
            continue
        _touch(place / name)
        return found
    return None


def _touch(path: Path) -> None:
    """Record that a file was used, for `prune`; once a day is enough."""
    try:
        if time.time() - path.stat().st_mtime > 86400.0:
            os.utime(path)
    except OSError:
        pass


def write(name: str, content: Any) -> None:
    """Store data under a name, if a folder can be written."""
    place = folder()
    if place is None:
        _say_nothing_is_kept()
        return
    data = dumps(content)
    try:
        handle, unfinished = tempfile.mkstemp(dir=place, prefix=f"{name}.", suffix=".tmp")
        try:
            with open(handle, "wb") as file:
                file.write(hashlib.sha256(data).digest() + data)
            os.chmod(unfinished, 0o644)
            os.replace(unfinished, place / name)
        except BaseException:  # also where the user interrupts it
            os.unlink(unfinished)
            raise
    except OSError:  # a full disk, or a folder that was taken away
        _say_nothing_is_kept()


@cache
def _say_nothing_is_kept() -> None:
    tried = ", ".join(map(str, folders()))
    warnings.warn(
        f"driftfit: compiled code cannot be kept, because none of these folders can be written: {tried}. It is "
        "compiled again in every process. Set NUMBA_CACHE_DIR to a folder that can be written.",
        stacklevel=2,
    )


class Contents(NamedTuple):
    """What is kept on disk."""

    place: Path | None
    files: int
    size: int
    """Bytes."""
    usable: int
    """Files made by the versions and for the processor of this process."""


def contents() -> Contents:
    """What is kept on disk."""
    files = _files()
    return Contents(_place(), len(files), sum(stat.st_size for stat in files.values()), sum(map(_mine, files)))


def prune(days: float) -> int:
    """Remove code that other versions made, and code that was not used for so many days; returns how many files."""
    oldest = time.time() - 86400.0 * days
    gone = [path for path, stat in _files().items() if not _mine(path) or stat.st_mtime <= oldest]
    for path in gone:
        path.unlink(missing_ok=True)
    return len(gone)


def _place() -> Path | None:
    """The folder that is written, or else one that can be read."""
    return folder() or next((place for place in folders() if place.is_dir()), None)


def _files() -> dict[Path, os.stat_result]:
    """The files, with their sizes and times."""
    place, found = _place(), dict[Path, os.stat_result]()
    for path in () if place is None else place.iterdir():
        if path.name.endswith((ENDING, ".tmp")):
            with suppress(FileNotFoundError):  # another process has finished it meanwhile, or removed it
                found[path] = path.stat()
    return found


def _mine(path: Path) -> bool:
    return f"-{hashlib.sha256(makers().encode()).hexdigest()[:8]}-" in path.name and path.name.endswith(ENDING)
