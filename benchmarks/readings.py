"""A bad reading of every size at every position of a record, for every tracker and model (about half an hour).

    python benchmarks/readings.py            every position
    python benchmarks/readings.py --quick    a position in ten

Prints how many records ended with something that is neither finite nor marked, or had not recovered a hundred samples
after the reading. tests/test_readings.py keeps a few thousand of them.
"""

import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))

from contract_table import forms, model_of, ready
from readings import AFTER, failures

from driftfit import ARX, HammersteinWiener
from driftfit.models.hammerstein_wiener.curves.basis import BSpline, PiecewiseLinear, Polynomial
from driftfit.trackers import found

MODELS = {
    "ARX(2, 2)": ARX(2, 2),
    "ARX(2, 2, intercept)": ARX(2, 2, intercept=True),
    "HammersteinWiener, cubic": HammersteinWiener(1, 2, 1, input=Polynomial(3), output=Polynomial(3)),
    "HammersteinWiener, pieces": HammersteinWiener(
        2, 2, 0, input=BSpline(2, (-3, 0, 3)), output=PiecewiseLinear((-1, 1))
    ),
}


def main() -> None:
    T, step = 60, 10 if "--quick" in sys.argv else 1
    for name, one in MODELS.items():
        for kind, tracker in found().items():
            for form in forms(tracker):
                this = ready(tracker, **form)
                model = model_of(this, one.bind(1)) if name == "ARX(2, 2)" else one.bind(1)
                if name == "ARX(2, 2, intercept)" and this.own_model(2, 2, 1):
                    continue  # it works on its own models, which come below
                began = time.perf_counter()
                wrong, count = failures(model, this, range(0, T, step), T + AFTER + 10)
                what = sorted({(value, signal, said) for _, value, signal, said in wrong}, key=str)
                print(f"{name:25} {kind:16} {form or ''!s:20} {count:6} records, {len(wrong)} wrong, "
                      f"{time.perf_counter() - began:.0f} s", *what[:6], sep="\n    ", flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
