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
from driftfit.cli.reading import Part, moment, rows_of
from driftfit.data.clock import Clock
from driftfit.data.files import read_columns
from driftfit.data.instants import warn_of_counted_years, warn_of_written_numbers
from driftfit.data.limits import within
from driftfit.data.storage import read


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
        ('t,y\n1,"1,065.26"\n', "holds '1,065.26', which is not a number (1 such cell); write numbers without signs"),
        ("t;y\n1;1,234\n2.5;3,500\n", "row 1 of column 'y' holds '1,234'"),  # commas between thousands
        ("t,y\n1,bar\n1,2\n", "holds 'bar', which is not a number (1 such cell); if this line holds units"),
        (
            "y;u;z\n1.234;2,5;1.5\n3.500;4,5;2\n",
            "the dot in 1.234 of column 'y' may be a decimal point or stand",
        ),
        ("y;u\n1.234;Ruhe\n3.500;0,5\n", "the file has decimal commas and text among them. Give --decimal ,"),
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


def test_day_or_month_first_is_read_from_the_column_and_never_guessed(tmp_path):
    assert dates(tmp_path, "1/31/2024", "2/1/2024") == ["2024-01-31", "2024-02-01"]
    assert dates(tmp_path, "31/1/2024", "1/2/2024") == ["2024-01-31", "2024-02-01"]
    assert dates(tmp_path, "1.2.2024", "2.2.2024") == ["2024-02-01", "2024-02-02"]
    for cells in (("1/1/2024", "2/1/2024"), ("13/1/24", "14/1/24"), ("1/1/24 3:15 PM", "2/1/24 3:15 PM")):
        with pytest.raises(ValueError, match=f"such as '{cells[0]}', may have the day or the month first"):
            dates(tmp_path, *cells)
    with pytest.raises(ValueError, match=re.escape("row 1 of column 't' holds '31.02.2024'")):
        dates(tmp_path, "31.02.2024", "1.3.2024")


@pytest.mark.parametrize(
    ("cells", "last"),
    [
        (("1/31/2024 11:15 AM", "2/1/2024 3:15:30 PM"), "2024-02-01T15:15:30"),
        (("1/31/24 12:00 am", "2/1/24 12:00 am"), "2024-02-01T00:00:00"),
        (("2024-01-31 11:15 a.m.", "2024-02-01 03:15 p.m."), "2024-02-01T15:15:00"),
        (("01-Jan-24", "01-Feb-24"), "2024-02-01T00:00:00"),
        (("31 January 2024 9:30", "1 February 2024 9:30"), "2024-02-01T09:30:00"),
        (("Jan 01, 2024", "Feb 01, 2024"), "2024-02-01T00:00:00"),
    ],
)
def test_dates_of_other_forms(tmp_path, cells, last):
    text = "t;y\n" + "\n".join(f"{cell};1" for cell in cells)
    found = read_columns(written(tmp_path, text), ["y"], "t")["t"]
    assert found.tolist()[1] == np.datetime64(last, "us").tolist()


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


SPREADSHEET = ["#N/A", "#DIV/0!", "#VALUE!", "#REF!", "#NUM!", "#NAME?", "#NULL!", "#SPILL!", "#NV", "#WERT!", "#####"]


@pytest.mark.parametrize("cell", [*SPREADSHEET, "Bad", "Bad Input", "No Data", "I/O Timeout", "-", "offline"])
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
        ("t;y;u\n;°C;\n0;1,5;2\n1;3;4\n", {"y": "°C"}),
        ("t,y,u\nBad,Bad,\n0,1,2\n1,3,4\n", {}),  # a row of missing readings
        ("t,y,u\n0,1,2\n1,3,4\n", {}),
    ],
)
def test_a_row_of_units_is_not_a_sample(tmp_path, text, units):
    path = written(tmp_path, text, "cp1252")
    run = track(Regression(1), RLS(1.0), "y", "u", data=path)
    assert dict(run.labels.units) == units
    assert len(run) == (3 if "Bad" in text else 2)
    assert rows_of([str(path)], ["y", "u"], None, [], Part(rows=(2, None))).units == units


