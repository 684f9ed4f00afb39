"""Why rows of the accuracy scoreboard beat AdaptiveKalman: its error with a part taken out, over its error.

"one ratio" gives all filters the drift ratio of the scenario (in a scenario without drift, the only filter is the one
without drift), so that nothing has to be learned about it; "one noise level" leaves the outliers only; with "groups" it
knows which parameter is fast. Medians over the twenty scored runs. Run: python -m benchmarks.losses
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from driftfit import AdaptiveKalman
from lab.bench.contestants import run
from lab.bench.records import simulated
from lab.bench.scores import parameter_error

LEARNED = {"missing_data": ("regression",), "collinear_inputs": ("regression",), "lost_excitation": ("arx",)}
RATIO = 1e-3


@dataclass(frozen=True)
class Part(AdaptiveKalman):
    """The tracker without some of its transitions, ratios or noise levels."""

    at_rest: bool = False
    one_ratio: bool = False
    one_level: bool = False

    def state(self, n: int) -> Mapping[str, Any]:
        state = dict(super().state(n))
        if self.at_rest:
            alone = np.arange(len(state["arrive"])) == 0
            state["moves"] = state["moves"] * [[0.0], [1.0], [1.0]]
            state["arrive"] = np.where(alone, state["arrive"], 0.0)
            state["arrivals"] = state["arrive"].sum()
        if self.one_ratio:
            state["ratio"], state["learned"] = np.full_like(state["ratio"], RATIO), np.zeros_like(state["learned"])
        if self.one_level:
            state["level"] = np.where(state["level"] < state["level"][-1], 1.0, state["level"])
            state["log_level"] = np.log(state["level"])
        return state


def errors(tracker: AdaptiveKalman, name: str, kind: str) -> np.ndarray:
    """Parameter error of every scored run."""
    return np.array([parameter_error(r, run(tracker, r)) for r in (simulated(name, kind, s, 1000) for s in range(20))])


def main() -> None:
    plain = AdaptiveKalman()
    for name, kinds in {"no_drift": ("regression", "arx"), **LEARNED}.items():
        for kind in kinds:
            base, rest = errors(plain, name, kind), name == "no_drift"
            one, both = (
                np.median(errors(Part(at_rest=rest, one_ratio=not rest, one_level=level), name, kind) / base)
                for level in (False, True)
            )
            print(f"{name}, {kind}: one ratio {one:.3f}, and one noise level {both:.3f}")
    for kind in ("regression", "arx"):
        grouped = errors(AdaptiveKalman(groups=[[0]]), "mixed_rates", kind)
        print(f"mixed_rates, {kind}: groups {np.median(grouped / errors(plain, 'mixed_rates', kind)):.3f}")


if __name__ == "__main__":
    main()
