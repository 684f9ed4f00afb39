"""The report: one page that needs nothing else, reports what the verbs find, and escapes what users name."""

import re
from html.parser import HTMLParser

import numpy as np
import polars as pl
import pytest
from support import arx_record, damaged, rows_of
from typer.testing import CliRunner

from driftfit import ARX, AdaptiveKalman, AugmentedFLS, Kalman, Regression, track
from driftfit.cli import app
from driftfit.run.live.rule import KINDS
from driftfit.show.page import IMAGE_SAMPLES, svg
from driftfit.show.report import page

K = Kalman(q=1e-3, r=0.01)
OPEN = {"meta", "br", "img", "link", "hr"}


class Balance(HTMLParser):
    """Fails where elements are not closed in order."""

    def __init__(self):
        super().__init__()
        self.stack, self.text, self.tags = [], [], []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        if tag not in OPEN:
            self.stack.append(tag)

    def handle_endtag(self, tag):
        assert self.stack.pop() == tag

    def handle_data(self, data):
        self.text.append(data)


def read(text):
    parser = Balance()
    parser.feed(text)
    assert not parser.stack
    return parser


@pytest.fixture(scope="module")
def run():
    y, u = damaged(*arx_record(400, 3))
    return track(ARX(2, 2), K, y, u)


def test_page_is_whole_and_loads_nothing(run, tmp_path):
    path = tmp_path / "page.html"
    run.report(path, title="Pump <7> & valve")
    text = path.read_text()
    parsed = read(text)
    assert "Pump &lt;7&gt; &amp; valve" in text
    assert parsed.tags.count("svg") == 3
    assert not {"script", "link", "iframe"} & set(parsed.tags)
    loaded = re.findall(r'(?:src|href)="([^"#][^"]*)"', text)
    assert all(target.startswith("data:") for target in loaded)
    assert "url(http" not in text
    assert "prefers-color-scheme: dark" in text
    assert "@media print" in text


def test_page_says_what_the_judges_say(run):
    text = " ".join(" ".join(read(page(run)).text).split())
    result, health = run.verdict(), run.diagnose()
    for sentence in (*result.sentences, *health.sentences):
        assert " ".join(sentence.split()) in text
    assert text.index(result.sentences[0]) < text.index("Parameters over time")
    for name in run.names:
        assert name in text
    assert f"{result.rms:.5g}" in text
    assert f"{len(run) - int(run.ok.sum())} skipped" in text
    assert "largest pole" in text


def test_page_says_which_readings_the_tracker_left_out():
    y, u = arx_record(300, 1)
    y[[120, 180, 240]] = 9999.0
    run = track(ARX(1, 1), AdaptiveKalman(), y, u)
    assert "<dt>Left out</dt><dd>3 samples far outside the range of the others" in page(run)


def test_pictures_take_the_colours_of_the_page(run):
    drawn = svg(run.diagnose().plot())
    assert "var(--ink)" in drawn
    assert "var(--blue)" in drawn
    assert "#1f5fa8" not in drawn
    assert "<image" not in drawn
    assert drawn == svg(run.diagnose().plot())


def test_long_records_stay_small():
    T = 4 * IMAGE_SAMPLES
    y, u = arx_record(T, 1)
    text = page(track(ARX(2, 2), K, y, u))
    assert "<image" in text
    assert len(text) < 1_500_000


def test_other_models_and_trackers(tmp_path):
    y, u = arx_record(300, 2)
    for model, tracker in ((Regression(1), K), (ARX(2, 2), AugmentedFLS(mu=10.0))):
        run = track(model, tracker, y, u)
        shown = " ".join(read(page(run)).text)
        assert all(name in shown for name in run.names)
        assert ("largest pole" in shown) == isinstance(model, ARX)
        assert f"{run.verdict().rms:.5g}" in shown
    read(page(track(ARX(2, 2), K, y[:30], u[:30])))


def test_names_from_a_table_are_escaped():
    y, u = arx_record(200, 4)
    data = pl.DataFrame({"a<b": y, "u&v": u})
    text = page(track(ARX(2, 2), K, "a<b", "u&v", data=data))
    read(text)
    assert "a<b" not in text


