"""A bad reading of every size at every position of a record, for every tracker and model (about half an hour).

    python benchmarks/readings.py            every position
    python benchmarks/readings.py --quick    the first position, of the first model and every sixth tracker
    python benchmarks/readings.py cubic      the models whose name contains the word

Prints how many records ended with something that is neither finite nor marked, or had not recovered a hundred samples
after the reading; the table at the end is that of docs/units.md. tests/test_readings.py keeps a few thousand of them.
"""

import sys
import time
import warnings
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))

from contract_table import forms, model_of, ready
from readings import AFTER, failures

from driftfit import ARMAX, ARX, OE, BoxJenkins, Equation, HammersteinWiener, PolynomialModel
from driftfit.models.hammerstein_wiener.basis import BSpline, PiecewiseLinear, Polynomial
from driftfit.run.program import Program
from driftfit.trackers import found

MODELS = {
    "ARX(2, 2)": ARX(2, 2),
    "ARX(2, 2, intercept)": ARX(2, 2, intercept=True),
    "HammersteinWiener, cubic": HammersteinWiener(1, 2, 1, input=Polynomial(3), output=Polynomial(3)),
    "HammersteinWiener, pieces": HammersteinWiener(
        2, 2, 0, input=BSpline(2, (-3, 0, 3)), output=PiecewiseLinear((-1, 1))
    ),
    "ARMAX": ARMAX(2, 2, 1, offset=True),
    "OE": OE(nb=2, nf=2),
    "BoxJenkins": BoxJenkins(nb=1),
    "PolynomialModel": PolynomialModel(na=1, nb=1, nc=1, nd=1, nf=1),
    "Equation, bounded": Equation("y = theta.a * y[-1] + theta.b * tanh(theta.s * u[-1])"),
    "Equation, powers": Equation("y = theta.a * y[-1] + theta.b * u[-1] / (1 + (theta.s * u[-1]) ** 2) + theta.c"),
}


def main() -> None:
    warnings.simplefilter("ignore")  # raw powers of such records are badly scaled, which is the point
    T, quick = 60, "--quick" in sys.argv
    totals = {name: [0, 0, 0] for name in MODELS}
    words = [word for word in sys.argv[1:] if word != "--quick"] or ["ARX(2, 2)"][: int(quick)]
    for name, one in MODELS.items():
        if words and not any(word in name for word in words):
            continue
        for kind, tracker in list(found().items())[:: 6 if quick else 1]:
            for form in forms(tracker):
                this = ready(tracker, **form)
                model = model_of(this, one.bind(1)) if name == "ARX(2, 2)" else one.bind(1)
                if name == "ARX(2, 2, intercept)" and this.own_model(2, 2, 1):
                    continue  # it works on its own models, which come below
                try:
                    _ = Program(model, this).steps
                except ValueError as why:  # instruments take the place of past outputs only
                    print(f"{name:25} {kind:22} {str(why).split(',')[0]}", flush=True)
                    continue
                began = time.perf_counter()
                wrong, count = failures(model, this, range(1 if quick else T), T + AFTER + 10)
                totals[name] = [a + b for a, b in zip(totals[name], (1, count, len(wrong)), strict=True)]
                what = sorted({(value, signal, result) for _, value, signal, result in wrong}, key=str)
                print(f"{name:25} {kind:22} {form or ''!s:20} {count:6} records, {len(wrong)} wrong, "
                      f"{time.perf_counter() - began:.0f} s", *what[:6], sep="\n    ", flush=True)  # fmt: skip
    print(f"{'':25} trackers and forms   records   neither finite nor marked, or not recovered")
    for name, (cases, count, wrong) in totals.items():
        if cases:
            print(f"{name:25} {cases:18} {count:9} {wrong:9}")


if __name__ == "__main__":
    main()
