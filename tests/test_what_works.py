"""The table of what works with what is true: cells that are cheap to try are tried, and every row is there."""

import pathlib
import warnings

import pytest

from benchmarks.what_works import COLUMNS, PAIRS, cells_of

PAGE = pathlib.Path(__file__).parents[1] / "docs" / "tracking.md"
CHEAP = ("gaps", "smooth", "forecast", "simulate", "gains", "C")
ROWS = ("ARX, Kalman", "ARX, RLS", "ARX, FLS", "ARX, InstrumentalVariables", "Regression, DynamicGLM")


def printed():
    """The cells of the page by row."""
    table = PAGE.read_text(encoding="utf8").split("## What works with what")[1].split("```")[1]
    lines = table.splitlines()[1:]
    assert tuple(lines[0].split()) == COLUMNS
    return {line[:42].strip(): line[42:].split() for line in lines[1:] if line.strip()}


def test_the_page_has_the_rows_of_the_benchmark():
    assert list(printed()) == [name for name, *_ in PAIRS]
    assert all(len(cells) == len(COLUMNS) and set(cells) <= {"yes", "no"} for cells in printed().values())


@pytest.mark.parametrize("name", ROWS)
def test_cells_that_are_cheap_are_true(name):
    row = next(pair for pair in PAIRS if pair[0] == name)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = cells_of(*row, {}, CHEAP)
    assert found == [printed()[name][COLUMNS.index(column)] for column in CHEAP]
