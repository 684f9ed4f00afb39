"""The default tracker on 46 scenarios that it was not designed on, and what each of its pieces is worth there.

*ratio* is the error of theta over that of an oracle that is given the kind of drift and learns its size in hindsight
(`benchmarks.held_out.oracle`), *of LABEL* over that of stored results; *step* is the one-step error over the oracle's;
*moving*, *still* and *output* are shares within 95 % bands, and *ahead* that of forecasts up to 20 samples ahead, whose
*width* is their std over the half-width that holds 68 % of their errors; *wrong* is the share of |theta - truth| > 5
std in per cent. All are means over seeds, seconds are the least. On real records *rms* is the one-step error, and then
what others have over it, with the difference of their log scores in units of .001; *Kalman* is the best of eight fixed
ratios of drift to noise in hindsight.

``--without`` tells what leaving out a piece costs (`benchmarks.held_out.pieces`): *lines* that would go with it, its
error over that of the whole default (geometric mean, worst, number of scenarios above 1.05), coverage, width of
forecasts over that of the whole default (geometric mean), *wrong*, and the one-step errors on real records.

Run: python -m benchmarks.ablation [--seeds 5] [--only NAME ..] [--without PIECE ..|all] [--data PATH] [--quick]
         [--baseline PATH] [--store LABEL] [--against LABEL] [--tracker NAME] [--function LABEL=PATH:NAME]

``--baseline`` keeps the oracle's scores, and under ``--store`` those of this run. ``--tracker`` judges another tracker
instead of the default, *faults* being a `Bank` with a hypothesis for outliers; ``--function`` a function of regressors
(T, n) and y (T,) that returns theta, std, prediction and its variance.
"""

from __future__ import annotations

import argparse
import sys
from functools import partial
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.held_out import real
from benchmarks.held_out.judge import Kept, Method, Scores, means, of_function, of_tracker, scenarios
from benchmarks.held_out.pieces import PIECES, Without, run_without
from driftfit import AdaptiveKalman, Bank, Sensor
from driftfit.trackers.base import Tracker

HEADS = ("ratio", "step", "moving", "still", "output", "ahead", "width")
QUICK, QUICK_PIECE = ("common_walk",), "single ladders"
TRACKERS: dict[str, Tracker] = {
    "default": AdaptiveKalman(),
    "bank": Bank(),
    "faults": Bank(sensors=[Sensor.nominal(), Sensor.outlier(10.0, prob=0.02)]),
}
Rows = dict[str, Scores]


