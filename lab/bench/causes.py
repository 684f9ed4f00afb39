"""Why a row beats `AdaptiveKalman` on a scenario, found by experiments and printed with the losses."""

from __future__ import annotations

LEARNED = (
    "The ratio is learned from the record; the tuned rows have it from other runs of the scenario, hindsight and "
    "maximum likelihood from these very runs."
)

CAUSES: dict[str, str] = {
    "no_drift": (
        "Where nothing changes, least squares is optimal. `AdaptiveKalman` keeps filters that could follow a drift "
        "or a jump. Without transitions to them its error falls by 4 % (3 % for ARX). The rest has another reason: all "
        "ratios are equally probable at the start, and filters with small ratios are distinguished from no drift only "
        "slowly."
    ),
    "slow_walk": LEARNED,
    "fast_walk": LEARNED,
    "sparse_jumps": (
        "`Bank()` assumes that parameters are constant between jumps. Where they are random walks, or where outliers "
        "occur for which it has no hypothesis, it is far behind."
    ),
    "mixed_rates": (
        "One parameter changes fast, one slowly, and two are constant, which `AdaptiveKalman` learns: telling it which "
        "one is fast, `AdaptiveKalman(groups=[[0]])`, lowers its error by 1 % only. Maximum likelihood of every drift "
        "uses the whole record."
    ),
    "missing_data": (
        "This is the cost of learning: with the scenario's drift ratio throughout the error falls by 2 %, and with "
        "a single noise level as well by 3 %."
    ),
    "lost_excitation": (
        "This is the cost of learning: with the scenario's drift ratio throughout the error falls by 2 %, and with a "
        "single noise level as well by no more."
    ),
    "collinear_inputs": (
        "This is the cost of learning: with the scenario's drift ratio throughout the error falls by 3 %, and with "
        "a single noise level as well by 5 %."
    ),
}
"""By scenario."""

REAL_CAUSES = (
    "On the industry portfolios and the money demand the differences between the trackers that allow drift are "
    "insignificant; the difference to constant least squares is significant. Trackers with one tuned number are a "
    "little better where the drift is slow and steady, as in the simulated random walks."
)
"""Causes of the losses on real records."""

SPEED_CAUSES = (
    "The first result is where driftfit loses to packages without a compiler: it takes seconds the first time on a "
    "computer, and half a second after that, half of it for loading Numba. With Numba and LLVM it is also among the "
    "larger packages to install."
)
"""Why a peer is faster, where one is."""
