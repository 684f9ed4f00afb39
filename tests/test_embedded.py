"""Exported trackers are C99 without warnings, and give the bits of `Live` on this processor and on a controller's."""

import ctypes
import re
import runpy
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from contract_table import forms, ready
from embedded_support import STRICT, Exported, agree, bits, needs_gcc, same_numbers
from typer.testing import CliRunner

from driftfit import (
    ARX,
    FLS,
    RLS,
    AdaptiveKalman,
    AugmentedFLS,
    Bank,
    ContinuousTransfer,
    ExtendedKalman,
    HammersteinWiener,
    Kalman,
    Law,
    Live,
    Polynomial,
    Regression,
    trackers,
)  # fmt: skip
from driftfit.cli import app
from driftfit.embedded import export_c, from_struct, to_struct
from driftfit.embedded.project import record, translation

ROOT = Path(__file__).parent.parent
CORTEX = ROOT / "tests" / "cortex"
M4F = ["-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16"]

needs_controller = pytest.mark.skipif(
    shutil.which("arm-none-eabi-gcc") is None or shutil.which("qemu-system-arm") is None,
    reason="there is no arm-none-eabi-gcc or no qemu-system-arm",
)

EVERY = [
    pytest.param(kind, form, id=f"{kind.__name__}{form or ''}")
    for kind in trackers.found().values()
    if not kind.weighs
    for form in forms(kind)
]
OTHERS = {
    "full q": (Regression(2), Kalman(q=[[1e-3, 1e-4], [1e-4, 1e-3]], r=0.1)),
    "directional": (ARX(2, 2), RLS(0.98, kind="directional")),
    "second differences": (ARX(1, 1), FLS(100.0, differences=2)),
    "two inputs": (ARX(2, [2, 1], nk=[1, 0], intercept=True), Kalman(q=1e-4, r=0.1)),
    "no input": (ARX(2, 0), Kalman(q=1e-4, r=0.1)),
    "laws": (ARX(1, 1), Kalman(q=1e-4, r=0.1, laws={"b1": (Law.trend(1e-6), Law.season(8))})),
    "continuous time": (ContinuousTransfer(2, 1, dt=0.1, offset=True), RLS(0.99)),
    "one parameter": (Regression(1), Kalman(q=1e-4, r=0.1)),
    "volatility": (ARX(1, 1), Kalman(q=1e-4, r=0.1, volatility=0.01)),
    "default, volatility": (ARX(1, 1), AdaptiveKalman(volatility=0.01)),
    "polynomials": (HammersteinWiener(1, 1, input=Polynomial(2), output=Polynomial(2)), Kalman(q=1e-4, r=0.1, p0=1.0)),
}


@needs_gcc
@pytest.mark.parametrize(("kind", "form"), EVERY)
def test_every_tracker_gives_the_bits_of_a_stream(tmp_path, kind, form):
    tracker = ready(kind, **form)
    model = tracker.own_model(2, 2, 1) or ARX(2, 2)
    agree(tmp_path, model, tracker, 10_000)


@needs_gcc
@pytest.mark.parametrize("name", OTHERS)
def test_other_models_and_settings_do_too(tmp_path, name):
    agree(tmp_path, *OTHERS[name], 1_000)


@needs_gcc
@pytest.mark.parametrize("name", ["blocks", "start", "directional", "two inputs", "polynomials", "one parameter"])
def test_a_fixed_rate_changes_no_bit(tmp_path, name):
    model, tracker = OTHERS.get(name, (ARX(2, 2), None))
    if tracker is None:
        tracker = ready({"blocks": ExtendedKalman, "start": Kalman}[name])
        model = tracker.own_model(2, 2, 1) or model
    live, ours = agree(tmp_path, model, tracker, 1_000, fixed_rate=True)
    header = (tmp_path / "tracker.h").read_text()
    kept = set(re.findall(r"\b(interval|noise|drift);", header))
    # steps of these change some meanwhile, and a diffuse start repeats samples with their own
    assert kept <= ({"noise"} if name in ("blocks", "polynomials") else {"noise", "drift"})
    assert ours.size < len(to_struct(live))
    there = from_struct(model, tracker, ours.state, fixed_rate=True)
    m = live.model.m
    assert bits(there.update(0.1, np.full(m, 0.2))) == bits(live.update(0.1, np.full(m, 0.2)))
    live.lane()["interval"][...] = 2.0
    with pytest.raises(ValueError, match=r"the field 'interval' is \[?2"):
        to_struct(live, fixed_rate=True)


