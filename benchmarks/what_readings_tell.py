"""What a record cannot tell: constants read by a coarse sensor, and a change while the input rests.

The first table counts, among records of 1000 samples with y = 3700.3 - 2.03 u + noise rounded to whole numbers and an
input that is held at one of four levels, how often the verdict reports a change and how often `segment` divides the
record: without a change, and with a step of the intercept by half a step of the sensor in the middle.

In the second the input is white, with a standard deviation of 5, except that it rests at 20 from sample 300 to 450 of
600. At ``since`` the intercept moves by 1.3, thirteen deviations of the noise, until the end of the rest or of the
record: which parameters the verdict names, and how often the 95 % bands of AdaptiveKalman contain both parameters, of
the filter at the end of the rest, and of the smoother within it. Other parameters follow a bar if their steps explain
the record as well.

Run: python benchmarks/what_readings_tell.py [records, 40 by default] [--quick, with 1]
"""

import sys
from collections import Counter

import numpy as np

from driftfit import RLS, AdaptiveKalman, Regression, Track, track

MODEL = Regression(["u"], intercept=True)


def coarse(seed: int, noise: float, held: int, moved: float) -> Track:
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.choice([0.0, 5.0, 20.0, -10.0], 1000 // held), held)
    y = 3700.3 - 2.03 * u + moved * (np.arange(1000) >= 500) + noise * rng.normal(size=1000)
    return track(MODEL, RLS(1.0), np.round(y), u)


def resting(seed: int, since: int, back: bool) -> Track:
    rng = np.random.default_rng(seed)
    u = 5.0 * rng.normal(size=600)
    u[300:450] = 20.0
    t = np.arange(600)
    y = 3.7 + 2.0 * u + 1.3 * ((t >= since) & (t < (450 if back else 600))) + 0.1 * rng.normal(size=600)
    return track(MODEL, AdaptiveKalman(), y, u)


def main(records: int = 40, quick: bool = False) -> None:
    print(" noise  held   constants: changes  divided   half a step: changes  divided   (% of records)")
    for noise in (0.2, 0.3, 0.4, 0.6):
        for held in (10, 200) if quick else (1, 10, 40, 200):
            found = np.zeros((2, 2))
            for seed in range(records):
                for k, moved in enumerate((0.0, 0.5)):
                    run = coarse(seed, noise, held, moved)
                    found[k] += [bool(run.verdict().drifts), len(run.segment().breaks) > 0]
            found *= 100.0 / records
            print(
                f"{noise:>6} {held:>5} {found[0, 0]:>20.0f} {found[0, 1]:>8.0f}"
                f" {found[1, 0]:>22.0f} {found[1, 1]:>8.0f}",
                flush=True,
            )
    print("\n since  ends  filter  smoother  named")
    truth = np.array([2.0, 5.0])
    for since, back in ((350, True), (350, False), (300, True), (300, False)):
        inside, names = np.zeros(2), Counter()
        for seed in range(records):
            run = resting(seed, since, back)
            smoothed = run.smooth()
            inside += [
                (np.abs(one.theta[t] - truth) < 1.96 * one.std[t]).all() for one, t in ((run, 449), (smoothed, 400))
            ]
            named = ("|".join([m.name, *m.instead]) for m in run.verdict().parameters if m.moves)
            names[", ".join(named)] += 1
        shown = "; ".join(f"{name} {count}" for name, count in names.most_common())
        filtered, smooth = inside / records
        print(f"{since:>6} {450 if back else 600:>5} {filtered:>7.2f} {smooth:>9.2f}  {shown}", flush=True)


if __name__ == "__main__":
    quick = "--quick" in sys.argv
    numbers = [int(one) for one in sys.argv[1:] if one.isdigit()]
    main(numbers[0] if numbers else 1 if quick else 40, quick)
