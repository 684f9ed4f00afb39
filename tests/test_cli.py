"""The command line: what it writes is what Python gives, and every mistake ends in one helpful line."""

import shlex
import warnings

import numpy as np
import polars as pl
import pytest
from cli_support import fails, run

from driftfit import ARX, Kalman, Regression, track, trackers
from driftfit.cli import main
from driftfit.cli.options import parse_interval
from driftfit.data.clock import Clock
from driftfit.models.hammerstein_wiener.basis import BSpline, Legendre, PiecewiseLinear, Polynomial
from driftfit.models.hammerstein_wiener.model import HammersteinWiener
from driftfit.models.hammerstein_wiener.thresholds import DeadZone
from driftfit.parsing import settings

SETTINGS = ["--tracker", "kalman", "-p", "q=1e-4", "-p", "r=0.01"]


def simulate(T=200, seed=3):
    rng = np.random.default_rng(seed)
    u = rng.normal(size=T)
    y = np.zeros(T)
    for t in range(1, T):
        y[t] = 0.7 * y[t - 1] + u[t - 1] + 0.1 * rng.normal()
    return y, u


@pytest.fixture
def file(tmp_path):
    y, u = simulate()
    text = ["# a comment", "hour,flow rate,pressure,label"]
    text += [f"{t},{'' if t == 50 else repr(float(y[t]))},{float(u[t])!r},ok" for t in range(len(y))]
    path = tmp_path / "plant.csv"
    path.write_text("\n".join(text))
    return path


def expected(inputs="pressure", **given):
    y, u = simulate()
    y[50] = np.nan
    return track(ARX(1, 1, inputs=[inputs]), Kalman(q=1e-4, r=0.01), y, u, **given)


def test_track_prints_the_summary_of_the_run(file):
    printed = run("track", file, "--y", "flow rate", "--u", "pressure", "--model", "arx:1,1", *SETTINGS)
    printed = [line for line in printed.splitlines() if "flow rate from pressure" not in line]
    assert str(expected().summary()).splitlines() == printed


def test_without_settings_the_tracker_chooses_them(file):
    printed = run("track", file, "--y", "flow rate", "--u", "pressure", "--model", "arx:1,1")
    assert "AdaptiveKalman()" in printed


@pytest.mark.parametrize("ending", [".csv", ".parquet"])
def test_out_is_the_table_of_the_run(file, tmp_path, ending):
    out = tmp_path / f"result{ending}"
    arguments = ["--y", "flow rate", "--u", "pressure", "--model", "arx:1,1", "--time", "hour", *SETTINGS]
    run("track", file, *arguments, "--out", out)
    table = pl.read_csv(out) if ending == ".csv" else pl.read_parquet(out)
    of_run = expected(time=np.arange(200.0))
    assert table.columns == [
        "hour", "flow rate", "pressure", "prediction", "innovation", "innovation_std", "ok",
        "theta_a1", "std_a1", "theta_b1[pressure]", "std_b1[pressure]",
    ]  # fmt: skip
    assert np.array_equal(table["theta_b1[pressure]"], of_run.theta[:, 1])
    assert np.array_equal(table["std_a1"], of_run.std[:, 0])
    assert np.array_equal(table["innovation"], of_run.innovation, equal_nan=True)
    assert np.array_equal(table["ok"], of_run.ok)
    assert np.array_equal(table["hour"], np.arange(200.0))


def test_dates_need_dt_and_take_it(tmp_path):
    y, u = simulate()
    dates = np.datetime64("2024-01-01T00:00") + np.arange(200) * np.timedelta64(15, "m")
    path, out = tmp_path / "dated.csv", tmp_path / "result.parquet"
    path.write_text(
        "\n".join(
            ["when,y,u", *(f"{d}:00Z,{a!r},{b!r}" for d, a, b in zip(dates, y.tolist(), u.tolist(), strict=True))]
        )
    )
    arguments = ["track", path, "--y", "y", "--u", "u", "--model", "arx:1,1", "--time", "when", *SETTINGS]
    assert "dt must be given" in fails(*arguments)
    run(*arguments, "--dt", "15min", "--out", out)
    table = pl.read_parquet(out)
    assert np.array_equal(table["when"].to_numpy(), dates.astype("datetime64[us]"))
    assert np.array_equal(table["theta_a1"], track(ARX(1, 1), Kalman(q=1e-4, r=0.01), y, u).theta[:, 0])


