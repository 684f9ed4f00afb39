"""Files as spreadsheets of other countries write them: decimal commas, days before months, other encodings."""

import gzip
import re
from contextlib import nullcontext, suppress

import numpy as np
import polars as pl
import pytest
from scipy.io import savemat

from driftfit import RLS, DataWarning, Regression, track
from driftfit.bridges.matlab import read_mat
from driftfit.data.clock import Clock
from driftfit.data.columns import Wanted
from driftfit.data.files import Files, read_columns
from driftfit.data.instants import warn_of_counted_years, warn_of_written_numbers
from driftfit.data.limits import end_of, within
from driftfit.data.storage import read


def written(tmp_path, text, encoding="utf-8"):
    path = tmp_path / "anlage.csv"
    path.write_bytes(text.encode(encoding))
    return path


def test_decimal_commas_and_days_first_are_read_as_the_options_say(tmp_path):
    rows = [
        "Datum;Durchfluß °C;Druck",
        "30.03.2024 22:00;1,5;1.234,5",
        "30.03.2024 22:15;;-12,25",
        "1.4.2024 9:30;-,5;7",
    ]
    path = str(written(tmp_path, "\r\n".join(rows), "cp1252"))
    wanted = Wanted(("Durchfluß °C", "Druck"), "Datum")
    found, _ = Files(path, how=Wanted((), decimal=",", dates="%d.%m.%Y %H:%M")).columns(wanted)
    np.testing.assert_array_equal(found.numbers["Durchfluß °C"], [1.5, np.nan, -0.5])
    np.testing.assert_array_equal(found.numbers["Druck"], [1234.5, -12.25, 7.0])
    expected = np.array(["2024-03-30T22:00", "2024-03-30T22:15", "2024-04-01T09:30"], "datetime64[us]")
    np.testing.assert_array_equal(found.time, expected)
    with pytest.raises(ValueError, match=r"row 1 of column 'Druck' holds '1\.234,5'.*--decimal , .*decimal_comma=True"):
        read_columns(path, ["Druck"])
    with pytest.raises(ValueError, match=r"row 1 .* neither a number nor a date in the form 2024-01-31.*--dates '%d"):
        read_columns(path, [], "Datum")
    times = written(tmp_path, "t;y\n0,5;1,5\n1,5;2,5\n")
    assert Files(times, how=Wanted((), decimal=",")).columns(Wanted(("y",), "t"))[0].time.tolist() == [0.5, 1.5]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('t,y\n1,"1,065.26"\n', "holds '1,065.26', which is not a number (1 such cell); write numbers without signs"),
        ("t;y\n1;1,234\n2.5;3,500\n", "row 1 of column 'y' holds '1,234'"),
        ("t,y\n1,bar\n1,2\n", "holds 'bar', which is not a number (1 such cell); if this line holds units"),
        ("sep=;\nt;y\n1;2\n1;2;3\n", "row 2 has 3 cells, but the header (t, y) has 2"),
        ("t,y\n1,2,3\n", "row 1 has 3 cells, but the header (t, y) has 2"),
        ("PK\x03\x04", "is an Excel workbook or a ZIP archive; write its table to a CSV or Parquet file"),
    ],
)
def test_numbers_that_are_neither_are_named(tmp_path, text, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        read_columns(written(tmp_path, text), ["y"])


def dates(tmp_path, *cells):
    text = "t,y\n" + "\n".join(f"{cell},1" for cell in cells)
    return read_columns(written(tmp_path, text), ["y"], "t")["t"].astype("datetime64[D]").astype(str).tolist()


def test_dates_begin_with_the_year_or_are_refused(tmp_path):
    assert dates(tmp_path, "2024-01-31 9:30", "2024-02-01 9:30") == ["2024-01-31", "2024-02-01"]
    assert dates(tmp_path, "2024/01/31", "2024/02/01") == ["2024-01-31", "2024-02-01"]
    for cells in (("13/1/2024", "14/1/2024"), ("1.2.2024", "2.2.2024"), ("2024-01-31", "1/2/2024"), ("01-Jan-24",)):
        wrong = next(k for k, cell in enumerate(cells) if not cell.startswith("2024"))
        with pytest.raises(ValueError, match=f"row {wrong + 1} of column 't' holds '{cells[wrong]}'"):
            dates(tmp_path, *cells)


SPREADSHEET = ["#N/A", "#DIV/0!", "#VALUE!", "#REF!", "#NUM!", "#NAME?", "#NULL!", "#SPILL!", "#NV", "#WERT!", "#####"]


@pytest.mark.parametrize(
    "cell", [*SPREADSHEET, "NA", "nan", "null", "None", "Bad", "Bad Input", "No Data", "I/O Timeout", "-", "offline"]
)
@pytest.mark.parametrize("text", ["y,u\n{},1\n2,{}\n", "u;y\r1;{}\r{};2\r", "y\tu\r\n {} \t1\r\n2\t{}\r\n"])
def test_what_spreadsheets_historians_and_users_write_for_no_value(tmp_path, cell, text):
    table = written(tmp_path, text.format(cell, cell))
    run = track(Regression(1), RLS(1.0), "y", "u", data=table, missing="Offline")
    np.testing.assert_array_equal(np.column_stack([run.y, run.u]), [[np.nan, 1.0], [2.0, np.nan]])
    comments = written(tmp_path, f"# {cell}, 1\ny,u\n#no {cell},1\n#\n1,2\n")
    assert read_columns(comments, ["y"])["y"].tolist() == [1.0]


@pytest.mark.parametrize("marks", [-999, "-999", [-999.0, "Off"]])
def test_numbers_that_mean_no_value_are_counted(tmp_path, marks):
    y, x = np.array([1.0, -999.0, 3.0]), np.array([-999.0, 2.0, 3.0])
    table = pl.DataFrame({"y": y, "u": x})
    table.write_csv(tmp_path / "log.csv")
    for run in (
        track(Regression(1), RLS(1.0), y, x, missing=marks),
        track(Regression(1), RLS(1.0), "y", "u", data=table, missing=marks),
        track(Regression(1), RLS(1.0), "y", "u", data=tmp_path / "log.csv", missing=marks),
    ):
        assert run.labels.missing == {"marked as missing": 2}
        assert run.ok.tolist() == [0, 0, 1]
    with pytest.raises(ValueError, match=r"missing: give texts or numbers .* got None"):
        track(Regression(1), RLS(1.0), y, x, missing=[None])


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("y,u\n\n1,2\n\n3,4\n\n", [1.0, 3.0]),
        ("y,u\r\n\r\n1,2\r\n\r\n3,4\r\n", [1.0, 3.0]),
        ("y,u\r\r1,2\r\r3,4\r", [1.0, 3.0]),
        ("y,u\n1,2\n , \n3,4\n", [1.0, np.nan, 3.0]),  # a row of empty cells is a sample
        ("y\n\n1\n\n3\n\n", [1.0, 3.0]),
        ("y\n1\n\n3\n", [1.0, np.nan, 3.0]),  # in one column a blank line is an empty cell
    ],
)
def test_blank_lines(tmp_path, text, expected):
    np.testing.assert_array_equal(read_columns(written(tmp_path, text), ["y"])["y"], expected)