def function(text: str) -> tuple[str, Method]:
    """(label, method) of LABEL=PATH:NAME."""
    label, rest = text.split("=", 1)
    path, name = rest.rsplit(":", 1)
    spec = spec_from_file_location(Path(path).stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules[spec.name] = module_from_spec(spec)  # a cache of compiled functions looks for it there
    spec.loader.exec_module(module)
    return label, of_function(getattr(module, name))


def geometric(values: list[float]) -> float:
    """Geometric mean."""
    return float(np.exp(np.mean(np.log(values)))) if values else np.nan


def cells(name: str, row: Scores, before: Scores | None) -> str:
    """A line of the table."""
    shown = [f"{row[head]:.2f}" if np.isfinite(row[head]) else "-" for head in HEADS]
    shown.insert(1, f"{row['ratio'] / before['ratio']:.2f}" if before else "-")
    shown += [f"{100.0 * row['wrong']:.2f}", f"{row['seconds']:.2f}"]
    return f"{name:18}" + "".join(f"{cell:>10}" for cell in shown)


def summary(label: str, rows: Rows, before: Rows) -> list[str]:
    """Medians, extremes and counts over the scenarios."""
    lines = []
    for word, ratios in (
        ("the oracle", {name: row["ratio"] for name, row in rows.items()}),
        (label, {name: rows[name]["ratio"] / row["ratio"] for name, row in before.items()}),
    ):
        if ratios:
            values, worst = np.array(list(ratios.values())), max(ratios, key=lambda name: ratios[name])
            lines.append(
                f"error over that of {word}: median {np.median(values):.3f}, geometric mean "
                f"{geometric(list(values)):.3f}, worst {ratios[worst]:.2f} ({worst}), "
                f"above 1.15 in {np.sum(values > 1.15)}, above 1.4 in {np.sum(values > 1.4)} of {len(values)}"
            )
    for head in ("moving", "still", "output", "ahead"):
        shares = {name: row[head] for name, row in rows.items() if np.isfinite(row[head])}
        if shares:
            least = min(shares, key=lambda name: shares[name])
            lines.append(f"{head}: median {np.median(list(shares.values())):.3f}, least {shares[least]:.3f} ({least})")
    for word, widths in (
        ("that of most errors", {name: row["width"] for name, row in rows.items()}),
        (f"that of {label}", {name: rows[name]["width"] / row.get("width", np.nan) for name, row in before.items()}),
    ):
        if known := {name: width for name, width in widths.items() if np.isfinite(width)}:
            widest = max(known, key=lambda name: known[name])
            lines.append(
                f"width of forecasts over {word}: median {np.median(list(known.values())):.2f}, "
                f"most {known[widest]:.2f} ({widest})"
            )
    wrong = {name: 100.0 * row["wrong"] for name, row in rows.items()}
    most = max(wrong, key=lambda name: wrong[name])
    lines.append(f"certain and wrong: mean {np.mean(list(wrong.values())):.3f} %, most {wrong[most]:.2f} % ({most})")
    return lines


class Bench:
    """The scenarios, seeds and real records of a run, and where its scores are kept."""

    def __init__(self, given: argparse.Namespace, kept: Kept) -> None:
        self.kept, self.against = kept, given.against
        self.names = given.only or (QUICK if given.quick else tuple(scenarios()))
        self.seeds = range(1 if given.quick else given.seeds)
        self.series = real.read(given.data) if given.data else {}

    def forget(self, label: str) -> None:
        """Compute what has this label anew."""
        self.kept.forget(label, [*(f"{name}/" for name in self.names), *(f"record {name}" for name in self.series)])

    def scores(self, label: str, method: Method | None, tracker: Tracker | None) -> tuple[Rows, Rows]:
        """Scores by scenario and by real record; computed if there is a method and a tracker."""
        rows, records = {}, {}
        for name in self.names:
            if (row := means(self.kept, name, self.seeds, label, method)) is not None:
                rows[name] = row
        for name, series in self.series.items():
            compute = partial(real.scored, series, tracker) if tracker else None
            if (row := self.kept.real(name, label, compute)) is not None:
                records[name] = row
        return rows, records

    def compare(self, label: str, method: Method, tracker: Tracker | None) -> None:
        """Print the tables of a method beside stored results."""
        before, records_before = self.scores(self.against, None, None) if label != self.against else ({}, {})
        rows: Rows = {}
        heads = ("ratio", f"of {self.against}", *HEADS[1:], "wrong %", "seconds")
        print(f"{'':18}" + "".join(f"{head:>10}" for head in heads))
        for name in self.names:
            row = means(self.kept, name, self.seeds, label, method)
            assert row is not None
            rows[name] = row
            print(cells(name, row, before.get(name)), flush=True)
            self.kept.write()
        print(*summary(self.against, rows, before), sep="\n")
        if self.series and tracker is not None:
            self.compare_records(label, tracker, records_before)

    def compare_records(self, label: str, tracker: Tracker, before: Rows) -> None:
        """Print one-step errors and log scores on real records."""
        others = [self.against, *real.METHODS]
        print(f"\n{'':28}{'samples':>8}{'rms':>10}" + "".join(f"{f'{o} rms':>13}{'log':>7}" for o in others))
        for name, series in self.series.items():
            row = self.kept.real(name, label, partial(real.scored, series, tracker))
            assert row is not None
            line = f"{name:28}{row['samples']:8.0f}{row['rms']:10.4g}"
            rivals = [self.kept.real(name, other, partial(run, series)) for other, run in real.METHODS.items()]
            rivals.insert(0, before.get(name))
            for rival in rivals:
                shown = ("-", "-")
                if rival is not None:
                    shown = (f"{rival['rms'] / row['rms']:.3f}", f"{1e3 * (rival['log'] - row['log']):+.0f}")
                line += f"{shown[0]:>13}{shown[1]:>7}"
            print(line, flush=True)
            self.kept.write()

    def without(self, pieces: list[str], arguments: list[str]) -> None:
        """Print what leaving out each piece costs."""
        whole, whole_records = self.scores("now", of_tracker(AdaptiveKalman()), AdaptiveKalman())
        self.kept.write()
        heads = ("lines", "mean", "worst", "> 1.05", "moving", "output", "width", "wrong %", "most %", "rms", "worst")
        print(f"{'':26}" + "".join(f"{head:>9}" for head in heads))
        print(self.cost("(nothing)", whole, whole_records, whole, whole_records))
        for piece in pieces:
            label = f"without {piece}"
            if PIECES[piece].edits:
                self.kept.write()
                run_without(PIECES[piece], [*arguments, "--store", label])
                self.kept.read()
                rows, records = self.scores(label, None, None)
            else:
                one = Without(piece=piece)
                rows, records = self.scores(label, of_tracker(one), one)
            print(self.cost(piece, rows, records, whole, whole_records), flush=True)
            self.forget(label)

    def cost(self, piece: str, rows: Rows, records: Rows, whole: Rows, whole_records: Rows) -> str:
        """A line of the table of pieces."""
        ratios = {name: rows[name]["error"] / whole[name]["error"] for name in rows}
        worst = max(ratios, key=lambda name: ratios[name])
        steps = {name: row["rms"] / whole_records[name]["rms"] for name, row in records.items()}
        worst_step = max(steps, key=lambda name: steps[name], default="")
        medians = [np.nanmedian([row[head] for row in rows.values()]) for head in ("moving", "output")]
        widths = [row["width"] / whole[name]["width"] for name, row in rows.items() if np.isfinite(row["width"])]
        wrong = [100.0 * row["wrong"] for row in rows.values()]
        shown = [
            str(PIECES[piece].lines()) if piece in PIECES else "", f"{geometric(list(ratios.values())):.3f}",
            f"{ratios[worst]:.2f}", str(sum(ratio > 1.05 for ratio in ratios.values())),
            *(f"{median:.3f}" for median in medians), f"{geometric(widths):.3f}",
            f"{np.mean(wrong):.3f}", f"{max(wrong):.2f}",
            f"{geometric(list(steps.values())):.3f}" if steps else "-", f"{steps[worst_step]:.3f}" if steps else "-",
        ]  # fmt: skip
        return f"{piece:26}" + "".join(f"{cell:>9}" for cell in shown) + f"  {worst}, {worst_step}".rstrip(", ")


def parsed() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--only", nargs="*", choices=scenarios(), metavar="NAME")
    parser.add_argument("--without", nargs="*", choices=[*PIECES, "all"], metavar="PIECE")
    parser.add_argument("--data", type=Path, help="folder of the real records")
    parser.add_argument("--baseline", type=Path)
    parser.add_argument("--store", metavar="LABEL")
    parser.add_argument("--against", metavar="LABEL", default="today")
    parser.add_argument("--tracker", choices=TRACKERS, default="default")
    parser.add_argument("--function", metavar="LABEL=PATH:NAME", type=function)
    parser.add_argument("--quick", action="store_true", help="one seed of three scenarios, and one piece")
    return parser.parse_args()


def main() -> None:
    given = parsed()
    with TemporaryDirectory() as folder:
        path = given.baseline or Path(folder) / "scores.json"
        kept = Kept(path)
        bench = Bench(given, kept)
        tracker = None if given.function else TRACKERS[given.tracker]
        label, method = given.function or ("now", of_tracker(TRACKERS[given.tracker]))
        label = given.store or label
        bench.forget(label)
        if given.without is None:
            bench.compare(label, method, tracker)
        else:
            pieces = [QUICK_PIECE] if given.quick else list(PIECES) if "all" in given.without else given.without
            arguments = ["--seeds", str(len(bench.seeds)), "--only", *bench.names, "--baseline", str(path)]
            bench.without(pieces, arguments + (["--data", str(given.data)] if given.data else []))
        if given.store is None:
            bench.forget(label)
        kept.write()


if __name__ == "__main__":
    main()
