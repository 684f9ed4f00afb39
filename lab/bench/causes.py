"""Why a row beats `AdaptiveKalman` on a scenario: found by looking, printed beside the losses."""

from __future__ import annotations

CAUSES: dict[str, str] = {
    "no_drift": (
        "Where nothing ever moves, least squares is optimal. `AdaptiveKalman` keeps filters that would follow a drift "
        "or a jump. Without the ways up to them its error falls by 5 % (3 % for ARX); the rest is that it begins with "
        "all ratios equally probable, and filters of small ratios are told from none only slowly."
    ),
    "ramp": "The ratio is learned from the record; hindsight has the one that is best on these very runs.",
    "sparse_jumps": (
        "Parameters that stand still between jumps are what `Bank()` assumes. Where they walk, or where outliers come "
        "that it was given no hypothesis for, it is far behind."
    ),
    "mixed_rates": (
        "One ladder of drift ratios moves all parameters, and here one walks fast, one slowly, two stand. Told which "
        "one is fast, `AdaptiveKalman(groups=[[0]])` has 0.77 of the error for ARX and 0.87 for the regression, which "
        "is below every row of one ratio."
    ),
    "missing_data": (
        "The price of learning: with the ratio of the scenario on every rung the error falls by 2.7 %, with one noise "
        "level besides by 3.6 %, and the difference is gone."
    ),
    "lost_excitation": (
        "The price of learning: with the ratio of the scenario on every rung the error falls by 1 %, with one noise "
        "level besides by 2 %."
    ),
    "collinear_inputs": (
        "The price of learning: with the ratio of the scenario on every rung the error falls by 1.5 %, with one noise "
        "level besides by 3.6 %."
    ),
}
"""By scenario."""

REAL_CAUSES = (
    "On the industry portfolios and the money demand the differences between the trackers that follow anything are "
    "within chance; constant least squares is not. Trackers with one tuned number are a little ahead where the drift "
    "is slow and steady, as on the simulated walks."
)
"""What the real records say."""

SPEED_CAUSES = (
    "The first result is where driftfit loses to packages without a compiler: seconds the first time on a computer, "
    "half a second after that, of which loading Numba is half. With Numba and LLVM it is also among the larger to "
    "install."
)
"""Why a peer is faster, where one is."""
