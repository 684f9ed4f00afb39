"""Every command that the README and the docs show is run, quickly and on made-up files.

Commands are the lines of sh blocks, of indented and text blocks that begin with one, and `python ..` or `driftfit ..`
in the text. What other tests run is looked up there. Scripts on real records, which are no part of the project, are
loaded, and must be called in the way that they state.
"""

import contextlib
import io
import re
import runpy
import shlex
import shutil
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from typer.testing import CliRunner

from driftfit.cli import app
from lab import pages

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
FENCED = re.compile(r"```(\w*)\n(.*?)```", re.S)
INLINE = re.compile(r"`((?:python|driftfit)\s[^`]*)`")
BEGINS = re.compile(r"^\s*(?:driftfit|python|pip) (?!\S*[:|])\S.*")
ELSEWHERE = {
    "driftfit demo": ("tests/test_demo.py", "demo.show("),
    "python -m lab reproduce": ("tests/test_docs.py", "pages.compared(command) == []"),
    "python -m lab pages": ("tests/test_docs.py", '["pages", "--only"'),
    "driftfit warm": ("tests/test_cli_commands.py", 'run("warm", "--model", "arx:1,1", *KALMAN)'),
    "driftfit journal verify": ("tests/test_service_journal.py", '["journal", "verify", str(folder)'),
    "driftfit serve": ("tests/service_support.py", '"driftfit", "serve", *(what or ["--demo"])'),
    "driftfit track pump.csv --y flow --u pressure,speed": ("tests/test_identify.py", "in commands(pump)"),
    "driftfit detect pump.csv --y flow --u pressure,speed": ("tests/test_identify.py", "in commands(pump)"),
    "driftfit identify pump.csv --y flow --u pressure,speed": ("tests/test_identify.py", "in commands(pump)"),
    "python examples/controller.py": ("tests/test_embedded.py", '["controller.py"]'),
    "python -m lab bench accuracy": ("lab/tests/test_bench.py", '["bench", "accuracy", "--quick"'),
    "python -m lab budgets": ("tests/test_budgets.py", '["budgets"]'),
    "python -m lab structure": ("lab/tests/test_structure.py", '["structure", "--picture"'),
    "python -m benchmarks.spark": ("tests/test_bridge_spark.py", 'costs(True, "streams")'),
    "python -m lab bench speed": ("lab/tests/test_bench.py", '["bench", "speed", "--quick"'),
}  # fmt: skip
"""Commands, by how they begin, with the test that runs them quickly and the text that it contains."""


def commands() -> list[str]:
    found: dict[str, None] = {}
    for page in PAGES:
        text = page.read_text()
        for block in FENCED.finditer(text):
            if block[1] in ("sh", "text"):
                lines = block[2].replace("\\\n", " ").splitlines()
                found.update(dict.fromkeys(line for line in lines if block[1] == "sh" or BEGINS.match(line)))
        rest = FENCED.sub("", text)
        found.update(dict.fromkeys(match[1] for match in INLINE.finditer(rest)))
        found.update(
            dict.fromkeys(
                line for line in rest.replace("\\\n", " ").splitlines() if re.match(r" {4}(driftfit|python) ", line)
            )
        )
    parts = [part.strip() for line in found for part in line.split("&&")]
    return sorted({" ".join(part.split()) for part in parts if part and not part.startswith(("pip install", "pytest"))})


COMMANDS = commands()


def of_kind(kind: str) -> list[str]:
    known = [(command, _kind(command)) for command in COMMANDS]
    return [command for command, own in known if own == kind]


def _kind(command: str) -> str:
    if any(command.startswith(other) for other in ELSEWHERE):
        return "elsewhere"
    if command.startswith("driftfit") or command.startswith("python -m driftfit"):
        return "driftfit"
    return "benchmark" if "benchmarks" in command else "record"


def test_commands_are_found():
    kinds = {kind: of_kind(kind) for kind in ("elsewhere", "driftfit", "benchmark", "record")}
    assert "python benchmarks/alarms.py" in kinds["benchmark"]
    assert "driftfit trackers" in kinds["driftfit"]
    assert any("hammerstein-wiener:2,2,input=polynomial/3" in command for command in kinds["driftfit"])
    assert "driftfit track pump.csv --y flow --u pressure --report report.html" in kinds["driftfit"]
    assert all(len(found) >= 5 for found in kinds.values())
    assert sum(map(len, kinds.values())) == len(COMMANDS)


