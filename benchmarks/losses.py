"""Why rows of the accuracy scoreboard beat AdaptiveKalman: its error with a part taken out, over its error.

"one ratio" puts the ratio of the scenario on every rung of the common ladder and takes the ladders of single parameters
away (without drift: closes the ways up), so that nothing has to be learned about it; "one noise level" leaves the
outliers only; "groups" tells it which parameter is fast. Medians over the twenty scored runs. Run:
python -m benchmarks.losses
"""

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from driftfit import AdaptiveKalman
from driftfit.trackers.parts.modes import ladder, noise_levels
from lab.bench.contestants import run
from lab.bench.records import simulated
from lab.bench.scores import parameter_error

LEARNED = {"missing_data": ("regression",), "collinear_inputs": ("regression",), "lost_excitation": ("arx",)}
RATIO = 1e-3
ONE_RATIO = {"LADDER": (RATIO,) * len(ladder.LADDER), "LEARNED": (RATIO,) * len(ladder.LEARNED), "MOST_ALONE": 0}
ALL_AT_REST = {"CLIMB": 0.0, "JUMP": 0.0, "ACROSS": 0.0}
ONE_LEVEL = (*np.ones(len(noise_levels.LEVELS) - 1), noise_levels.LEVELS[-1])


@contextmanager
def told(module: object, **values: object) -> Iterator[None]:
    """Other numbers in a module, for a while."""
    before = {name: getattr(module, name) for name in values}
    for name, value in values.items():
        setattr(module, name, value)
    try:
        yield
    finally:
        for name, value in before.items():
            setattr(module, name, value)


def errors(tracker: AdaptiveKalman, name: str, kind: str) -> np.ndarray:
    """Parameter error of every scored run."""
    return np.array([parameter_error(r, run(tracker, r)) for r in (simulated(name, kind, s, 1000) for s in range(20))])


def main() -> None:
    plain = AdaptiveKalman()
    for name, kinds in {"no_drift": ("regression", "arx"), **LEARNED}.items():
        for kind in kinds:
            other = ALL_AT_REST if name == "no_drift" else ONE_RATIO
            base = errors(plain, name, kind)
            with told(ladder, **other):
                one = np.median(errors(plain, name, kind) / base)
                with told(noise_levels, LEVELS=ONE_LEVEL):
                    both = np.median(errors(plain, name, kind) / base)
            print(f"{name}, {kind}: one ratio {one:.3f}, and one noise level {both:.3f}")
    for kind in ("regression", "arx"):
        grouped = errors(AdaptiveKalman(groups=[[0]]), "mixed_rates", kind)
        print(f"mixed_rates, {kind}: groups {np.median(grouped / errors(plain, 'mixed_rates', kind)):.3f}")


if __name__ == "__main__":
    main()
