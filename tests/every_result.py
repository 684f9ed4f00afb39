"""One result of every kind, for tests of what all of them must offer: copies, pictures, cells of a notebook."""

from functools import cache

import numpy as np
from support import arx_record

from driftfit import (
    ARX,
    RLS,
    Bank,
    HammersteinWiener,
    Kalman,
    Live,
    LiveSelection,
    Polynomial,
    Regression,
    Sensor,
    frontier,
    pool,
    select,
    track,
    tune,
)

Y, U = arx_record(200, 1)
TWO = np.column_stack([Y, 0.5 * Y[::-1]])
K = Kalman(q=1e-3, r=0.01)


@cache
def every_result():
    """Every kind of result and stream, by name; they are not changed."""
    run = track(ARX(2, 2), K, Y, U)
    fleet = track(ARX(2, 2), K, np.stack([Y] * 3), np.stack([U] * 3), by="row")
    outputs = track(ARX(1, 1, ny=2), K, TWO, U)
    shared = track(Regression(1, ny=2, shared=True), K, TWO, np.stack([U, U], axis=1)[..., None])
    bank = track(ARX(2, 2), Bank(sensors=[Sensor.nominal(r=0.01)]), Y, U)
    found = {"Track": run, "Fleet": fleet, "Outputs": outputs, "Instants": shared, "Bank": bank}
    found |= {"Live": Live(ARX(2, 2), K), "Live of outputs": Live(ARX(1, 1, ny=2), K)}
    found |= {"LiveSelection": LiveSelection([ARX(2, 2), ARX(1, 1)], tracker=RLS(1.0))}
    for t in range(30):
        found["Live"].update(Y[t], U[t])
        found["LiveSelection"].update(Y[t], U[t])
        found["Live of outputs"].update(TWO[t], U[t])
    for name in ("Track", "Fleet", "Outputs", "Instants"):
        for verb in ("summary", "verdict", "diagnose"):
            found[f"{name}.{verb}"] = getattr(found[name], verb)()
    found |= {"Track.smooth": run.smooth(), "Bank.hypotheses": bank.hypotheses, "Bank.smooth": bank.smooth()}
    found |= {"Tuned": tune(ARX(2, 2), Kalman(), Y, U), "TunedOutputs": tune(ARX(1, 1, ny=2), Kalman(), TWO, U)}
    found |= {"Selection": select([ARX(2, 2), ARX(1, 1)], Y, U, tracker=RLS(1.0)), "Segmentation": run.segment()}
    found |= {"Frontier": frontier(ARX(2, 2), Y, U), "detect": run.detect(records=8)}
    found |= {"Forecast": run.forecast(2, U[:2]), "Prediction": run.ahead(2), "Response": run.step_response(5)}
    found["Constrained"] = run.constrain("a1 >= 0")
    found["Pooled"] = pool(track(Regression(1), Kalman(q=0.0, r=1.0), Y.reshape(10, 20), U.reshape(10, 20), by="row"))
    curved = HammersteinWiener(1, 1, input=Polynomial(2), output=Polynomial(2))
    found["HammersteinWiener"] = track(curved, RLS(1.0), Y, U)
    found["Blocks"] = found["HammersteinWiener"].blocks()
    return found
