"""Which alarm detects what: "glr" any change of the system, "band" what leaves a permitted range.

    y_t = gain u_t + offset + N(0, 1),     u_t ~ N(0, 1), gain and offset constant until sample 1500 of 2000

The first 1000 samples are the reference, and one false alarm may begin in 5000. The gain may lie between 0.5 and 1.5.
Prints the share of 10 records in which an alarm begins within 500 samples of the change, with the median delay, and the
number of false alarms in the 10 records without one, where 2 are expected. Run: python examples/alarm_kinds.py
"""

import numpy as np

from driftfit import AdaptiveKalman, Kalman, Regression, Tracker, track
from driftfit.judge.alarms.detect import Alarms

T, KNOWN, START, RECORDS, EVERY = 2000, 1000, 1500, 10, 5000.0
MODEL = Regression(["gain"], intercept=True)
FAULTS = ("gain jumps by 1", "gain wears by 1", "gain wears by .3", "offset grows by 1", "noise x 1.5", "none")
PERMITTED = {"gain": (0.5, 1.5)}
WATCHED = (
    ("any tracker, glr", AdaptiveKalman(), "glr", KNOWN),
    ("AdaptiveKalman, band .5 to 1.5", AdaptiveKalman(), "band", PERMITTED),
    ("Kalman(q=1e-4), band .5 to 1.5", Kalman(q=1e-4, r=1.0), "band", PERMITTED),
)


def record(seed: int, fault: str) -> tuple[np.ndarray, np.ndarray]:
    u, v = np.random.default_rng(seed).normal(size=(2, T))
    jump, ramp = np.arange(T) >= START, np.clip((np.arange(T) - START) / (T - START), 0.0, 1.0)
    gain = 1.0 + (jump if "jumps" in fault else 0.3 * ramp if ".3" in fault else ramp if "wears" in fault else 0.0)
    offset = ramp if "offset" in fault else 0.0
    return gain * u + offset + (1.0 + 0.5 * jump if "noise" in fault else 1.0) * v, u


def watched(seed: int, tracker: Tracker, kind: str, reference: object) -> dict[str, Alarms]:
    """The rule of the reference, applied to each of the records that begin with it."""
    rule = None
    detected = {}
    for fault in FAULTS:
        y, u = record(seed, fault)
        rule = rule or track(MODEL, tracker, y[:KNOWN], u[:KNOWN]).detect(kind, every=EVERY, reference=reference).rule
        detected[fault] = track(MODEL, tracker, y, u).detect(rule, start=KNOWN)
    return detected


def main() -> None:
    print(f"{'':<32}" + "".join(f"{fault:>19}" for fault in FAULTS))
    for name, tracker, kind, reference in WATCHED:
        found = [watched(seed, tracker, kind, reference) for seed in range(RECORDS)]
        cells = []
        for fault in FAULTS[:-1]:
            labels = np.arange(T) >= START
            delays = np.array([detected[fault].score(labels).delay for detected in found])
            seen = np.isfinite(delays)
            after = f", {np.median(delays[seen]):.0f}" if seen.any() else ""
            cells.append(f"{100.0 * seen.mean():.0f} %{after}")
        cells.append(f"{sum(len(said['none'].onsets) for said in found)} false")
        print(f"{name:<32}" + "".join(f"{cell:>19}" for cell in cells))


if __name__ == "__main__":
    main()