def test_a_folder_that_is_not_there_is_named_before_the_work(file, tmp_path):
    arguments = ["track", file, "--y", "flow rate", "--u", "pressure", *SETTINGS]
    for option, name in (("--out", "x.csv"), ("--plot", "x.png"), ("--report", "x.html")):
        place = tmp_path / "nowhere" / name
        expected = f"driftfit: {option} {place}: there is no folder {place.parent}."
        assert fails(*arguments, option, place, "--y", "no such column") == expected


def test_messages_of_the_system_and_warnings_are_sentences(file, tmp_path, monkeypatch):
    absent = tmp_path / "absent.csv"
    assert fails("track", absent, "--y", "y") == f"driftfit: {absent}: No such file or directory"
    monkeypatch.setattr(warnings, "formatwarning", warnings.formatwarning)
    monkeypatch.setattr("sys.argv", ["driftfit", "--version"])
    with pytest.raises(SystemExit):
        main()
    shown = warnings.formatwarning(UserWarning("the record is short."), UserWarning, "tune.py", 36)
    assert shown == "driftfit: warning: the record is short.\n"


@pytest.mark.parametrize("name", ["AugmentedFLS", "augmentedfls", "augmented-fls", "augmented_FLS"])
def test_tracker_names(name):
    assert type(settings.parse_tracker(name, ["mu=1"])).__name__ == "AugmentedFLS"


def test_values():
    kalman = settings.parse_tracker("kalman", ["q=1e-4, 0", "r=0.1", "p0=none", "theta0=-1"])
    assert kalman == Kalman(q=(1e-4, 0.0), r=0.1, p0=None, theta0=-1.0)
    assert settings.parse_model("ARX:2,1/2,nk=0/1,intercept") == ARX(2, (1, 2), (0, 1), intercept=True)
    assert settings.parse_model("arx: na=2, nb=0") == ARX(2, 0)
    assert settings.parse_model("ARX(2, [1, 2], nk=[0, 1])") == ARX(2, (1, 2), (0, 1))
    assert settings.parse_tracker("Kalman(q=1e-4, r=0.1)", []) == Kalman(q=1e-4, r=0.1)
    for wrong in ("Kalman(q=1)", "__import__('os')", "ARX(open('f'))", "ARX(*[1])", "ARX(na=oops)"):
        with pytest.raises(ValueError, match=r"not a model|there is no|not allowed|not a number"):
            settings.parse_model(wrong)
    with pytest.raises(ValueError, match="leave r=2 out"):
        settings.parse_tracker("Kalman(q=1)", ["r=2"])
    for words, basis in (
        ("polynomial/3", Polynomial(3)), ("Legendre/4/-2/2.5", Legendre(4, (-2, 2.5))),
        ("piecewise-linear/-1/0/1", PiecewiseLinear([-1, 0, 1])), ("bspline/2/-1/0/1", BSpline(2, [-1, 0, 1])),
        ("dead-zone/3", DeadZone(3)),
        ("dead-zone/3/0.1/average", DeadZone(3, 0.1, "average")),
    ):  # fmt: skip
        model = settings.parse_model(f"hammerstein-wiener:1,2,input={words}")
        assert model == HammersteinWiener(1, 2, input=basis)
    assert settings.parse_model("arx:1,intercept=false,start=zero") == ARX(1, start="zero")
    assert settings.parse_model("regression:intercept").bind(["a"]) == Regression(["a"], intercept=True)


def test_intervals():
    assert parse_interval(None) is None
    assert parse_interval("0.25") == 0.25
    durations = {"10ms": 0.01, "1s": 1, "15min": 900, "15m": 900, "1h": 3600, "1d": 86400, "2w": 1209600}
    for text, seconds in durations.items():
        assert Clock.of(parse_interval(text)).duration / np.timedelta64(1, "s") == seconds
    for text in ("month", "quarter", "year", "business day", "label"):
        assert Clock.of(parse_interval(text)) == Clock.of(text)


