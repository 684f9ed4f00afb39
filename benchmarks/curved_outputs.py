"""Fault codes in the output of Hammerstein-Wiener systems, of which a model with a curve at its output has functions.

Three codes, at three places each, in records of five kinds of curves and inputs: codes refused, other samples left out,
and the error of the prediction afterwards as a multiple of that with gaps in place of the codes.
Run: python benchmarks/curved_outputs.py [--quick, a row]
"""

import sys
import warnings

import numpy as np
from scipy.signal import lfilter

from driftfit import RLS, AdaptiveKalman, HammersteinWiener, Polynomial, track

T, MODEL = 500, HammersteinWiener(1, 1, input=Polynomial(2), output=Polynomial(3))
PLACES = ([300], [100, 250, 400], [200, 201, 202, 203])
CODES = (9999.0, -999.0, 500.0)
KINDS = ("cubic", "square", "exponential", "t3 input", "rare pulses")


def record(kind: str, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """y and u."""
    rng = np.random.default_rng(100 + seed)
    inputs = {
        "t3 input": lambda: rng.standard_t(3, T),
        "rare pulses": lambda: (rng.random(T) < 0.03) * rng.exponential(5.0, T),
    }
    u = inputs.get(kind, lambda: rng.normal(size=T))()
    w = lfilter([0.0, 1.0], [1.0, -0.7], u)
    curve = {"square": w + 0.1 * w**2, "exponential": np.exp(0.5 * w)}.get(kind, w + 0.05 * w**3)
    return curve + 0.05 * rng.normal(size=T), u


def main(trackers: tuple = (RLS(0.99), AdaptiveKalman()), kinds: tuple[str, ...] = KINDS) -> None:
    warnings.simplefilter("ignore")
    print(f"{'':29}  codes  refused  others left out   error: median    largest")
    for tracker in trackers:
        for kind in kinds:
            count, refused, others, errors = 0, 0, 0, []
            for seed in range(3):
                y, u = record(kind, seed)
                for code, at in ((code, at) for code in CODES for at in PLACES):
                    runs = []
                    for value in (code, np.nan):
                        given = y.copy()
                        given[at] = value
                        runs.append(track(MODEL, tracker, given, u, gate=True))
                    found = set(runs[0].left_out.sample.tolist())
                    count, refused, others = count + len(at), refused + len(found & {*at}), others + len(found - {*at})
                    wrong, least = (np.nanmean((run.prediction - y)[max(at) + 4 :] ** 2) for run in runs)
                    errors.append(np.sqrt(wrong / least))
            print(
                f"{type(tracker).__name__:16}{kind:13}{count:7}{refused:9}{others:17}{np.median(errors):16.2f}{max(errors):11.2f}",
                flush=True,
            )


if __name__ == "__main__":
    if "--quick" in sys.argv:
        main((RLS(0.99),), KINDS[:1])
    else:
        main()
