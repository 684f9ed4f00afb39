"""The default tracker on 46 scenarios that it was not designed on, beside an oracle and earlier results.

*ratio* is the error of theta over that of an oracle that is given the kind of drift and learns its size in hindsight
(`benchmarks.held_out.oracle`), *of LABEL* over that of stored results; *step* is the one-step error over the oracle's;
*moving*, *still* and *output* are shares within 95 % bands; *wrong* is the share of |theta - truth| > 5 std in per
cent. All are means over seeds, seconds are the least.

Run: python -m benchmarks.ablation [--seeds 5] [--only NAME ..] [--baseline PATH] [--store LABEL] [--against LABEL]
         [--function LABEL=PATH:NAME] [--quick]

``--baseline`` keeps the oracle's scores, and under ``--store`` those of this run. ``--function`` judges a function of
regressors (T, n) and y (T,) that returns theta, std, prediction and its variance, instead of the default.
"""

from __future__ import annotations

import argparse
import sys
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

import numpy as np

from benchmarks.held_out.judge import Kept, Method, Scores, default, means, of_function, scenarios

HEADS = ("ratio", "step", "moving", "still", "output")


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


def cells(name: str, row: Scores, before: Scores | None) -> str:
    """A line of the table."""
    shown = [f"{row[head]:.2f}" if np.isfinite(row[head]) else "-" for head in HEADS]
    shown.insert(1, f"{row['ratio'] / before['ratio']:.2f}" if before else "-")
    shown += [f"{100.0 * row['wrong']:.2f}", f"{row['seconds']:.2f}"]
    return f"{name:18}" + "".join(f"{cell:>10}" for cell in shown)


def summary(label: str, rows: dict[str, Scores], before: dict[str, Scores]) -> list[str]:
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
                f"{np.exp(np.mean(np.log(values))):.3f}, worst {ratios[worst]:.2f} ({worst}), "
                f"above 1.15 in {np.sum(values > 1.15)}, above 1.4 in {np.sum(values > 1.4)} of {len(values)}"
            )
    for head in ("moving", "still", "output"):
        shares = {name: row[head] for name, row in rows.items() if np.isfinite(row[head])}
        if shares:
            least = min(shares, key=lambda name: shares[name])
            lines.append(f"{head}: median {np.median(list(shares.values())):.3f}, least {shares[least]:.3f} ({least})")
    wrong = {name: 100.0 * row["wrong"] for name, row in rows.items()}
    most = max(wrong, key=lambda name: wrong[name])
    lines.append(f"certain and wrong: mean {np.mean(list(wrong.values())):.3f} %, most {wrong[most]:.2f} % ({most})")
    return lines


QUICK = ("single_walk", "rare_pulses", "idle_start")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--only", nargs="*", choices=scenarios(), metavar="NAME")
    parser.add_argument("--baseline", type=Path)
    parser.add_argument("--store", metavar="LABEL")
    parser.add_argument("--against", metavar="LABEL", default="today")
    parser.add_argument("--function", metavar="LABEL=PATH:NAME", type=function)
    parser.add_argument("--quick", action="store_true", help="one seed of three scenarios")
    given = parser.parse_args()
    names = given.only or (QUICK if given.quick else tuple(scenarios()))
    seeds = range(1 if given.quick else given.seeds)
    kept = Kept(given.baseline)
    label, method = given.function or ("now", default())
    label = given.store or label
    kept.forget(label)
    rows, before = {}, {}
    heads = ("ratio", f"of {given.against}", *HEADS[1:], "wrong %", "seconds")
    print(f"{'':18}" + "".join(f"{head:>10}" for head in heads))
    for name in names:
        earlier = means(kept, name, seeds, given.against) if label != given.against else None
        row = means(kept, name, seeds, label, method)
        assert row is not None
        rows[name] = row
        if earlier is not None:
            before[name] = earlier
        print(cells(name, row, earlier), flush=True)
        kept.write()
    print(*summary(given.against, rows, before), sep="\n")
    if given.store is None:
        kept.forget(label)
        kept.write()


if __name__ == "__main__":
    main()
