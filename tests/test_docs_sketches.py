"""The indented lines of code in the pages, which show how a call looks, run too, after what a page presupposes."""

import re
from pathlib import Path

import matplotlib
import numpy as np
import polars as pl
import pytest
from support import arx_record

DOCS = Path(__file__).parent.parent / "docs"
INDENTED = re.compile(r"(?:^ {4}.*\n|^\n+(?= {4}))+", re.M)

COMMON = """
from datetime import timedelta
from driftfit import *
model, tracker = ARX(2, 2), Kalman(q=1e-4, r=0.01)
run = track(model, tracker, y, u)
"""

GIVEN = {
    "alarms.md": """
        t, labels = 700, np.arange(len(y)) > 600
        fleet = track(model, tracker, y="flow", u="pressure", data=table, by="pump")
        """,
    "many_meters.md": "",
    "real_sensors.md": "",
    "segmentation.md": """
        y = y + 9.0 * (np.arange(len(y)) >= 500)
        run = track(ARX(1, 1, intercept=True), tracker, y, u)
        """,
    "tables_and_fleets.md": """
        qs, fast, slow = (1e-3, 1e-4), RLS(0.9), RLS(0.99)
        Y, U = np.stack([y, 2 * y]), np.stack([u, u])
        """,
    "tracking.md": "flow, pressure, y_t, u_t = y, u, y[0], u[0]",
    "tuning.md": "model, u = Regression(2), np.column_stack([u, np.roll(u, 1)])",
    "verdict.md": "",
}
"""By page, what its sketches take for granted besides `COMMON`."""

NO_CODE = {
    "choosing_a_tracker.md", "coloured_noise.md", "flexible_least_squares.md", "identify.md",
    "instrumental_variables.md", "spark.md", "structure.md",
}  # fmt: skip
"""Pages whose indented lines are lists or formulas, or need Java or a file of their own."""


def blocks(page):
    """The indented blocks of a page that are code."""
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.S)
    found = [re.sub("^    ", "", block[0].strip("\n"), flags=re.M) for block in INDENTED.finditer(text)]
    return [block for block in found if not block.startswith(("y_t =", "options:"))]


PAGES = [page for page in sorted(DOCS.rglob("*.md")) if page.parent.name != "api" and blocks(page)]


@pytest.fixture
def namespace(tmp_path, monkeypatch):
    """A record, a table of two pumps, files of meters: what the pages speak of."""
    monkeypatch.chdir(tmp_path)
    matplotlib.use("Agg")
    y, u = arx_record(1200, 1)
    n = 600
    hours = np.datetime64("2024-01-01", "ms") + np.arange(n) * np.timedelta64(1, "h")
    tables = [
        pl.DataFrame({"pump": name, "time": hours, "flow": y[a : a + n], "pressure": u[a : a + n]})
        for name, a in (("pump 7", 0), ("pump 8", n))
    ]
    Path("meters").mkdir()
    for k, table in enumerate(tables):
        meters = table.select(pl.col("pump").alias("meter"), pl.int_range(n).alias("t"), "flow", "pressure")
        meters.write_parquet(f"meters/{k}.parquet")
    given = {"y": y, "u": u, "np": np, "pl": pl, "table": pl.concat(tables)}
    exec(COMMON, given)
    return given


def dedented(text):
    return "\n".join(line.strip() for line in text.strip().splitlines())


@pytest.mark.filterwarnings("ignore::driftfit.DataWarning")
@pytest.mark.parametrize("page", [page for page in PAGES if page.name in GIVEN], ids=lambda page: page.stem)
def test_sketches_run(page, namespace):
    exec(dedented(GIVEN[page.name]), namespace)
    for block in blocks(page):
        exec("\n".join(line for line in block.splitlines() if not line.startswith("driftfit ")), namespace)


def test_the_tracker_of_the_page_is_the_example():
    page = DOCS / "own_tracker.md"
    example = (DOCS.parent / "examples" / "own_tracker.py").read_text()
    shown, test = blocks(page)
    for part in re.split(r"\n\n\n?", shown):
        assert part in example, part
    assert test == "def test_my_tracker():\n    assert check_tracker(SignLMS(gain=0.02)) == []"


def test_every_page_is_known():
    assert {page.name for page in PAGES} == {*GIVEN, *NO_CODE, "own_tracker.md"}