@needs_gcc
@pytest.mark.parametrize("fixed_rate", [False, True])
@pytest.mark.parametrize("tracker", [Kalman(q=1e-4, r=0.01), RLS(0.99)], ids=["Kalman", "RLS"])
def test_a_gate_decides_as_it_does_in_a_stream(tmp_path, tracker, fixed_rate):
    """Also on fault codes among the first samples, which are taken in once more without them."""
    live, _ = agree(tmp_path, ARX(2, 2), tracker, 400, gate=True, fixed_rate=fixed_rate)
    counts = live.left_out.counts
    assert counts["Left out at the start"] == 2
    assert counts["Left out"] > 2


PLANNED = {
    "limits": (ARX(2, 2, nk=0), Kalman(q=1e-3, r=0.01), {"limits": (-0.8, 0.9), "move": 0.3, "effort": 0.01}),
    "two inputs": (ARX(1, (1, 2), nk=(0, 2), intercept=True), RLS(0.98), {"limits": ([-1.0, -0.3], [1.0, 0.4])}),
    "probing": (ARX(1, 1, nk=0), AdaptiveKalman(), {"probe": 0.2, "caution": 0.7, "move": 0.5}),
    "no covariance": (ARX(1, 1), AugmentedFLS(100.0), {"caution": 0.0, "move": 1.0, "limits": (-2.0, 2.0)}),
}


@needs_gcc
@pytest.mark.parametrize("name", PLANNED)
def test_a_controller_plans_the_inputs_of_a_stream_to_the_bit(tmp_path, name):
    """In a loop, from before the parameters are determined, with a missing output and an input that is given."""
    model, tracker, how = PLANNED[name]
    h, rng = 5, np.random.default_rng(2)
    export_c(model, tracker, tmp_path, gate=False, horizon=h)
    live = Live(model, tracker, gate=False)
    ours, m = Exported(tmp_path, live), live.model.m
    shapes = translation(live.program, horizon=h).planning.fields
    memory = np.zeros(1, [(field, float, shape) for field, shape in shapes.items()])
    there, place = memory[0], ctypes.c_void_p(memory.ctypes.data)
    ours.library.tracker_plan_init(place)
    for field in how.keys() - {"limits"}:
        there[field] = how[field]
    there["low"], there["high"] = how.get("limits", (-np.inf, np.inf))
    y, u, codes = np.zeros(1), np.zeros((1, m)), set()
    for t in range(60):
        reading = np.nan if t in (30, 31, 32) else float(y[0])
        live.update(reading, u[0])
        ours.update(reading, u[0])
        target, given = np.sin(0.2 * (t + np.arange(h))), np.full((h, m), np.nan)
        if t > 40 and name == "limits":
            given[3] = live.lane()["u_lag"][0, 0]
        plan = live.control(target, h, u=given, **how)
        there["target"], there["given"] = target, given
        why = ours.library.tracker_control(ours.buffer, ours.scratch, place)
        codes.add(why)
        assert (why > 0) == bool(plan.held)
        for field, found in zip(("u", "y_hat", "theta_std"), plan, strict=False):
            np.testing.assert_array_equal(there[field].ravel(), found.ravel())
        u = plan.u.reshape(h, m)[:1] if not why else rng.normal(size=(1, m))
        y = 0.7 * y + u @ np.arange(0.5, m) + 0.1 * rng.standard_normal()
    assert same_numbers(ours.state, to_struct(live))  # a plan changes nothing
    assert codes == ({0, 2} if name == "no covariance" else {0, 1, 2})


