"""Correct digits of NIST's certified estimates: least squares sample by sample, and statsmodels (a minute).

    python benchmarks/certified.py            all data sets
    python benchmarks/certified.py --quick    the first alone

Prints the table of docs/units.md. Needs statsmodels.
"""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))

import numpy as np
import statsmodels.api as sm
from nist import DATA, digits
from rich.console import Console
from rich.table import Table

from driftfit import FLS, RLS, Kalman, Regression, track


def main() -> None:
    columns = ("RLS(1.0)", 'Kalman(form="sqrt")', "FLS, smoothed", "OLS, pinv", "OLS, qr", "RecursiveLS")
    table = Table("data set", *columns)
    for name, (y, X, certified, _) in list(DATA.items())[: 1 if "--quick" in sys.argv else None]:
        model, order = Regression(X.shape[1], intercept=True), [X.shape[1], *range(X.shape[1])]
        ours = [
            track(model, RLS(1.0), y, X).theta[-1],
            track(model, Kalman(q=0.0, r=1.0, form="sqrt"), y, X).theta[-1],
            track(model, FLS(np.inf), y, X).smooth().theta[-1],
        ]
        Z = sm.add_constant(X)
        theirs = [sm.OLS(y, Z).fit().params, sm.OLS(y, Z).fit(method="qr").params, sm.RecursiveLS(y, Z).fit().params]
        found = [theta[order] for theta in ours] + theirs
        table.add_row(name, *(f"{digits(theta, certified):.1f}" for theta in found))
    Console(width=120).print(table)


if __name__ == "__main__":
    with np.errstate(all="ignore"):  # RecursiveLS divides by zero on these data
        main()
