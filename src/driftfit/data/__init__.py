"""Signals, records, tables and files: what users hand over, checked once."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from driftfit.data.files import read_columns

__all__ = ["read_columns"]


def __getattr__(name: str) -> Any:
    """`read_columns`, once it is asked for: narwhals and polars take as long to import as all the rest."""
    if name == "read_columns":
        from driftfit.data.files import read_columns

        return read_columns
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
