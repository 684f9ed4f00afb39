"""Segments of whole records: two jumps of a mean, with outliers, with correlated noise.

Prints how many of the jumps are found within 20 samples, how many breaks are false, and how often the interval contains
the true date. With a folder it also prints the counts of found and false breaks of ruptures, if it is installed, and
draws a figure.
Run: python examples/segmentation.py [records, 20 by default] [folder]
"""

import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from scipy import signal

from driftfit import segment

T, AT, NOISE = 400, (133, 266), 0.5


def record(seed: int, size: float, kind: str) -> np.ndarray:
    rng, t = np.random.default_rng(seed), np.arange(T)
    e = rng.normal(size=T)
    if kind == "outliers":
        e *= np.where(rng.random(T) < 0.05, 10.0, 1.0)
    if kind == "correlated":
        e = signal.lfilter([0.8], [1.0, -0.6], rng.normal(size=T + 200))[200:]
    return 5.0 + size * ((t >= AT[0]) & (t < AT[1])) + NOISE * e


def by_ruptures(y: np.ndarray) -> list[int]:
    from ruptures import Pelt

    fitted = Pelt("linear", min_size=10, jump=1).fit(np.column_stack([y, np.ones(T)]))
    return fitted.predict(pen=2.0 * NOISE**2 * np.log(T))[:-1]


def score(found: list[int]) -> tuple[int, int]:
    hits = sum(any(abs(f - at) <= 20 for f in found) for at in AT)
    return hits, len(found) - hits


def main(records: int = 20, folder: str | None = None) -> None:
    peer = find_spec("ruptures") is not None
    print(f"{records} records                 found   false   interval holds the date")
    for kind, size in (("white", 0.8), ("white", 0.5), ("outliers", 0.8), ("correlated", 0.8), ("white", 0.0)):
        total, inside, theirs = np.zeros(2, int), [], np.zeros(2, int)
        for seed in range(records):
            y = record(seed, size, kind)
            segmentation = segment(y)
            total += score([one.at for one in segmentation.breaks])
            if len(segmentation.breaks) == len(AT):
                inside += [one.first <= at <= one.last for one, at in zip(segmentation.breaks, AT, strict=True)]
            theirs += score(by_ruptures(y)) if peer and folder else (0, 0)
        name = f"{kind}, jumps of {size:g}" if size else "no jumps"
        held = f"{sum(inside)} of {len(inside)}" if size else ""
        found = f"{total[0]} of {2 * records}" if size else ""
        print(
            f"{name:<24} {found:>10} {total[1]:>7}   {held:>12}" + (f"   ruptures {theirs}" if peer and folder else "")
        )
    print(segment(record(0, 0.8, "white")))
    if folder:
        segment(record(0, 0.8, "white")).plot().savefig(Path(folder) / "segmentation.png", dpi=70)


if __name__ == "__main__":
    main(*(int(given) for given in sys.argv[1:2]), *sys.argv[2:3])
