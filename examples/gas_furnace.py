"""A control record: the gas furnace of Box and Jenkins (series J), often shown as a record without drift.

Prints the verdict, its p-value for several orders, with the lags of correlation that were found and with none.
Run: python examples/gas_furnace.py gas_furnace.csv (columns gas_rate and co2)
"""

import sys

import polars as pl

from driftfit import ARX, AdaptiveKalman, track


def main(path: str) -> None:
    data = pl.read_csv(path)
    for na, nb in ((2, 2), (2, 3), (3, 3), (4, 3)):
        model = ARX(na, nb, nk=3, intercept=True)
        run = track(model, AdaptiveKalman(), y="co2", u="gas_rate", data=data)
        said = run.verdict()
        if (na, nb) == (2, 2):
            print("\n".join(said.sentences))
        print(f"ARX({na}, {nb}): p = {said.p:.4f} with {said.lags} lags, {run.verdict(lags=0).p:.4f} with none")


if __name__ == "__main__":
    main(sys.argv[1])