@pytest.mark.parametrize(
    ("text", "units"),
    [
        ("t,y,u\ns,bar,[1/s]\n0,1,2\n1,3,4\n", {"y": "bar", "u": "1/s"}),
        ("t;y;u\n;°C;\n0;1.5;2\n1;3;4\n", {"y": "°C"}),
        ("t,y,u\nBad,Bad,\n0,1,2\n1,3,4\n", {}),  # a row of missing readings
        ("t,y,u\n0,1,2\n1,3,4\n", {}),
    ],
)
def test_a_row_of_units_is_not_a_sample(tmp_path, text, units):
    path = written(tmp_path, text, "cp1252")
    run = track(Regression(1), RLS(1.0), "y", "u", data=path)
    assert dict(run.labels.units) == units
    assert len(run) == (3 if "Bad" in text else 2)
    assert Files(path, rows=(2, None)).columns(Wanted(("y", "u")))[0].units == units


def test_bytes_of_windows_1252_anywhere(tmp_path):
    text = "unit,y,u\n" + "a,1,2\n" * 20_000 + "Zürich,3,4\n"
    fleet = track(Regression(1), RLS(1.0), "y", "u", data=written(tmp_path, text, "cp1252"), by="unit")
    assert list(fleet) == ["a", "Zürich"]


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_a_line_that_declares_the_separator_and_files_with_a_byte_order_mark(tmp_path, encoding):
    for text in ("sep=!\r\nt!y\r\n1!2.5\r\n", "t;y\n1;2.5\n", "t|y\n1|2.5\n", "t\ty\n1\t2.5\n"):
        np.testing.assert_array_equal(read_columns(written(tmp_path, text, encoding), ["y"])["y"], [2.5])


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


@pytest.mark.parametrize(
    "text",
    [
        "t,y\n1,1.5,\n2,2.5,\n",
        "t;y\n1;1.5;;\n2;2.5\n",
        "\r\rt,y\r1,1.5\r2,2.5\r",
        "t;y;name (a, b, c)\n1;1.5;x\n2;2.5;y\n",
    ],
)
def test_separators_at_the_ends_of_lines_and_other_lines(tmp_path, text):
    assert read_columns(written(tmp_path, text), ["y"], "t")["y"].tolist() == [1.5, 2.5]


