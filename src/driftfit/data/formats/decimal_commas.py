"""Numbers with a decimal comma, and with dots between thousands: 1.234,5.

Columns are cells without blanks around them, null for those without a value (`driftfit.data.columns.present`).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import polars as pl

COMMA = r"^[+-]?(\d+|\d{1,3}(\.\d{3})+)?(,\d*)?([eE][+-]?\d+)?$"
"""A number with a decimal comma, perhaps with dots between thousands."""

GROUPED = r"^[+-]?([1-9]\d{0,2}(\.\d{3})+|\d+)$"
"""A whole number, perhaps with dots between thousands."""

POINT = r"^[+-]?\d*\.(\d{0,2}|\d{4,})([eE][+-]?\d+)?$"
"""A number with a decimal point, which cannot be between thousands."""


def with_points(columns: Sequence[pl.Series], others: Iterable[pl.Series]) -> list[pl.Series]:
    """Columns of a file with decimal points instead of decimal commas, and without dots between thousands.

    ``others`` are all columns of the file, or the beginning of each: decimal commas in one of them say that the dots in
    columns of whole numbers are between thousands, and a decimal point that commas may be between thousands. If there
    are both, or text among the decimal commas, such dots raise a ValueError.
    """
    if not any(map(_doubtful, columns)):
        return [_with_points(column, False, False) for column in columns]
    every = [column.drop_nulls() for column in [*columns, *others]]
    pointed = any(column.str.contains(POINT).any() for column in every)
    commas = [column for column in every if (column.str.contains(COMMA) & column.str.contains(",", literal=True)).any()]
    pure = bool(commas) and not pointed and all(column.str.contains(COMMA).all() for column in commas)
    for column in columns if commas and not pure else ():
        if _doubtful(column) and not column.str.contains(",", literal=True).any():
            dot = column.filter(column.str.contains(".", literal=True).fill_null(False))[0]
            raise ValueError(
                f"the dot in {dot} of column {column.name!r} may be a decimal point or stand between thousands: "
                f"the file has decimal commas and {'decimal points' if pointed else 'text among them'}. Give "
                "--decimal , or --decimal . on the command line, or pass the table that "
                "polars.read_csv(.., decimal_comma=True) reads."
            )
    return [_with_points(column, pure, pointed) for column in columns]


def _doubtful(text: pl.Series) -> bool:
    """Whether only other columns can show if all signs of a column are decimal ones or between thousands."""
    known = text.drop_nulls()
    commas = known.filter(known.str.contains(",", literal=True))
    if len(commas):
        return bool(commas.str.contains(r",\d{3}$").all())
    return bool(known.str.contains(".", literal=True).any() and known.str.contains(GROUPED).all())


def points(text: pl.Series) -> pl.Series:
    """A column with a decimal point instead of a comma; points that group thousands are removed."""
    plain = text.str.replace_all(".", "", literal=True).str.replace(",", ".", literal=True)
    return plain.zip_with(text.str.contains(COMMA).fill_null(False), text)


def _with_points(text: pl.Series, commas: bool, pointed: bool) -> pl.Series:
    """One column of a file in which others have decimal ``commas``, or some cells are ``pointed``."""
    known = text.drop_nulls()
    comma = known.filter(known.str.contains(",", literal=True))
    if not len(comma):
        return points(text) if commas and known.str.contains(GROUPED).all() else text
    mixed = not comma.str.contains(COMMA).all() or known.str.contains(POINT).any()
    if mixed or (pointed and comma.str.contains(r",\d{3}$").all()):
        return text  # the error message names the cell
    return points(text)
