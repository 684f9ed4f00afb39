"""Packed files: how large they become is looked at before they are unpacked, and what is damaged gives one error."""

from __future__ import annotations

import gzip
import io
import os
import zlib
from collections.abc import Collection

import polars as pl

LARGE, TIMES = 1 << 30, 100
"""Bytes to which any file may unpack, and multiples of its own bytes."""


def check_unpacked(where: str, packed: int, unpacked: int) -> None:
    """Raise ValueError for a file that becomes too large."""
    most = max(LARGE, TIMES * packed)
    if unpacked > most:
        raise ValueError(
            f"{where} has {packed} bytes and says that it unpacks to {unpacked}, but at most {most} are unpacked; "
            "write its contents to several files."
        )


def gunzipped(data: bytes, where: str) -> bytes:
    """The contents of a file of gzip."""
    check_unpacked(where, len(data), int.from_bytes(data[-4:], "little"))
    try:
        with gzip.GzipFile(fileobj=io.BytesIO(data)) as file:  # it may say less than it holds
            found = file.read(max(LARGE, TIMES * len(data)) + 1)
    except (EOFError, gzip.BadGzipFile, zlib.error) as error:
        raise ValueError(f"{where} cannot be decompressed: {error}") from None
    check_unpacked(where, len(data), len(found))
    return found


def read_parquet(
    source: str | bytes, where: str, wanted: Collection[str] | None = None
) -> tuple[list[str], pl.DataFrame]:
    """(the names of all columns, the wanted ones) of a Parquet file."""
    size = len(source) if isinstance(source, bytes) else os.path.getsize(source)
    try:
        opened = pl.scan_parquet(io.BytesIO(source) if isinstance(source, bytes) else source)
        names = opened.collect_schema().names()
        chosen = names if wanted is None else [name for name in names if name in wanted]
        check_unpacked(where, size, 8 * len(chosen) * opened.select(pl.len()).collect().item())
        return names, opened.select(chosen).collect()
    except (pl.exceptions.PolarsError, pl.exceptions.PanicException) as error:
        raise ValueError(f"{where} cannot be read as Parquet: {' '.join(str(error).split())[:300]}") from None
