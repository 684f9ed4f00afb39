"""Numbers with a decimal comma, and with dots between thousands: 1.234,5."""

from __future__ import annotations

from collections.abc import Sequence

import polars as pl

from driftfit.data.columns import MISSING

COMMA = r"^\s*[+-]?(\d+|\d{1,3}(\.\d{3})+)?(,\d*)?([eE][+-]?\d+)?\s*$"
"""A number with a decimal comma, perhaps with dots between thousands."""

GROUPED = r"^\s*[+-]?([1-9]\d{0,2}(\.\d{3})+|\d+)\s*$"
"""A whole number, perhaps with dots between thousands."""

POINT = r"^\s*[+-]?\d*\.(\d{0,2}|\d{4,})([eE][+-]?\d+)?\s*$"
"""A number with a decimal point, which cannot be between thousands."""


def with_points(columns: Sequence[pl.Series], others: Sequence[pl.Series]) -> list[pl.Series]:
    """Columns of a file with decimal points instead of decimal commas, and without dots between thousands.

    ``others`` are all columns of the file, or the beginning of each: decimal commas in one of them say that the dots in
    columns of whole numbers are between thousands, and a decimal point that commas may be between thousands.
    """
    if not any(map(_doubtful, columns)):
        return [_with_points(column, False, False) for column in columns]
    every = [_known(column) for column in [*columns, *others]]
    pointed = any(column.str.contains(POINT).any() for column in every)
    commas = not pointed and any(map(_has_commas, every))
    return [_with_points(column, commas, pointed) for column in columns]


def _doubtful(text: pl.Series) -> bool:
    """Whether only other columns can show if all signs of a column are decimal ones or between thousands."""
    known = _known(text)
    commas = known.filter(known.str.contains(",", literal=True))
    if len(commas):
        return bool(commas.str.contains(r",\d{3}\s*$").all())
    return bool(known.str.contains(".", literal=True).any() and known.str.contains(GROUPED).all())


def points(text: pl.Series) -> pl.Series:
    """A column with a decimal point instead of a comma; points that group thousands are removed."""
    plain = text.str.replace_all(".", "", literal=True).str.replace(",", ".", literal=True)
    return plain.zip_with(text.str.contains(COMMA).fill_null(False), text)


def _has_commas(known: pl.Series) -> bool:
    """Whether a column holds nothing but numbers, of which some have decimal commas."""
    return bool(known.str.contains(",", literal=True).any() and known.str.contains(COMMA).all())


def _with_points(text: pl.Series, commas: bool, pointed: bool) -> pl.Series:
    """One column of a file in which others have decimal ``commas``, or some cells are ``pointed``."""
    known = _known(text)
    if not known.str.contains(",", literal=True).any():
        return points(text) if commas and known.str.contains(GROUPED).all() else text
    comma = known.filter(known.str.contains(",", literal=True))
    mixed = not comma.str.contains(COMMA).all() or known.str.contains(POINT).any()
    if mixed or (pointed and comma.str.contains(r",\d{3}\s*$").all()):
        return text  # the error message names the cell
    return points(text)


def _known(text: pl.Series) -> pl.Series:
    return text.filter(~text.str.strip_chars().str.to_lowercase().is_in(MISSING))