def test_compressed_files_and_utf_16_without_a_mark(tmp_path):
    path = written(tmp_path, "t,y\n1,2.5\n")
    path.write_bytes(gzip.compress(path.read_bytes()))
    assert read_columns(path, ["y"])["y"].tolist() == [2.5]
    path.write_bytes(gzip.compress(b"t,y\n1,2.5\n")[:-9])
    with pytest.raises(ValueError, match="cannot be decompressed"):
        read_columns(path, ["y"])
    for encoding in ("utf-16-le", "utf-16-be"):
        assert read_columns(written(tmp_path, "t,y\n1,2.5\n", encoding), ["y"])["y"].tolist() == [2.5]


def test_times_on_the_command_line():
    axis = np.array(["2024-01-31"], "datetime64[us]")
    for text in ("20240201", "2024-02-01"):
        assert end_of("--to", text, axis, None, 0) == np.datetime64("2024-02-01")
        assert end_of("--to", text, axis, None, 1) == np.datetime64("2024-02-01T23:59:59.999999")
    assert [end_of("", "2024", axis, None, k) for k in (0, 1)] == [
        np.datetime64(t) for t in ("2024-01-01", "2024-12-31T23:59:59.999999")
    ]
    for text in ("01/02/2024", "2024-02-31", "yesterday"):
        with pytest.raises(ValueError, match=f"--from: .* must be a date or a datetime.*'{text}'"):
            end_of("--from", text, axis, None, 0)


def test_intervals_that_are_excluded_are_days_without_hyphens_too():
    days = np.datetime64("2024-01-30") + np.arange(5)
    assert within([("20240131", "20240201")], days, np.arange(5)).tolist() == [False, True, True, False, False]
    with pytest.raises(ValueError, match="got '20240231'"):
        within([("20240131", "20240231")], days, np.arange(5))


@pytest.mark.parametrize(
    ("numbers", "warned"),
    [
        ([20240130, 20240131, 20240201], True),
        ([20240129, 20240130, 20240131], False),  # their differences are right
        ([202401, 202402, 202403], False),
        ([2024013022, 2024013023, 2024013100], True),
        ([20240131235900, 20240131235959, 20240201000000], True),
        ([20240131, 20240132, 20240233], False),
        ([1970, 1971, 1972], False),
        ([1904067198, 1904067199, 1904067200], False),  # seconds
    ],
)
def test_numbers_that_are_written_like_dates(numbers, warned):
    with pytest.warns(DataWarning) if warned else nullcontext():
        warn_of_written_numbers(np.array(numbers, float))


def test_years_that_pandas_read_as_nanoseconds():
    years = np.arange(1970, 1980)
    with pytest.warns(DataWarning, match="1970 to 1979 nanoseconds after the beginning of 1970"):
        warn_of_counted_years(years.astype("datetime64[ns]"))
    warn_of_counted_years(years.astype(str).astype("datetime64[Y]").astype("datetime64[ns]"))
    with pytest.raises(ValueError, match="as in dt=1 for the years 1970, 1971"):
        Clock.of("year").steps(years.astype(float))


def test_packed_results_are_looked_at_before_they_are_unpacked(tmp_path):
    """An .npz of 2.3 MB took 3.2 GB."""
    np.savez_compressed(tmp_path / "a.npz", header=np.array('{"kind": "track"}'), y=np.zeros(200_000))
    with pytest.raises(ValueError, match="is not a driftfit file, or it is damaged") as caught:
        read(tmp_path / "a.npz", "track")
    assert "would unpack to more" in str(caught.value.__cause__)


def test_damaged_files_give_one_error(tmp_path):
    """Panics of the Parquet reader are no exceptions."""
    path, rng = tmp_path / "a.mat", np.random.default_rng(0)
    savemat(path, {"y": np.zeros((30, 1)), "u": np.zeros((30, 1))})
    good = path.read_bytes()
    for cut in (0, 60, 200, 400):
        path.write_bytes(good[:cut])
        with pytest.raises(ValueError, match=r"is not a .mat file, or it is damaged|has no variable|must say"):
            read_mat(path)
    pl.DataFrame({"t": np.arange(50.0), "y": rng.normal(size=50)}).write_parquet(tmp_path / "a.parquet")
    good = (tmp_path / "a.parquet").read_bytes()
    for at in rng.integers(0, len(good), 150).tolist():
        (tmp_path / "b.parquet").write_bytes(good[:at] + bytes([good[at] ^ 85]) + good[at + 1 :])
        with suppress(ValueError):
            read_columns(tmp_path / "b.parquet", ["y"])
