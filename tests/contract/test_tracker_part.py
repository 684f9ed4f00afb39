"""The steps of a tracker see a part of the record, and are compiled once for all models with as many parameters."""

import numpy as np
import pytest
from support import arx_record

from driftfit import ARX, RLS, Regression, track
from driftfit.engine.drivers import LARGEST, TrackerSteps, drivers
from driftfit.engine.kernel import kernel
from driftfit.engine.tiles import make_tile, output_type


@kernel
def still(s, l):
    pass


def steps(**more):
    """A tracker that only predicts, of steps made for this call alone."""

    @kernel
    def predicts(s, l):
        s.y_hat[l] = s.theta[0, l] * s.phi[0, l]
        s.e[l], s.s[l], s.var[0, l] = s.y[l] - s.y_hat[l], 1.0, 0.0

    return predicts, TrackerSteps(still, still, predicts, still, still, **more)


def run(model, tracker, T=20):
    tile = make_tile(model.n, model.m, model.memory(), [{"theta": np.ones(model.n)}])
    out = np.empty(T, output_type(tile))
    y, u = arx_record(T, 1)
    known = np.ones((1, 3, 1))
    drivers(model.steps, tracker).run(tile, y[:, None], np.repeat(u[:, None, None], model.m, axis=1), known, out)
    return tile, out


def test_steps_serve_every_model_with_as_many_parameters(own_cache):
    compiled, tracker = steps()
    for model in (Regression(1), ARX(0, 1), ARX(1, 0)):
        run(model, tracker)
    assert len(compiled.overloads) == 1
    run(Regression(2), tracker)
    assert len(compiled.overloads) == 2


def test_steps_that_name_a_field_of_the_model_must_say_so():
    @kernel
    def of_the_model(s, l):
        s.var[0, l] = s.y_lag[0, 0, l]

    given = TrackerSteps(still, still, steps()[0], of_the_model, still)
    with pytest.raises(TypeError, match=r"names the field 'y_lag'.*reads_model=True"):
        run(ARX(1, 0), given)
    _, out = run(ARX(1, 0), given._replace(reads_model=True))
    assert out["var"][1:, 0, 0] == pytest.approx(arx_record(20, 1)[0][:-1])
    assert np.all(np.abs(out["y_hat"][1:]) < LARGEST)


@pytest.mark.parametrize("lanes", [1, 32])
def test_a_model_begins_on_a_cache_line_of_its_own(lanes):
    model = ARX(2, 2)
    tile = make_tile(model.n, model.m, model.memory(), [RLS(0.98).state_for(model)] * lanes)
    places = {name: at for name, (_, at, *_) in tile.dtype.fields.items()}
    own = [name for name in (*model.memory(), "u") if places[name] > places["boundary"]]
    assert own == [*model.memory(), "u"]
    assert min(places[name] for name in own) % 64 == 0
    assert max(places[name] for name in ("theta", "P", "phi", "used_noise")) < places["boundary"]
    assert all(at % (8 * lanes) == 0 for at in places.values())


def test_the_fields_of_a_model_reach_its_steps():
    y, u = arx_record(200, 2)
    np.testing.assert_allclose(
        track(ARX(1, 1), RLS(1.0), y, u).theta[-1],
        np.linalg.lstsq(np.column_stack([y[:-1], u[:-1]]), y[1:], rcond=None)[0],
        rtol=1e-10,
    )
