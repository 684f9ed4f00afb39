"""Files as spreadsheets of other countries write them: decimal commas, days before months, other encodings."""

import re

import numpy as np
import polars as pl
import pytest

from driftfit import RLS, DataWarning, Regression, track
from driftfit.data.files import read_columns


def written(tmp_path, text, encoding="utf-8"):
    path = tmp_path / "anlage.csv"
    path.write_bytes(text.encode(encoding))
    return path


def test_decimal_commas_dots_between_thousands_and_days_first(tmp_path):
    rows = [
        "Datum;Durchfluß °C;Druck",
        "30.03.2024 22:00;1,5;1.234,5",
        "30.03.2024 22:15;;-12,25",
        "1.4.2024 9:30;-,5;7",
    ]
    path = written(tmp_path, "\r\n".join(rows), "cp1252")
    found = read_columns(path, ["Durchfluß °C", "Druck"], "Datum")
    np.testing.assert_array_equal(found["Durchfluß °C"], [1.5, np.nan, -0.5])
    np.testing.assert_array_equal(found["Druck"], [1234.5, -12.25, 7.0])
    expected = np.array(["2024-03-30T22:00", "2024-03-30T22:15", "2024-04-01T09:30"], "datetime64[us]")
    np.testing.assert_array_equal(found["Datum"], expected)
    points = written(tmp_path, "t;y\n1;1.5\n2;2.25\n3;n/a\n")  # semicolons alone say nothing about the numbers
    np.testing.assert_array_equal(read_columns(points, ["y"])["y"], [1.5, 2.25, np.nan])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("t;y\n1;1,5\n2;2.5\n", "row 1 of column 'y' holds '1,5'"),  # both kinds in one column
        ("t;y\n1;1,5\n2;1,2,3\n", "row 1 of column 'y' holds '1,5'"),
        ('t,y\n1,"1,065.26"\n', "holds '1,065.26', which is not a number"),
    ],
)
def test_numbers_that_are_neither_are_named(tmp_path, text, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        read_columns(written(tmp_path, text), ["y"])


def dates(tmp_path, *cells):
    text = "t,y\n" + "\n".join(f"{cell},1" for cell in cells)
    return read_columns(written(tmp_path, text), ["y"], "t")["t"].astype("datetime64[D]").astype(str).tolist()


def test_day_or_month_first_is_read_from_the_column_and_never_guessed(tmp_path):
    assert dates(tmp_path, "1/31/2024", "2/1/2024") == ["2024-01-31", "2024-02-01"]
    assert dates(tmp_path, "31/1/2024", "1/2/2024") == ["2024-01-31", "2024-02-01"]
    assert dates(tmp_path, "1.2.2024", "2.2.2024") == ["2024-02-01", "2024-02-02"]
    with pytest.raises(ValueError, match="such as '1/1/2024', may have the day or the month first"):
        dates(tmp_path, "1/1/2024", "2/1/2024")
    with pytest.raises(ValueError, match=re.escape("row 1 of column 't' holds '31.02.2024'")):
        dates(tmp_path, "31.02.2024", "1.3.2024")


def test_such_a_file_is_tracked_like_any_other(tmp_path):
    rng = np.random.default_rng(0)
    x = rng.normal(size=60).round(3)
    y = (2 * x + 0.1 * rng.normal(size=60)).round(3)
    rows = [
        f"{1 + k % 28}.{1 + k // 28}.2024;{a};{b}".replace("-.", "-0.")
        for k, (a, b) in enumerate(zip(x, y, strict=True))
    ]
    rows = [row.partition(";")[0] + ";" + row.partition(";")[2].replace(".", ",") for row in rows]
    path = written(tmp_path, "tag;x;y\n" + "\n".join(rows))
    run = track(Regression(1), RLS(1.0), y="y", u="x", data=path, time="tag", dt="label")
    np.testing.assert_array_equal(run.theta, track(Regression(1), RLS(1.0), y, x).theta)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_a_line_that_declares_the_separator_and_files_with_a_byte_order_mark(tmp_path, encoding):
    for text in ("sep=|\r\nt|y\r\n1|2.5\r\n", "t;y\n1;2,5\n"):
        np.testing.assert_array_equal(read_columns(written(tmp_path, text, encoding), ["y"])["y"], [2.5])


def test_whole_numbers_with_dots_between_thousands_beside_decimal_commas(tmp_path):
    path = written(tmp_path, "a;b;c\n998;1,5;0.998\n1.002;2,5;1.002\nn/a;3,5;2\n")
    np.testing.assert_array_equal(read_columns(path, ["a"])["a"], [998.0, 1002.0, np.nan])  # whatever else is read
    np.testing.assert_array_equal(read_columns(path, ["c"])["c"], [0.998, 1.002, 2.0])


def test_a_column_that_occurs_twice_is_not_chosen_silently(tmp_path):
    path = written(tmp_path, "t,y,x,x\n1,2,3,4\n")
    with pytest.raises(ValueError, match="has 2 columns 'x'"):
        read_columns(path, ["y", "x"])
    assert read_columns(path, ["y"], "t")["y"].tolist() == [2.0]


def test_days_without_hyphens_are_dates_and_numbers_like_them_cause_a_warning(tmp_path):
    assert dates(tmp_path, "20240131", "20240229") == ["2024-01-31", "2024-02-29"]
    with pytest.raises(ValueError, match="row 2 of column 't' holds '20240231'"):
        dates(tmp_path, "20240131", "20240231")
    days = ["20231031", "20231130", "20231231", "20240131"]
    x, y = np.array([1.0, 2.0, 1.0, 3.0]), np.ones(4)
    run = track(Regression(1), RLS(1.0), y, x, time=days, dt="month")
    assert run.time_text(3) == "2024-01-31"
    for numbers in (np.array(days, float), np.array([202310, 202311, 202312, 202401])):
        with pytest.warns(DataWarning, match=f"the numbers {numbers[0]:.0f}, {numbers[1]:.0f}, .. look like dates"):
            track(Regression(1), RLS(1.0), y, x, time=numbers)
        with pytest.warns(DataWarning, match="look like dates"):
            track(Regression(1), RLS(1.0), "y", "x", data=pl.DataFrame({"x": x, "y": y, "t": numbers}), time="t")
        track(Regression(1), RLS(1.0), y, x, time=numbers, dt="label")
    with pytest.raises(ValueError, match="'202310' is not a date"):  # which was the year 202310
        track(Regression(1), RLS(1.0), y, x, time=["202310", "202311", "202312", "202401"], dt="month")