def test_trackers_are_all_listed_with_their_settings():
    printed = run("trackers")
    for name, kind in trackers.found().items():
        assert name in printed
        for field in settings.given_fields(kind):
            assert f"{field.name}=" in printed


PLANT = ["--y", "flow rate", "--u", "pressure"]
MISTAKES = {
    "--y flowrate": "'flowrate': did you mean flow rate?",
    "--y zzz": "hour, flow rate, pressure, label",
    "--y label": "row 1 of column 'label' holds 'ok', which is not a number",
    "--y ,": "names no column",
    "--y hour,hour": "--y hour,hour: name each output once",
    "--y pressure": "--u pressure: this is the output",
    "--u '\"valve, cold'": "a name with a comma is quoted as in a CSV file",
    "--unit flow": "give a unit as column=unit",
    "--unit flow=l/min": "no signal has the name 'flow'; did you mean flow rate?",
    "--model arx:1,1,ny=3 --y hour": "y must name 3 columns, one for each output",
    "--model arrx:1,1": "did you mean ARX or ARMAX?",
    "--model arx:1,x": "'x' is neither a number nor a setting",
    "--model arx:1,1,nkk=1": "did you mean nk?",
    "--model arx:1,1,1,1,1,1,1": "too many numbers",
    "--model arx:1,na=2": "na is given twice",
    "--model arx:-1": "neither a number",
    "--model arx:1.5": "whole number",
    "--model arx": "missing 1 required",
    "--model arx:1,1/1": "2 inputs",
    "--model arx:1,1,start=later": "'drop', 'zero'",
    "--model hammerstein-wiener:1,1,input=cubic/3": "polynomial/DEGREE",
    "--model hammerstein-wiener:1,1,input=polynomial/2/3": "too many",
    "--model hammerstein-wiener:1,1,input=legendre/2/3/1": "low below high",
    "--tracker kalman -p q": "name=value",
    "--tracker kalman -p q=": "name=value",
    "--tracker kalman -p qq=1": "did you mean q?",
    "--tracker kalman -p q=1 -p q=2": "given twice",
    "--tracker kalman -p q=many -p r=1": "must be numeric",
    "--tracker kalman -p q=1,2,3 -p r=1 --model arx:1,1": "shape (3,)",
    "--tracker kalman -p q=-1 -p r=1": "at least 0",
    "--tracker kalman -p q=1": "--tracker kalman: r must be given: -p r=...; `driftfit tune`",
    "--tracker kalman -p q=1 -p r=none": "r must be given",
    "-p q=1": "AdaptiveKalman has no setting 'q'",
    "--rows 1000:": "plant.csv has no row 1000",
    "--rows 5": "--rows 5", "--rows 0:3": "--rows 0:3", "--rows 7:3": "--rows 7:3", "--rows a:b": "--rows a:b",
    "--from 3": "need --time",
    "--time hour --from 300": "no row is between",
    "--time hour --from 2024-01-01": "must be a number",
    "--time hour --exclude 4": "FROM..TO",
    "--exclude 2024-03-01..2024-03-02": "an interval of rows",
    "--limits pressure=2": "column=low:high",
    "--limits presure=1:2": "did you mean pressure",
    "--separator ::": "one character",
    "--decimal :": "point or a comma",
    "--dt soon": "--dt soon",
    "--out result.xls": ".parquet",
    "--report page.pdf --y none": ".html",
    "--plot run.foo --y none": "written to .png",
    "--system run.foo --y none": "written to .png",
    "--start plant.csv": "plant.csv is not a driftfit file",
}  # fmt: skip


@pytest.mark.parametrize("mistake", MISTAKES)
def test_every_mistake_ends_in_one_helpful_line(file, monkeypatch, mistake):
    monkeypatch.chdir(file.parent)
    words = shlex.split(mistake)
    signals = PLANT[2:] if "--y" in words else PLANT
    assert MISTAKES[mistake] in fails("track", file, *signals, *words)


@pytest.mark.parametrize("name", ["nowhere.csv", "empty.csv", "z*.csv", ""])
def test_files_that_cannot_be_read_are_named(tmp_path, name):
    (tmp_path / "empty.csv").write_text("")
    assert name in fails("track", tmp_path / name, "--y", "y", "--model", "arx:1,0", *SETTINGS)
