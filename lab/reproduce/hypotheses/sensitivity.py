"""The cost of wrong settings: root mean square errors of five reductions when one setting is wrong."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from driftfit.bank.bank import Bank
from driftfit.bank.change import Change
from driftfit.bank.reduction import GPB, IMM, Beam, Decide, Reduction
from driftfit.bank.sensor import Sensor
from lab.reproduce.hypotheses.contests import P0, Contest, Entry, R
from lab.reproduce.hypotheses.references import sensitivity
from lab.reproduce.hypotheses.scores import measure

REDUCTIONS: dict[str, Reduction] = {
    "Decide(2)": Decide(2), "Decide(4)": Decide(4), "GPB(2)": GPB(2), "IMM": IMM(), "Beam(9)": Beam(9),
}  # fmt: skip


def bank(
    reduce: Reduction, jumps: float = 1.0, priors: float = 1.0, noise: float = 1.0, drift: float = 1.0,
    medium: bool = False,
) -> Bank:  # fmt: skip
    """The bank of the tables, with factors on its settings."""
    more: tuple[tuple[Any, float], ...] = ((0.05, 0.003),) if medium else ()
    moves = ((0.6, 0.006), ([1e-6, 1e-6, 1.5], 0.004), *more)
    changes = [Change(0.002**2 * drift)]
    for q, prob in moves:
        wide = q * jumps if isinstance(q, float) else [one * jumps if one > 1e-3 else one for one in q]
        changes.append(Change(wide, prob=prob * priors))
    return Bank(changes, [Sensor.nominal(R * noise)], reduce=reduce, p0=P0)


VARIATIONS: dict[str, Callable[[Reduction], Bank]] = {
    "nominal": bank,
    **{f"jump covariances x{f:g}": partial(bank, jumps=f) for f in (0.1, 10.0, 100.0)},
    **{f"jump priors x{f:g}": partial(bank, priors=f) for f in (0.01, 10.0)},
    **{f"assumed r x{f:g}": partial(bank, noise=f) for f in (0.25, 2.0, 4.0)},
    "Q0 x100": partial(bank, drift=100.0),
    "4 hypotheses: + medium jump 0.05 I": partial(bank, medium=True),
}


def rows(runs: int) -> dict[str, tuple[tuple[float, ...], tuple[float | None, ...]]]:
    """For every variation: the RMSE of the five reductions and that of the second when steady; and the reference."""
    reference = sensitivity()
    found = {}
    for name, vary in VARIATIONS.items():
        entries = {label: Entry(vary(reduce)) for label, reduce in REDUCTIONS.items()}
        contest = Contest(name, "none", 10.0, runs, 600, 0, entries.copy, "", 50)
        values = {label: measure(contest, label, runs).values for label in entries}
        found[name] = ((*(v[0] for v in values.values()), values["Decide(4)"][3]), reference[name])
    return found