def test_bytes_of_windows_1252_anywhere(tmp_path):
    text = "unit,y,u\n" + "a,1,2\n" * 20_000 + "Zürich,3,4\n"
    fleet = track(Regression(1), RLS(1.0), "y", "u", data=written(tmp_path, text, "cp1252"), by="unit")
    assert list(fleet) == ["a", "Zürich"]


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_a_line_that_declares_the_separator_and_files_with_a_byte_order_mark(tmp_path, encoding):
    for text in ("sep=!\r\nt!y\r\n1!2.5\r\n", "t;y\n1;2,5\n", "t|y\n1|2.5\n", "t\ty\n1\t2,5\n", "t|y\n1|2,5\n"):
        np.testing.assert_array_equal(read_columns(written(tmp_path, text, encoding), ["y"])["y"], [2.5])


def test_whole_numbers_with_dots_between_thousands_beside_decimal_commas(tmp_path):
    path = written(tmp_path, "a;b;c\n998;1,5;0.998\n1.002;2,5;1.002\nn/a;3,5;2\n")
    np.testing.assert_array_equal(read_columns(path, ["a"])["a"], [998.0, 1002.0, np.nan])  # whatever else is read
    np.testing.assert_array_equal(read_columns(path, ["c"])["c"], [0.998, 1.002, 2.0])


def test_decimal_commas_far_below_the_header_and_below_one_of_several_lines(tmp_path):
    path = written(tmp_path, "a;b\n" + "1234;5678\n" * 7000 + "1.234;2,5\n")
    assert read_columns(path, ["a"])["a"][-1] == read_columns(path, ["a", "b"])["a"][-1] == 1234.0
    path = written(tmp_path, '"a\n[V]";"b\n[A]"\n1.234;2,5\n')
    assert read_columns(path, ["a\n[V]"])["a\n[V]"] == 1234.0


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
        "t;y\n1;1,5;;\n2;2,5\n",
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


@pytest.mark.parametrize(
    "text",
    [
        "# 1;2,5;3\ny;u\n1.234;2\n3.500;4\n",  # a comment
        "y;u;0,5\n1.234;2;1\n3.500;4;2\n",  # a name
        "y;u\n" + "3.500;4\n" * 8191 + "1.234;2\n" + "3.500;4\n" * 9,  # the probe ends within a line
    ],
)
def test_commas_elsewhere_do_not_make_numbers_larger(tmp_path, text):
    found = read_columns(written(tmp_path, text), ["y"])["y"]
    assert set(found.tolist()) == {1.234, 3.5}


def test_decimal_commas_in_times(tmp_path):
    for text, part in (("t,y\n", Part(decimal=",", separator=";")), ("t;y\n", Part())):
        path = written(tmp_path, text.replace(",", ";") + "0,5;1,5\n1,5;2,5\n")
        assert rows_of([str(path)], ["y"], "t", [], part).time.tolist() == [0.5, 1.5]


def test_rows_have_the_order_of_day_and_month_of_the_whole_file(tmp_path):
    path = written(tmp_path, "t,y\n31/01/2024,1\n01/02/2024,2\n02/02/2024,3\n")
    found = rows_of([str(path)], ["y"], "t", [], Part(rows=(2, None)))
    assert found.time.astype("datetime64[D]").astype(str).tolist() == ["2024-02-01", "2024-02-02"]
    with pytest.raises(ValueError, match="row 2 of column 'y' holds 'x'"):
        rows_of([str(written(tmp_path, "t,y\n1,x\n1,x\n"))], ["y"], "t", [], Part(rows=(2, None)))


