"""Writes the record that `driftfit demo` tracks, from the data set `macrodata` of statsmodels (public domain).

Needs `pip install statsmodels`. Run: python examples/make_us_money_demand.py src/driftfit/demo/us_money_demand.csv
"""

import sys
from pathlib import Path

import statsmodels.api as sm

HEADER = """\
# United States, quarterly, 1959 Q1 to 2009 Q3. Public domain.
# m1: M1 money stock, end of quarter, billion dollars, seasonally adjusted
# cpi: consumer price index, all items, end of quarter, 1982-84 = 100, seasonally adjusted
# realgdp: real gross domestic product, billion chained 2005 dollars, seasonally adjusted annual rate
# tbilrate: 3-month treasury bill, secondary market, average of the quarter, percent a year
# Federal Reserve Economic Data (St. Louis Fed) of December 2009, compiled by Skipper Seabold as statsmodels' macrodata;
# columns chosen by examples/make_us_money_demand.py.
"""


def main(path: str) -> None:
    data = sm.datasets.macrodata.load_pandas().data
    table = data[["year", "quarter", "m1", "cpi", "realgdp", "tbilrate"]].astype({"year": int, "quarter": int})
    Path(path).write_text(HEADER + table.to_csv(index=False))


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__.strip())
    main(*sys.argv[1:2])
