"""What works with what: every cell is tried on a small record, and says "yes" or, with the reason printed below, "no".

    python benchmarks/what_works.py [--quick]    the first row alone

`live` and `lanes` are "yes" if they give the bits of the record; `gaps` if missing values in both signals leave every
number finite; `tune` if it finds what the tracker leaves open; `C` if the exported source can be written.
"""

from __future__ import annotations

import sys
import tempfile
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from driftfit import (
    ARMAX,
    ARX,
    FLS,
    OE,
    RLS,
    AdaptiveKalman,
    Bank,
    BoxJenkins,
    ContinuousTransfer,
    DynamicGLM,
    Equation,
    HammersteinWiener,
    InstrumentalVariables,
    JointKalman,
    Kalman,
    Law,
    Live,
    ParticleFilter,
    Polynomial,
    Regression,
    StateSpace,
    track,
    tune,
)  # fmt: skip
from driftfit.embedded import export_c

COLUMNS = ("live", "lanes", "gaps", "smooth", "verdict", "tune", "forecast", "simulate", "gains", "C")
T = 300
K = Kalman(q=1e-4, r=0.1, p0=1.0)
HIDDEN = StateSpace("x = 0.5 * x[-1] + theta.b * u[-1] \n y = x + theta.c", start={"c": 0.0})
LAWS = Kalman(q=1e-4, r=0.1, laws={"b1": Law.returns(50, 0.2)})
PAIRS: list[tuple[str, Any, Any, Any]] = [
    ("Regression, AdaptiveKalman", Regression(1), AdaptiveKalman(), None),
    ("ARX, AdaptiveKalman", ARX(1, 1), AdaptiveKalman(), None),
    ("ARX, Kalman", ARX(1, 1), K, Kalman(p0=1.0)),
    ("ARX, Kalman with laws", ARX(1, 1), LAWS, None),
    ("ARX, RLS", ARX(1, 1), RLS(0.99), RLS()),
    ("ARX, FLS", ARX(1, 1), FLS(1e3), FLS()),
    ("ARX, InstrumentalVariables", ARX(1, 1), InstrumentalVariables(0.99), None),
    ("ARX, Bank", ARX(1, 1), Bank(), Bank()),
    ("ARMAX, RLS", ARMAX(1, 1, 1), RLS(0.99), RLS()),
    ("OE, Kalman", OE(1, 1), K, Kalman(p0=1.0)),
    ("BoxJenkins, AdaptiveKalman", BoxJenkins(1, 1, 1, 1), AdaptiveKalman(), None),
    ("Equation, Kalman", Equation("y = theta.g * tanh(u[-1]) + theta.a * y[-1]"), K, Kalman(p0=1.0)),
    ("HammersteinWiener, Kalman", HammersteinWiener(1, 1, input=Polynomial(2)), K, Kalman(p0=1.0)),
    ("StateSpace, JointKalman", HIDDEN, JointKalman(q=1e-4, r=0.1, p0=1.0), JointKalman(q=1e-4, p0=1.0)),
    ("StateSpace, JointKalman, extended", HIDDEN, JointKalman(q=1e-4, r=0.1, p0=1.0, method="extended"), None),
    ("StateSpace, ParticleFilter", HIDDEN, ParticleFilter(20, q=1e-4, r=0.1, p0=1.0), None),
    ("OE, InstrumentalVariables", OE(1, 1), InstrumentalVariables(0.99), None),
    ("BoxJenkins, InstrumentalVariables", BoxJenkins(1, 1, 1, 1), InstrumentalVariables(0.99), None),
    ("ContinuousTransfer, RLS", ContinuousTransfer(1), RLS(0.99), RLS()),
    ("ContinuousTransfer, Kalman", ContinuousTransfer(1), K, Kalman(p0=1.0)),
    ("ContinuousTransfer, AdaptiveKalman", ContinuousTransfer(1), AdaptiveKalman(), None),
    ("ContinuousTransfer, InstrumentalVariables", ContinuousTransfer(1), InstrumentalVariables(0.99), None),
    ("Regression, DynamicGLM", Regression(1), DynamicGLM("poisson", q=1e-4, p0=1.0), None),
]