def test_times_on_the_command_line():
    axis = np.array(["2024-01-31"], "datetime64[us]")
    for text in ("20240201", "2024-02-01", "1.2.2024", "2024/02/01"):
        assert str(moment(text, axis, None)) == "2024-02-01T00:00:00.000000"
        assert str(moment(text, axis, None, end=True)) == "2024-02-01T23:59:59.999999"
    assert str(moment("2024", axis, None)) == "2024-01-01T00:00:00.000000"
    assert str(moment("2024", axis, None, end=True)) == "2024-12-31T23:59:59.999999"
    for text in ("01/02/2024", "2024-02-31", "yesterday"):
        with pytest.raises(ValueError, match=f"'{text}'"):
            moment(text, axis, None)


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


def test_packed_files_are_looked_at_before_they_are_unpacked(tmp_path, monkeypatch):
    """An .npz of 2.3 MB took 3.2 GB."""
    zeros = np.zeros(200_000)
    np.savez_compressed(tmp_path / "a.npz", header=np.array('{"kind": "track"}'), y=zeros)
    with pytest.raises(ValueError, match="is not a driftfit file, or it is damaged") as caught:
        read(tmp_path / "a.npz", "track")
    assert "would unpack to more" in str(caught.value.__cause__)
    monkeypatch.setattr("driftfit.data.files.UNPACKED_BYTES", 1000)
    (tmp_path / "a.csv.gz").write_bytes(gzip.compress(b"t,y\n" + b"1,2\n" * 100_000))
    (tmp_path / "b.csv.gz").write_bytes(gzip.compress(b"t,y\n" + b"1,2\n" * 100_000)[:-4] + bytes(4))  # says nothing
    pl.DataFrame({"y": zeros}).write_parquet(tmp_path / "a.parquet")
    for name in ("a.csv.gz", "b.csv.gz", "a.parquet"):
        with pytest.raises(ValueError, match="says that it unpacks to"):
            read_columns(tmp_path / name, ["y"])
    h5py = pytest.importorskip("h5py", reason="h5py is not installed")
    savemat(tmp_path / "a.mat", {"y": zeros[:, None]}, do_compression=True)
    with h5py.File(tmp_path / "b.mat", "w", userblock_size=512) as file:
        file.create_dataset("y", (1, 10**9), "f8", chunks=(1, 1000))
    with (tmp_path / "b.mat").open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\0\2IM")
    for name in ("a.mat", "b.mat"):
        with pytest.raises(ValueError, match="says that it unpacks to"):
            read_mat(tmp_path / name)


def test_damaged_files_give_one_error(tmp_path):
    """Some bytes of a .mat file ended the process, and panics of the Parquet reader are no exceptions."""
    rng, path = np.random.default_rng(0), tmp_path / "a.mat"
    signals = {"y": rng.normal(size=(30, 1)), "u": np.zeros((30, 1)), "names": np.array(["flow"], object)}
    for compressed in (False, True):
        savemat(path, {"s": signals}, do_compression=compressed)
        good, refused = path.read_bytes(), 0
        places = [144, 224, 225, 256, 257, *rng.integers(0, len(good), 300).tolist()]  # first flags and types
        for at in places:
            path.write_bytes(good[:at] + bytes([good[at] ^ int(rng.choice([7, 9, 14, 128]))]) + good[at + 1 :])
            with suppress(ValueError):
                refused -= len(read_mat(path)[0]) > 0
            refused += 1
        assert refused > 50
    pl.DataFrame({"t": np.arange(50.0), "y": rng.normal(size=50)}).write_parquet(tmp_path / "a.parquet")
    good = (tmp_path / "a.parquet").read_bytes()
    for at in rng.integers(0, len(good), 150).tolist():
        (tmp_path / "b.parquet").write_bytes(good[:at] + bytes([good[at] ^ 85]) + good[at + 1 :])
        with suppress(ValueError):
            read_columns(tmp_path / "b.parquet", ["y"])
