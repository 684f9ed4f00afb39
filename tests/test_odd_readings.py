"""Fault codes, coarse meters, rests and gaps: behind a gate models that are linearised stay where they were, with every
tracker; each model with trackers that fail differently.

A linear model with the same tracker recovers as the tracker forgets; these models must not be taken to where no sample
brings them back.
"""

import numpy as np
import pytest
from scipy import signal
from support import same

from driftfit import (
    OE,
    RLS,
    AdaptiveKalman,
    Bank,
    BoxJenkins,
    ContinuousTransfer,
    Equation,
    InstrumentalVariables,
    JointKalman,
    Kalman,
    Live,
    ParticleFilter,
    StateSpace,
    track,
)

T, AT = 900, 400
K, IV = Kalman(q=1e-6, r=0.01, p0=1.0), InstrumentalVariables(0.99)
Q, P0 = {"a": 1e-6, "b": 1e-6, "c": 1e-6, "x": 1e-5}, {"a": 0.1, "b": 0.1, "c": 1.0, "x": 1.0}
HIDDEN = StateSpace("x = theta.a * x[-1] + theta.b * u[-1] \n y = x + theta.c", start={"a": 0.5, "b": 0.3})
CURVE = Equation("y = theta.k * tanh(theta.s * u)")
MODELS = {
    "continuous": (ContinuousTransfer(1), (0.3, 0.6)), "OE": (OE(1, 1), (1.0, 0.7)),
    "Box-Jenkins": (BoxJenkins(1, 1, 1, 1), (1.0, None, None, 0.7)), "equation": (CURVE, (2.0, 0.8)),
    "hidden": (HIDDEN, (0.8, 0.5, 0.3)),
}  # fmt: skip
PAIRS = [
    *(("continuous", one) for one in (K, AdaptiveKalman(), IV)), *(("OE", one) for one in (RLS(0.99), IV)),
    *(("Box-Jenkins", one) for one in (AdaptiveKalman(), IV)), *(("equation", one) for one in (RLS(0.99), Bank())),
    *(("hidden", one) for one in (
        JointKalman(q=Q, r=0.01, p0=P0), JointKalman(q=Q, r=0.01, p0=P0, method="extended"),
        ParticleFilter(50, q=Q, r=0.01, p0=P0),
    )),
]  # fmt: skip
BEYOND = {("hidden", ParticleFilter): ["at rest, then moved"]}
"""What is known to go wrong: copies of one path remain of the particles."""
NAMES = [f"{name}, {type(tracker).__name__}" for name, tracker in PAIRS]


def responses(name, u, e):
    """The output of the plant of a model."""
    fall = np.exp(-0.3)
    return {
        "continuous": lambda: signal.lfilter([0.0, 2.0 * (1.0 - fall)], [1.0, -fall], u) + e,
        "OE": lambda: signal.lfilter([0.0, 1.0], [1.0, -0.7], u) + e,
        "Box-Jenkins": lambda: signal.lfilter([0.0, 1.0], [1.0, -0.7], u) + signal.lfilter([1.0, 0.4], [1.0, -0.6], e),
        "equation": lambda: 2.0 * np.tanh(0.8 * u) + e,
        "hidden": lambda: signal.lfilter([0.0, 0.5], [1.0, -0.8], u) + 0.3 + e,
    }[name]()


def cases(name):
    """y and u (cases, T) by what is odd in them; the first is whole."""
    rng = np.random.default_rng(0)
    u, e = np.repeat(rng.normal(size=T // 3), 3), 0.1 * rng.normal(size=T)
    y = responses(name, u, e)
    found = {"whole": (y, u)}
    for what, places, value in (
        ("9999", slice(AT, AT + 1), 9999.0), ("-999", slice(AT, AT + 1), -999.0),
        ("9999 for 20 samples", slice(AT, AT + 20), 9999.0), ("-999 for 20 samples", slice(AT, AT + 20), -999.0),
    ):  # fmt: skip
        bad = y.copy()
        bad[places] = value
        found[what] = bad, u
    step = 0.15 * np.std(y)
    found["coarse"] = step * np.round(y / step), u
    lost, gone = y.copy(), u.copy()
    lost[300:340], gone[500:510], lost[600:700:3] = np.nan, np.nan, np.nan
    found["gaps"] = lost, gone
    idle = u.copy()
    idle[:200] = 0.0
    found["at rest, then moved"] = np.where(np.arange(T) < 200, 0.0, responses(name, idle, e)), idle
    found["factor 1e5 in y"] = 1e5 * y, u
    return found


@pytest.mark.parametrize(("name", "tracker"), PAIRS, ids=NAMES)
def test_odd_readings_do_no_lasting_harm(name, tracker):
    """In lanes; errors at the end are within bands, and at most a few times that of the whole record."""
    model, truth = MODELS[name]
    known = [i for i, one in enumerate(truth) if one is not None]
    given, bound = cases(name), model.bind(1)
    dimensions = bound.dimensions
    for one in BEYOND.get((name, type(tracker)), ()):
        del given[one]
    if dimensions is None or not isinstance(tracker, RLS | AdaptiveKalman | InstrumentalVariables):
        given.pop("factor 1e5 in y", None)  # units are in the settings, and in the start of an equation
    y, u = (np.stack(part) for part in zip(*given.values(), strict=True))
    fleet = track(model, tracker, y, u, by="row", gate=True)
    for k, what in enumerate(given):
        run, scale = fleet[k], 1e5 if what.startswith("factor") else 1.0
        assert np.isfinite(run.theta).all(), what
        assert not what.startswith("factor") or np.isfinite(run.loglik), what
        theta, std = run.theta[-1].copy(), run.std[-1].copy()
        for i in known if scale > 1.0 else ():
            theta[i], std[i] = theta[i] / scale ** dimensions[i][0], std[i] / scale ** dimensions[i][0]
        error = np.array([abs(theta[i] - truth[i]) for i in known])
        if name == "equation" and theta[0] < 0.0:  # k and s may both have the other sign
            error = np.array([abs(theta[i] + truth[i]) for i in known])
        allowed = 4.0 * std[known] + (0.03 if what == "coarse" else 0.0)
        assert (error < allowed).all(), (what, error, std)
        assert error.max() < 0.15, (what, error)


@pytest.mark.parametrize(("name", "tracker"), [PAIRS[0], PAIRS[9]], ids=[NAMES[0], NAMES[9]])
def test_a_stream_refuses_the_same_readings(name, tracker):
    model, _ = MODELS[name]
    y, u = cases(name)["9999 for 20 samples"]
    run, live = track(model, tracker, y[:450], u[:450], gate=True), Live(model, tracker, gate=True)
    for t in range(450):
        live.update(y[t], u[t])
    assert same(live.theta, run.theta[-1])
    assert run.left_out.sample.tolist() == [*range(AT, AT + 20)]
