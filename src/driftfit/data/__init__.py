"""Reading data: arrays, tables and files, times, limits and labels; and writing results as tables and files."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from driftfit.data.files import read_columns

__all__ = ["read_columns"]


def __getattr__(name: str) -> Any:
    """Import `read_columns` when it is first used: narwhals and polars take as long to import as everything else."""
    if name == "read_columns":
        from driftfit.data.files import read_columns

        return read_columns
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
