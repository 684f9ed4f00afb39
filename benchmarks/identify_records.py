"""Errors of `driftfit.identify` on real records, beside constants, the tracker alone, constant ARX and persistence.

The folder holds the files of `RECORDS`, which are not part of the project (river Le Leguer, INRAE; heated building,
darkgreybox; gas furnace, Box and Jenkins; heat exchanger, DaISy; UCI air quality; pump loop, SKAB; US consumption,
fpp2). Two more are installed with driftfit. Errors are those of predictions before the sample, with the structure that
was chosen from the whole record; "of best" is theirs over the best of constants, the tracker and persistence. The
budget is long enough for all rows.

Run: python benchmarks/identify_records.py --data FOLDER    # --quick: one record that is installed
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any

import polars as pl

from driftfit import identify

DEMO = Path(str(files("driftfit.demo")))
RECORDS: Mapping[str, tuple[str, str, Mapping[str, Any]]] = {
    "pump": ("pump.csv", "flow", {}),
    "US money": ("us_money_demand.csv", "m1", {}),
    "gas furnace": ("gas_furnace.csv", "co2", {}),
    "building": ("building_heating.csv", "indoor_C", {}),
    "river": ("river_leguer.csv", "flow_mm", {"not_u": ["flow_gr4j_mm"]}),
    "river, with a model": ("river_leguer.csv", "flow_mm", {}),
    "US consumption": ("us_consumption_change.csv", "Consumption", {}),
    "heat exchanger": ("heat_exchanger.csv", "temp_out_C", {}),
    "air quality": ("air_quality_sensors.csv", "PT08_S4_NO2", {}),
    "pump loop, valve 1": ("pump_loop_skab.csv", "flow_lpm", {"keep": "valve1_1"}),
    "pump loop, valve 5": ("pump_loop_skab.csv", "flow_lpm", {"keep": "valve1_5"}),
    "pump loop, rotor": ("pump_loop_skab.csv", "flow_lpm", {"keep": "other_6"}),
}
METHODS = ("driftfit", "constants", "tracked", "constant ARX", "persistence")


def main() -> None:
    """Print a row for each record and number of steps."""
    options = argparse.ArgumentParser()
    options.add_argument("--data", type=Path, required=True, help="folder of the files")
    options.add_argument("--only", default="", help="records whose name contains this")
    options.add_argument("--quick", action="store_true", help="only the record of US money")
    given = options.parse_args()
    print(f"{'record':22}{'steps':>6}{'samples':>8}{''.join(f'{name:>13}' for name in METHODS)}{'of best':>9}  answer")
    for name in (one for one in RECORDS if ("US money" if given.quick else given.only) in one):
        file, y, more = RECORDS[name]
        path = DEMO / file if (DEMO / file).exists() else given.data / file
        table: Any = str(path)
        if "keep" in more:
            table = pl.read_csv(path).filter(pl.col("experiment") == more["keep"])
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = identify(table, y, budget=600.0, **{key: value for key, value in more.items() if key != "keep"})
        for steps, rms, samples in found.errors:
            best = min(rms[one] for one in ("constants", "tracked", "persistence"))
            cells = "".join(f"{rms[one]:13.4g}" for one in METHODS)
            print(f"{name:22}{steps:6}{samples:8}{cells}{rms['driftfit'] / best:9.3f}  {found.kind}", flush=True)


if __name__ == "__main__":
    main()
