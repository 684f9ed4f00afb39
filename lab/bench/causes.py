"""Why a row beats `AdaptiveKalman` on a scenario, printed with the losses."""

from __future__ import annotations

LEARNED = (
    "`AdaptiveKalman` learns the ratio of drift to noise from the record. The tuned rows have it from other runs of "
    "the scenario, hindsight and maximum likelihood from these very runs."
)

CAUSES: dict[str, str] = {
    "no_drift": (
        "Where nothing changes, least squares is optimal. `AdaptiveKalman` keeps filters that could follow a change, "
        "and distinguishes a small drift from none only slowly."
    ),
    "sparse_jumps": (
        "`Bank()` assumes that parameters are constant between jumps. It is far behind where they are random walks, or "
        "where outliers occur."
    ),
    "mixed_rates": (
        "Parameters differ in their drift, which `AdaptiveKalman` has to learn. Maximum likelihood of every drift uses "
        "the whole record."
    ),
    **dict.fromkeys(("slow_walk", "fast_walk", "missing_data", "lost_excitation", "collinear_inputs"), LEARNED),
}
"""By scenario."""

REAL_CAUSES = (
    "Most trackers that allow drift do not differ significantly. Those with one tuned number are a little better where "
    "the drift is slow and steady, as in the simulated random walks."
)
"""Causes of the losses on real records."""

SPEED_CAUSES = (
    "Packages without a compiler have their first result sooner: driftfit takes seconds the first time on a computer, "
    "and half a second after that. With Numba and LLVM it is also among the larger packages to install."
)
"""Why a peer is faster, where one is."""