def test_numbers_that_are_only_zero_or_one_are_integers_in_c(tmp_path):
    export_c(ARX(2, 2), Kalman(q=1e-3, r=0.1, p0=1.0), tmp_path, fixed_rate=True)
    header, source = ((tmp_path / f"tracker.{end}").read_text() for end in "hc")
    assert set(re.findall(r"    int (\w+);", header)) == {"started", "dt", "valid", "observed", "ok", "late"}
    assert "(s->dt > " not in source  # 0 or 1: never a gap


@needs_gcc
@pytest.mark.parametrize("p0", [None, 1.0])
def test_states_travel_both_ways(tmp_path, p0):
    """A controller's state opens as a stream, which is saved like any other."""
    tracker = Kalman(q=1e-3, r=0.1, p0=p0)
    live, ours = agree(tmp_path, ARX(2, 2), tracker, 500)
    there = Live.from_bytes(from_struct(ARX(2, 2), tracker, ours.state).to_bytes())
    assert bits(there.theta) == bits(live.theta)
    held = [name for name in live.lane() if name not in tracker.scratch]  # never saved
    assert all(np.array_equal(there.lane()[name], live.lane()[name], equal_nan=True) for name in held)
    assert bits(ours.predict([0.3])[::2]) == bits(live.predict(0.3))
    assert same_numbers(ours.state, to_struct(live))  # a prediction changes nothing
    assert bits(there.update(0.1, 0.2)) == bits(live.update(0.1, 0.2)) == bits(ours.update(0.1, [0.2]))
    ctypes.memmove(ours.buffer, to_struct(live), ours.size)
    assert bits(ours.update(0.4, [0.5])) == bits(live.update(0.4, 0.5))
    with pytest.raises(ValueError, match="a state of 632 bytes; got 3"):
        from_struct(ARX(2, 2), tracker, b"abc")


def test_what_no_step_writes_is_left_out_of_the_structure(tmp_path):
    given, nothing = (Live(ARX(2, 2), Kalman(q=1e-3, r=0.1, p0=p0)) for p0 in (1.0, None))
    assert (
        len(to_struct(given)) == len(to_struct(nothing)) == 632
    )  # a given prior may be wide, and start on square roots
    export_c(ARX(2, 2), given.program.tracker, tmp_path)
    source = (tmp_path / "tracker.c").read_text()
    assert re.search(r"s->P\[.*\] \+ \(s->q\[i\] \* time\)", source)  # no factors of one
    assert "s->r * s->noise" in source  # settings and known factors may change on the controller
    given.lane()["drift_root"][:] = 1.5
    with pytest.raises(ValueError, match=r"to_struct: the field 'drift_root' is \[1.5, 1.5"):
        to_struct(given)


@needs_gcc
def test_reset_forgets_theta_and_keeps_the_lags(tmp_path):
    live, ours = agree(tmp_path, ARX(2, 2), Kalman(q=1e-3, r=0.1), 500)
    lags, fresh = live.lane()["y_lag"].copy(), Live(ARX(2, 2), Kalman(q=1e-3, r=0.1))
    ours.library.tracker_reset(ours.buffer)
    after = from_struct(ARX(2, 2), Kalman(q=1e-3, r=0.1), ours.state)
    np.testing.assert_array_equal(after.lane()["y_lag"], lags)
    np.testing.assert_array_equal(after.theta, fresh.theta)
    np.testing.assert_array_equal(after.std, fresh.std)


