"""The command line: what it writes is what Python gives, and every mistake ends in one helpful line."""

import warnings

import numpy as np
import polars as pl
import pytest
from cli_support import fails, run

from driftfit import ARX, Kalman, Regression, track, trackers
from driftfit.cli import main
from driftfit.cli.reading import parse_interval
from driftfit.data.clock import Clock
from driftfit.data.files import read_columns
from driftfit.models.hammerstein_wiener.basis import BSpline, Legendre, PiecewiseLinear, Polynomial
from driftfit.models.hammerstein_wiener.model import HammersteinWiener
from driftfit.models.hammerstein_wiener.thresholds import DeadZone
from driftfit.parsing import settings
from driftfit.show.export import as_table

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
    message = fails("track", file, "--y", "flow rate", "--u", "pressure", "-p", "q=1")
    assert "AdaptiveKalman has no setting 'q'" in message
    assert "Kalman" in message


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


def test_regressors_are_named_after_columns(file):
    arguments = ["--y", "flow rate", "--u", "pressure", "--model", "regression:intercept"]
    printed = run("track", file, *arguments, *SETTINGS)
    assert "Regression(regressors=('pressure',), intercept=True)" in printed


def test_wrong_column_gets_near_matches(file):
    message = fails("track", file, "--y", "flowrate", *SETTINGS)
    assert "'flowrate'" in message
    assert "did you mean flow rate?" in message
    assert "hour, flow rate, pressure, label" in fails("track", file, "--y", "zzz", *SETTINGS)


def test_text_in_a_column_is_named_with_its_row(file):
    text = file.read_text().replace("7,", "7,?? ", 1)
    file.write_text(text)
    message = fails("track", file, "--y", "flow rate", "--u", "pressure", *SETTINGS)
    assert "row 8 of column 'flow rate' holds '?? " in message
    assert "not a number" in message
    assert "'ok'" in fails("track", file, "--y", "label", "--model", "arx:1,0", *SETTINGS)


def test_missing_and_unreadable_files(file, tmp_path):
    assert "nowhere.csv" in fails("track", tmp_path / "nowhere.csv", "--y", "y", *SETTINGS, "--model", "arx:1,0")
    (tmp_path / "empty.csv").write_text("")
    assert "empty.csv" in fails("track", tmp_path / "empty.csv", "--y", "y", *SETTINGS, "--model", "arx:1,0")
    fails("track", tmp_path, "--y", "y", *SETTINGS, "--model", "arx:1,0")


@pytest.mark.parametrize(
    ("model", "hint"),
    [
        ("arrx:1,1", "did you mean ARX or ARMAX?"),
        ("arx:1,x", "'x' is neither a number nor a setting"),
        ("arx:1,1,nkk=1", "did you mean nk?"),
        ("arx:1,1,1,1,1,1,1", "too many numbers"),
        ("arx:1,na=2", "na is given twice"),
        ("arx:-1", "neither a number"),
        ("arx:1.5", "whole number"),
        ("arx", "missing 1 required"),
        ("arx:1,1/1", "2 inputs"),
        ("arx:1,1,start=later", "'drop', 'zero'"),
        ("hammerstein-wiener:1,1,input=cubic/3", "polynomial/DEGREE"),
        ("hammerstein-wiener:1,1,input=polynomial/2/3", "too many"),
        ("hammerstein-wiener:1,1,input=legendre/2/3/1", "low below high"),
    ],
)
def test_wrong_models(file, model, hint):
    assert hint in fails("track", file, "--y", "flow rate", "--u", "pressure", "--model", model, *SETTINGS)


@pytest.mark.parametrize(
    ("settings", "hint"),
    [
        (["q"], "name=value"),
        (["q="], "name=value"),
        (["qq=1"], "did you mean q?"),
        (["q=1", "q=2"], "given twice"),
        (["q=many", "r=1"], "must be numeric"),
        (["q=1,2,3", "r=1"], "shape (3,)"),
        (["q=-1", "r=1"], "at least 0"),
        (["q=1"], "r must be given"),
        (["q=1", "r=none"], "r must be given"),
    ],
)
def test_wrong_settings(file, settings, hint):
    given = [part for setting in settings for part in ("-p", setting)]
    assert hint in fails(
        "track", file, "--y", "flow rate", "--u", "pressure", "--model", "arx:1,1", "--tracker", "kalman", *given
    )


def test_wrong_endings_are_refused_before_the_work(file, tmp_path):
    arguments = ["track", file, "--y", "flow rate", "--u", "pressure", *SETTINGS]
    assert ".parquet" in fails(*arguments, "--out", tmp_path / "result.xls")
    assert "--dt soon" in fails(*arguments, "--dt", "soon")
    assert ".html" in fails(*arguments, "--report", tmp_path / "page.pdf", "--y", "no such column")
    for option in ("--plot", "--system"):
        assert "written to .png" in fails(*arguments, option, tmp_path / "run.foo", "--y", "no such column")
    for option, name in (("--out", "x.csv"), ("--plot", "x.png"), ("--report", "x.html")):
        place = tmp_path / "nowhere" / name
        expected = f"driftfit: {option} {place}: there is no folder {place.parent}."
        assert fails(*arguments, option, place, "--y", "no such column") == expected


def test_messages_of_the_system_and_warnings_are_sentences(file, tmp_path, monkeypatch):
    absent = tmp_path / "absent.csv"
    assert fails("track", absent, "--y", "y") == f"driftfit: {absent}: No such file or directory"
    assert "pickle" not in fails("track", file, "--y", "flow rate", "--start", file)
    assert "no signal has the name 'flow'; did you mean flow rate?" in fails(
        "track", file, "--y", "flow rate", "--u", "pressure", "--unit", "flow=l/min"
    )
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


def test_missing_cells(tmp_path):
    path = tmp_path / "gaps.csv"
    path.write_text('a,b\n1, 2.5\n,NA\nnan,"null"\n None,-inf\n"3",4e1\n')
    columns = read_columns(path, ["a", "b"])
    assert np.array_equal(columns["a"], [1, np.nan, np.nan, np.nan, 3], equal_nan=True)
    assert np.array_equal(columns["b"], [2.5, np.nan, np.nan, -np.inf, 40], equal_nan=True)


def test_times_must_be_there_and_be_times(tmp_path):
    path = tmp_path / "times.csv"
    path.write_text("t,a\n2024-01-31,1\nlater,2\n")
    with pytest.raises(ValueError, match="row 2 of column 't' holds 'later'"):
        read_columns(path, ["a"], time="t")
    path.write_text("t,a\n1,1\n,2\n")
    assert np.array_equal(read_columns(path, ["a"], time="t")["t"], [1.0, np.nan], equal_nan=True)
    with pytest.raises(ValueError, match="time must increase"):
        track(Regression(0, intercept=True), Kalman(q=0, r=1), [1.0, 2.0], time=[1.0, np.nan])
    path.write_text("t,a\nsoon,1\nlater,2\n")
    with pytest.raises(ValueError, match="row 1 of column 't' holds 'soon'"):
        read_columns(path, ["a"], time="t")


def test_a_parameter_may_be_called_y():
    y, u = simulate()
    run = track(Regression(["y"]), Kalman(q=1e-4, r=0.01), y, u)
    assert as_table(run).columns[-2:] == ["theta_y", "std_y"]