@pytest.mark.parametrize("command", of_kind("elsewhere"))
def test_another_test_runs_it(command):
    _, (name, content) = next(item for item in ELSEWHERE.items() if command.startswith(item[0]))
    assert content in (ROOT / name).read_text()


@pytest.mark.parametrize("command", of_kind("benchmark"))
def test_benchmarks_run_quickly(command, monkeypatch):
    script, *given = shlex.split(command.replace("-m benchmarks.", "benchmarks/"))[1:]
    script = script if script.endswith(".py") else f"{script}.py"
    content = (ROOT / script).read_text()
    assert "--quick" in content or "quick: Annotated" in content
    if "import statsmodels" in content:
        pytest.importorskip("statsmodels", reason="there is no statsmodels")
    if "import JulierSigmaPoints" in content:
        pytest.importorskip("filterpy", reason="there is no filterpy")
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    monkeypatch.setattr("sys.argv", [script, *given, "--quick"])
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.suppress(SystemExit):
        runpy.run_path(str(ROOT / script), run_name="__main__")
    assert printed.getvalue().strip()
    own = command.removeprefix("python ")
    if pages.name_of(own) in pages.SAMPLED:
        assert pages.differences(printed.getvalue(), pages.shown()[own], sample=True) == []


@pytest.mark.parametrize("command", of_kind("record"))
def test_scripts_on_real_records_load_and_are_called_as_they_say(command, monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "examples"))
    _, script, *given = shlex.split(command)
    found = runpy.run_path(str(ROOT / script), run_name="loaded")
    asked = re.search(rf"python {script}((?: \S+)*)", " ".join(found["__doc__"].split()))
    assert asked is not None
    required = found["main"].__code__.co_argcount - len(found["main"].__defaults__ or ())
    assert required <= len(given) <= found["main"].__code__.co_argcount


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Every file that the commands read, under the names that they have there."""
    folder = tmp_path_factory.mktemp("files")
    rng = np.random.default_rng(0)
    T = 120
    time = pl.datetime_range(pl.datetime(2025, 1, 1), pl.datetime(2025, 1, 5, 23), "1h", eager=True)
    u, v = rng.uniform(0.1, 1.0, (2, T))
    flow, level = np.zeros((2, T))
    for t in range(1, T):
        flow[t] = 0.6 * flow[t - 1] + u[t - 1] + 0.05 * rng.normal()
        level[t] = 0.8 * level[t - 1] + 0.5 * u[t - 1] + 0.05 * rng.normal()
    units = np.repeat(["A", "B"], T // 2)
    table = pl.DataFrame(
        {"time": time, "flow": flow, "level": level, "pressure": u, "valve": u, "pump": units, "tank": units,
         "left": flow, "right": 0.5 * flow + 0.05 * rng.normal(size=T), "u_left": u, "u_right": v}
    )  # fmt: skip
    (folder / "runs").mkdir()
    for name in ("pump", "pumps", "data", "tank", "tanks", "rig", "runs/first"):
        table.write_csv(folder / f"{name}.csv")
    shutil.copy(ROOT / "examples" / "own_tracker.py", folder)
    return folder


@pytest.mark.parametrize("command", of_kind("driftfit"))
def test_commands_run(command, files, monkeypatch):
    monkeypatch.chdir(files)
    monkeypatch.syspath_prepend(str(files))
    words = shlex.split(command)
    given = words[1:] if words[0] == "driftfit" else words[3:]
    result = CliRunner().invoke(app, given)
    assert result.exit_code == 0 or not given, result.output
    assert result.output.strip()
    for option in ("--plot", "--out", "--report"):
        if option in given:
            written = [path for path in files.glob(f"{given[given.index(option) + 1]}*") if path.is_file()]
            inside = [path for path in files.glob(f"{given[given.index(option) + 1]}/*") if path.is_file()]
            assert max(path.stat().st_size for path in written + inside) > 500