@needs_gcc
@pytest.mark.parametrize("flags", [["-O0"], ["-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]])
@pytest.mark.parametrize("name", ["adaptive", "blocks"])
def test_the_self_test_passes_unoptimised_and_under_sanitizers(tmp_path, name, flags):
    selftest(tmp_path, name, ["gcc", *flags], [])


@needs_gcc
@pytest.mark.parametrize("name", ["adaptive", "blocks", "start", "one parameter"])
def test_single_precision_is_close(tmp_path, name):
    result = selftest(tmp_path, name, ["gcc", "-O2", "-DTRACKER_SINGLE"], [])
    assert 0.0 < float(re.search(r"difference is (\S+)", result)[1]) < 1e-4


@needs_controller
@pytest.mark.parametrize("flags", [[], ["-DTRACKER_SINGLE"]])
@pytest.mark.parametrize("name", ["adaptive", "blocks"])
def test_the_self_test_passes_on_an_emulated_controller(tmp_path, name, flags):
    start = ["-nostartfiles", "--specs=rdimon.specs", "-T", str(CORTEX / "memory.ld"), str(CORTEX / "start.c")]
    run = ["qemu-system-arm", "-M", "mps2-an386", "-nographic", "-semihosting", "-kernel"]
    selftest(tmp_path, name, ["arm-none-eabi-gcc", "-O2", *M4F, *flags, *start, "-Wl,--no-warn-rwx-segments"], run)


def selftest(folder, name, compiler, run):
    """Compile the self-test and run it; it must pass and print one line."""
    kinds = {"adaptive": AdaptiveKalman, "blocks": ExtendedKalman, "start": Kalman}
    if name in OTHERS:
        model, tracker = OTHERS[name]
    else:
        tracker = ready(kinds[name])
        model = tracker.own_model(2, 2, 1) or ARX(2, 2)
    export_c(model, tracker, folder)
    target = str(folder / "selftest")
    sources = [str(folder / "tracker.c"), str(folder / "selftest.c")]
    subprocess.run([*compiler, *STRICT, "-o", target, *sources, "-lm"], check=True)
    done = subprocess.run([*run, target], capture_output=True, text=True, timeout=100, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.startswith("passed: 0 of ")
    return done.stdout


@needs_gcc
def test_a_wrong_bit_fails_the_self_test(tmp_path):
    export_c(ARX(2, 2), AdaptiveKalman(), tmp_path)
    source = tmp_path / "tracker.c"
    source.write_text(source.read_text().replace("R(0.05)", "R(0.05000000000001)"))
    command = ["gcc", *STRICT, "-o", str(tmp_path / "st"), str(source), str(tmp_path / "selftest.c"), "-lm"]
    subprocess.run(command, check=True)
    assert subprocess.run([str(tmp_path / "st")], capture_output=True, check=False).returncode == 1


@needs_gcc
@pytest.mark.parametrize("inputs", [1, 0])
def test_the_simulink_block_gives_the_bits_of_a_stream(tmp_path, inputs):
    model, tracker = ARX(2, 2 * inputs), Kalman(q=1e-3, r=0.1, p0=1.0)
    export_c(model, tracker, tmp_path)
    include = [f"-I{ROOT / 'tests' / 'simulink'}", "-DMATLAB_MEX_FILE", "-fsanitize=address,undefined"]
    sources = [str(tmp_path / name) for name in ("tracker_sfun.c", "tracker.c")]
    subprocess.run(["gcc", *STRICT, "-O1", *include, "-o", str(tmp_path / "block"), *sources, "-lm"], check=True)
    y, u = record(model, 200)
    live, rows = Live(model, tracker), "\n".join(" ".join(map(repr, row)) for row in np.c_[y, u[:, :inputs]].tolist())
    done = subprocess.run([str(tmp_path / "block")], input=rows, capture_output=True, text=True, check=True)
    for line, *row in zip(done.stdout.splitlines(), y, u[:, :inputs], strict=True):
        step = live.update(*row)
        expected = [*np.c_[live.theta, live.lane()["var"]].ravel(), step[0], step[1], step[2], step[3]]
        np.testing.assert_array_equal(np.array(line.split(), dtype=float), np.array(expected, dtype=float))


def test_an_export_that_is_not_possible_is_refused(tmp_path):
    with pytest.raises(ValueError, match="Bank has no C form"):
        export_c(ARX(1, 1), Bank(), tmp_path)
    with pytest.raises(ValueError, match="one output at a time"):
        export_c(ARX(1, 1, ny=2), Kalman(q=1e-3, r=0.1), tmp_path)
    with pytest.raises(ValueError, match="export_c: needs a stream of an ARX model"):
        export_c(Regression(1), Kalman(q=1e-3, r=0.1), tmp_path, horizon=8)
    with pytest.raises(ValueError, match="q"):
        export_c(ARX(1, 1), Kalman(), tmp_path)
    assert not list(tmp_path.iterdir())


WICKED = "*/ int evil; /*", "a\n*/ int evil(void); //", "**//int evil;", "\u202e`](x) <b>", "x??/\\", '"; evil'


@needs_gcc
def test_names_of_signals_are_no_code(tmp_path):
    """A name ended the comment of the header, and what came after it was compiled."""
    live, _ = agree(tmp_path, Regression(WICKED), Kalman(q=1e-4, r=0.1, p0=1.0), 200)
    for name in ("tracker.h", "tracker.c", "tracker_sfun.c"):
        code = re.sub(r"/\*.*?\*/", "", (tmp_path / name).read_text(), flags=re.S)
        assert "evil" not in code
        assert code.isascii()
    title, _, text = (tmp_path / "README.md").read_text().partition("\n")
    parameters = next(line for line in text.splitlines() if "Parameters" in line)
    assert parameters.count("`") == 2 * len(live.names)
    assert title.count("`") == 2


@needs_gcc
def test_the_loop_of_the_docs_prints_what_they_say(capsys, monkeypatch):
    monkeypatch.setattr("sys.argv", ["controller.py"])
    runpy.run_path(str(ROOT / "examples" / "controller.py"), run_name="__main__")
    page = (ROOT / "docs" / "embedded.md").read_text()
    result = re.search(r"`python examples/controller.py` prints.*?```text\n(.*?)```", page, re.S)[1]
    assert capsys.readouterr().out.split() == result.split()


def test_the_command_writes_the_same(tmp_path):
    export_c(ARX(2, 2), Kalman(q=1e-4, r=0.1), tmp_path / "one", horizon=4)
    words = [
        "--horizon", "4", "--model", "arx:2,2", "--tracker", "kalman", "-p", "q=1e-4", "-p", "r=0.1",
        "--out", str(tmp_path / "two"),
    ]  # fmt: skip
    assert CliRunner().invoke(app, ["export", "c", *words]).exit_code == 0
    for path in (tmp_path / "one").iterdir():
        assert path.read_text() == (tmp_path / "two" / path.name).read_text()
    wrong = CliRunner().invoke(app, ["export", "c", "--model", "arx:2,2", "--tracker", "bank", "--out", str(tmp_path)])
    assert wrong.exit_code == 2
    assert "Bank has no C form" in wrong.output


def test_readme_and_header_say_what_there_is(tmp_path):
    export_c(ARX(2, 2), Kalman(q=1e-3, r=0.1), tmp_path, horizon=8)
    readme, header = (tmp_path / "README.md").read_text(), (tmp_path / "tracker.h").read_text()
    page = " ".join((Path(__file__).parent.parent / "docs/embedded.md").read_text().split())
    assert "632 bytes in double precision" in readme
    assert "state of `Kalman` has 632 bytes" in page
    assert "at most 3675 multiplications" in readme
    assert "of the start at most 3675" in page
    counted = re.search(r"at\s+most (\d+) multiplications, (\d+) additions and 1 division\.", readme)
    assert 60 <= int(counted[1]) <= 110  # 2.5 n^2 + 8 n or so
    assert 60 <= int(counted[2]) <= 110
    size, most = (int(re.search(what, readme)[1]) for what in (r"structure of (\d+) by", r"then at most (\d+) mul"))
    assert f"{size // 1000} kB of working space, and at most {round(most / 1000)} thousand multiplications" in page
    assert "#define TRACKER_PARAMETERS 4" in header
    assert "malloc" not in (tmp_path / "tracker.c").read_text()
