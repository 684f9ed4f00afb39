"""Forecasts of real records, several samples ahead: their error beside persistence, and what their bands cover.

The model and its drift are those of `examples/real_records.py`: chosen by one-step error in the first half. In the
second half a stream forecasts from every fifth sample, with the inputs that were observed later. "constants" is the
same model without drift. Persistence holds the last value.

Run: python examples/real_forecasts.py FOLDER
"""

import sys
from pathlib import Path

import numpy as np
from real_records import RATIOS, Case, building_arx, error, fit, furnace, river
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from driftfit import Live, Tracker
from driftfit.run.result import root_mean_square

AHEAD, EVERY = (1, 2, 5, 10, 20), 5


def forecasts(case: Case, tracker: Tracker, origins: list[int], h: int) -> tuple[np.ndarray, np.ndarray]:
    """Forecasts (origins, h) and their standard deviations."""
    live, found = Live(case.model, tracker), []
    for t in range(max(origins) + 1):
        live.update(case.y[t], case.u[t])
        if t in origins:
            ahead = live.forecast(h, case.u[t + 1 : t + 1 + h])
            found.append((ahead.y_hat, ahead.y_std))
    return tuple(np.array(part) for part in zip(*found, strict=True))


def main(folder: str) -> None:
    table = Table(box=SIMPLE_HEAD, show_edge=False)
    for head in ("record", "samples ahead", "tracked", "in band", "constants", "in band", "persistence"):
        table.add_column(head, justify="left" if head == "record" else "right", no_wrap=True)
    for read in (river, building_arx, furnace):
        case = read(Path(folder))
        T, h = len(case.y), max(AHEAD)
        fits = {ratio: fit(case, ratio, T // 2) for ratio in RATIOS}
        best = max(fits, key=lambda ratio: error(fits[ratio]))
        origins = list(range(T // 2, T - h - 1, EVERY))
        truth = np.array([case.y[t + 1 : t + 1 + h] for t in origins])
        results = [forecasts(case, fits[ratio].tracker, origins, h) for ratio in (best, 0.0)]
        held = np.array([case.y[t] for t in origins])[:, None] + 0.0 * truth
        for k in AHEAD:
            cells, at = [], k - 1
            for y_hat, std in results:
                e = (truth - y_hat)[:, at]
                known = np.isfinite(e)
                cells += [
                    f"{root_mean_square(e[known]):.3f}",
                    f"{np.mean(np.abs(e[known]) < 1.96 * std[known, at]):.2f}",
                ]
            e = (truth - held)[:, at]
            cells.append(f"{root_mean_square(e[np.isfinite(e)]):.3f}")
            table.add_row(case.name if k == AHEAD[0] else "", str(k), *cells)
    Console(width=110).print(table)


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__.strip())
    main(*sys.argv[1:2])
