"""Correct digits of NIST's certified estimates: least squares sample by sample, and statsmodels (a minute).

    python benchmarks/certified.py            all data sets
    python benchmarks/certified.py --quick    the first alone, without the smoother

Prints the table of docs/units.md. Needs statsmodels.
"""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))

import numpy as np
import statsmodels.api as sm
from nist import DATA, digits
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from driftfit import FLS, RLS, Kalman, Regression, Tracker, track

COLUMNS: dict[str, Callable[[Any, Any], Any]] = {
    "RLS(1.0)": lambda y, X: tracked(RLS(1.0), y, X).theta[-1],
    'Kalman(form="sqrt")': lambda y, X: tracked(Kalman(q=0.0, r=1.0, form="sqrt"), y, X).theta[-1],
    "FLS, smoothed": lambda y, X: tracked(FLS(np.inf), y, X).smooth().theta[-1],
    "OLS, pinv": lambda y, X: sm.OLS(y, sm.add_constant(X)).fit().params,
    "OLS, qr": lambda y, X: sm.OLS(y, sm.add_constant(X)).fit(method="qr").params,
    "RecursiveLS": lambda y, X: sm.RecursiveLS(y, sm.add_constant(X)).fit().params,
}


def tracked(tracker: Tracker, y: Any, X: Any) -> Any:
    return track(Regression(X.shape[1], intercept=True), tracker, y, X)


def main() -> None:
    quick = "--quick" in sys.argv
    columns = [name for name in COLUMNS if not (quick and name.startswith("FLS"))]
    table = Table("data set", *columns, box=SIMPLE_HEAD, show_edge=False)
    for name, (y, X, certified, _) in list(DATA.items())[: 1 if quick else None]:
        order = [X.shape[1], *range(X.shape[1])]  # the constant first, as theirs
        found = {one: COLUMNS[one](y, X) for one in columns}
        rows = [theta[order] if k < columns.index("OLS, pinv") else theta for k, theta in enumerate(found.values())]
        table.add_row(name, *(f"{digits(theta, certified):.1f}" for theta in rows))
    Console(width=120).print(table)


if __name__ == "__main__":
    with np.errstate(all="ignore"):  # RecursiveLS divides by zero on these data
        main()