def test_command_line_writes_a_page(tmp_path):
    y, u = arx_record(300, 2)
    pl.DataFrame({"y": y, "u": u, "unit": np.repeat(["a", "b"], 150)}).write_csv(tmp_path / "r.csv")
    options = "--y y --u u --model arx:2,2 --tracker kalman -p q=1e-3 -p r=0.01"
    base = ["track", str(tmp_path / "r.csv"), *options.split()]
    done = CliRunner().invoke(app, [*base, "--report", str(tmp_path / "r.html")])
    assert done.exit_code == 0, done.output
    expected = track(ARX(2, 2), K, "y", "u", data=str(tmp_path / "r.csv"))
    shown = " ".join(" ".join(read((tmp_path / "r.html").read_text()).text).split())
    for sentence in (*expected.verdict().sentences, *expected.diagnose().sentences):
        assert " ".join(sentence.split()) in shown
    fleet = CliRunner().invoke(app, [*base, "--by", "unit", "--report", str(tmp_path / "f.html")])
    assert fleet.exit_code == 0, fleet.output
    both = track(ARX(2, 2), K, "y", "u", data=str(tmp_path / "r.csv"), by="unit")
    shown = " ".join(" ".join(read((tmp_path / "f.html").read_text()).text).split())
    for sentence in both.verdict().sentences:
        assert " ".join(sentence.split()) in shown


def test_page_shows_faults_and_alarms(run):
    labels = np.zeros(400, bool)
    labels[250:300], labels[390:395] = True, True
    alarms = run.detect(reference=200, every=500)
    text = page(run, None, alarms, labels)
    read(text)
    plain = " ".join(" ".join(read(text).text).split())
    score = alarms.score(labels)
    assert f"{score.found} of 2 labelled intervals found, {score.false} false alarms" in plain
    assert plain.index("Faults and alarms") < plain.index("Parameters over time")
    for t in (250, 299, 390, 394, *alarms.onsets):
        assert run.time_text(int(t)) in plain
    assert read(text).tags.count("svg") == 4
    assert "Faults and alarms" not in page(run)
    with pytest.raises(ValueError, match="labels have shape"):
        page(run, None, None, labels[1:])


@pytest.fixture(scope="module")
def fleet():
    """Two series whose gain jumps from 1 to 1.25; later the noise doubles."""
    u, v = np.random.default_rng(2).normal(size=(2, 2, 800))
    gain, noise = np.where(np.arange(800) < 500, 1.0, 1.25), np.where(np.arange(800) < 700, 0.5, 1.0)
    return track(Regression(["valve"]), Kalman(q=1e-3, r=0.25), gain * u + noise * v, u, by="row")


@pytest.mark.parametrize("kind", KINDS)
def test_alarms_of_every_kind_are_the_same_in_print_in_their_table_and_on_the_page(fleet, kind, tmp_path):
    alarms = fleet[0].detect(kind, every=200.0, reference=400)
    table = alarms.table
    assert len(table) == len(alarms.onsets) > 0
    assert (table["statistic"] > table["limit"]).all()
    assert "valve" in table["cause"]
    assert ("since" in table.columns) == (kind == "glr")
    fleet[0].report(tmp_path / "page.html", alarms=alarms)
    shown = " ".join(" ".join(read((tmp_path / "page.html").read_text()).text).split())
    for t, first, statistic in zip(alarms.onsets.tolist(), table["from"], table["statistic"], strict=True):
        row = alarms.cells(t)
        assert (row[0], row[3]) == (first, f"{statistic:.4g}")
        assert " ".join(" ".join(row).split()) in shown
        assert " ".join(row).split() in rows_of(alarms)
    many = fleet.detect(kind, every=200.0, reference=400)
    assert many[0].table.equals(many.table.filter(many.table["series"] == 0).select(many[0].table.columns))
    fleet.report(tmp_path / "fleet.html", alarms=many)
    for row in many.rows:
        assert row.first in " ".join(read((tmp_path / "fleet.html").read_text()).text)