def record(counts: bool) -> tuple[Any, Any]:
    """A first-order plant, or counts."""
    rng = np.random.default_rng(0)
    u, y = rng.normal(size=T), np.zeros(T)
    if counts:
        return rng.poisson(np.exp(0.5 * u)).astype(float), u
    for t in range(1, T):
        y[t] = 0.6 * y[t - 1] + u[t - 1] + 0.1 * rng.normal()
    return y, u


def live(model: Any, tracker: Any, y: Any, u: Any) -> bool:
    """Whether a stream ends with the bits of the record."""
    stream = Live(model, tracker)
    for one, drive in zip(y.tolist(), u.tolist(), strict=True):
        stream.update(one, drive)
    return bool((stream.theta == track(model, tracker, y, u).theta[-1]).all())


def lanes(model: Any, tracker: Any, y: Any, u: Any) -> bool:
    """Whether lanes of a tile end with the bits of the record."""
    fleet = track(model, tracker, np.stack([y] * 33), np.stack([u] * 33), by="row")
    return bool((fleet[17].theta[-1] == track(model, tracker, y, u).theta[-1]).all())


def gaps(model: Any, tracker: Any, y: Any, u: Any) -> bool:
    """Whether missing values leave everything finite."""
    y, u = y.copy(), u.copy()
    y[100:110], y[150], u[200] = np.nan, np.inf, np.nan
    return bool(np.isfinite(track(model, tracker, y, u).theta).all())


def exported(model: Any, tracker: Any) -> bool:
    """Whether C source is written."""
    with tempfile.TemporaryDirectory() as folder:
        export_c(model.bind(1), tracker, folder)
    return True


def cells_of(
    name: str, model: Any, tracker: Any, open_tracker: Any, reasons: dict[str, list[str]],
    columns: Sequence[str] = COLUMNS,
) -> list[str]:  # fmt: skip
    """A row of the table; the reasons of its "no" are added to ``reasons``."""
    y, u = record(isinstance(tracker, DynamicGLM))
    run = track(model, tracker, y, u)
    tried: dict[str, Callable[[], Any]] = {
        "live": lambda: live(model, tracker, y, u), "lanes": lambda: lanes(model, tracker, y, u),
        "gaps": lambda: gaps(model, tracker, y, u), "smooth": run.smooth, "verdict": run.verdict,
        "tune": lambda: tune(model, open_tracker, y, u), "forecast": lambda: run.forecast(3, np.ones(3)),
        "simulate": lambda: run.simulate(np.ones(5)), "gains": run.dc_gain, "C": lambda: exported(model, tracker),
    }  # fmt: skip
    cells = []
    for column in columns:
        try:
            if column == "tune" and open_tracker is None:
                raise ValueError("it has no numbers that tune finds")
            found = tried[column]()
            undecided = column == "verdict" and found.drifts is None
            cells.append("no" if found is False or undecided else "yes")
            if cells[-1] == "no":
                reasons.setdefault(f"{column}: the result is no answer", []).append(name)
        except ValueError as error:
            cells.append("no")
            reasons.setdefault(f"{column}: {str(error).split(';')[0].split(', so')[0][:90]}", []).append(name)
    return cells


def main() -> None:
    """Print the table, and the reasons of every "no"."""
    warnings.simplefilter("ignore")
    print(f"{'':42}" + "".join(f"{name:>9}" for name in COLUMNS))
    reasons: dict[str, list[str]] = {}
    for name, model, tracker, open_tracker in PAIRS[: 1 if "--quick" in sys.argv else None]:
        cells = cells_of(name, model, tracker, open_tracker, reasons)
        print(f"{name:42}" + "".join(f"{cell:>9}" for cell in cells), flush=True)
    print()
    for reason, names in reasons.items():
        print(f"{reason}\n    {', '.join(names)}")


if __name__ == "__main__":
    main()
