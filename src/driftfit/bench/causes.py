"""Why a row beats `AdaptiveKalman` on a scenario: found by looking, printed beside the losses."""

from __future__ import annotations

CAUSES: dict[str, str] = {
    "no_drift": (
        "Where nothing ever moves, least squares is optimal. `AdaptiveKalman` keeps filters that would follow a drift "
        "or a jump, and their share of the mixture is the price: it never becomes sure that nothing will move."
    ),
    "mixed_rates": (
        "One ladder of drift ratios moves all parameters, and here one walks fast, one slowly, two stand. Told which "
        "one is fast, `AdaptiveKalman(groups=[[0]])` has 0.77 of the error for ARX and 0.87 for the regression, which "
        "is below every row of one ratio."
    ),
    "ramp": "The ratio is learned from the record; hindsight has the one that is best on these very runs.",
    "sparse_jumps": (
        "Parameters that stand still between jumps are what `Bank()` assumes. Where they walk, or where outliers come "
        "that it was given no hypothesis for, it is far behind."
    ),
    "missing_data": (
        "The ratio has to be learned from fewer samples, and after the outage from none; a tuned row was told it from "
        "other runs of the same scenario."
    ),
    "lost_excitation": (
        "While the input is dull nothing says how fast parameters drift; a tuned row was told it from other runs."
    ),
    "collinear_inputs": (
        "The direction that collinear regressors do not show says nothing of its drift; a tuned row was told it from "
        "other runs."
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
