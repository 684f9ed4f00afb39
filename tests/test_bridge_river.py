"""The river bridge: river's own checks, and the numbers of `Live`."""

import copy
import math
import pickle

import numpy as np
import pytest

from driftfit import RLS, Kalman, Live, Regression

pytest.importorskip("river", reason="river is not installed")

from river import checks, datasets, evaluate, linear_model, metrics, preprocessing

from driftfit.bridges.river import TrackedRegressor


def samples(T=120, seed=0):
    rng = np.random.default_rng(seed)
    for t in range(T):
        x = {"b": float(rng.normal()), "a": float(rng.normal())}
        yield x, 2 * x["a"] - (1 if t < 60 else 3) * x["b"] + 0.5 + 0.1 * rng.normal()


@pytest.fixture(scope="module")
def compiled():
    """One of the checks watches the memory, which compiling takes too."""
    model = TrackedRegressor(RLS(0.98))
    for x, y in datasets.TrumpApproval().take(20):
        model.predict_one(x)
        model.learn_one(x, y)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.usefixtures("compiled")
@pytest.mark.parametrize(
    "check", list(checks.yield_checks(TrackedRegressor(RLS(0.98)))), ids=lambda check: check.__name__
)
def test_passes_the_checks_of_river(check):
    check(TrackedRegressor(RLS(0.98)))


def test_a_category_is_refused_by_name_and_leaves_the_model_as_it_was():
    model = TrackedRegressor(RLS(0.98))
    for x, y in samples(20):
        model.learn_one(x, y)
    before = model.coef
    for call in (lambda x: model.learn_one(x, 1.0), model.predict_one):
        with pytest.raises(ValueError, match="the feature 'colour' is 'red', which is not a number"):
            call({"a": 1.0, "colour": "red"})
    assert model.coef == before


def test_works_in_a_pipeline():
    pipeline = preprocessing.StandardScaler() | TrackedRegressor(RLS(0.98))
    alone = linear_model.LinearRegression()
    errors = [evaluate.progressive_val_score(samples(400), model, metrics.RMSE()).get() for model in (pipeline, alone)]
    assert errors[0] < 0.7 * errors[1]


def test_predictions_are_those_of_live():
    model, live = TrackedRegressor(Kalman(q=1e-3, r=0.01)), Live(Regression(2, intercept=True), Kalman(q=1e-3, r=0.01))
    for i, (x, y) in enumerate(samples()):
        expected = live.predict([x["a"], x["b"]])[0]
        if i >= 15:  # before that, predictions are clipped
            assert model.predict_one(x) == expected
        model.learn_one(x, y)
        live.update(y, [x["a"], x["b"]])
    assert list(model.coef.values()) == list(live.theta[:2])
    assert list(model.coef) == ["a", "b"]
    assert list(model.coef_std.values()) == list(live.std[:2])
    assert model.intercept == live.theta[2]


def test_a_feature_that_appears_late_was_zero_before():
    late, given = TrackedRegressor(RLS(0.99)), TrackedRegressor(RLS(0.99))
    rng = np.random.default_rng(1)
    for t in range(150):
        a, b, c = rng.normal(size=3)
        x = {"a": a, "b": b} if t < 50 else {"a": a, "b": b, "c": c}
        y = a + 2 * b + 3 * x.get("c", 0.0)
        late.learn_one(x, y)
        given.learn_one({"c": 0.0} | x, y)
    assert late.coef == pytest.approx({"a": 1.0, "b": 2.0, "c": 3.0}, abs=1e-6)
    assert late.coef == pytest.approx(given.coef, abs=1e-6)


def test_missing_values_are_not_used_and_do_not_poison():
    model = TrackedRegressor(RLS(1.0))
    for i, (x, y) in enumerate(samples(60)):
        model.learn_one(x if i % 7 else x | {"a": None}, y if i % 5 else math.nan)
    assert model.coef == pytest.approx({"a": 2.0, "b": -1.0}, abs=0.1)
    assert model.predict_one({"a": None, "b": 1.0}) == 0.0


def test_river_counts_the_state_and_the_samples_that_are_kept():
    """And neither the compiled code nor the library, which all models share; copies and pickles go on as they are."""
    short, long = TrackedRegressor(Kalman(q=1e-3, r=0.01), window=20), TrackedRegressor(Kalman(q=1e-3, r=0.01))
    for x, y in samples(100):
        short.learn_one(x, y)
        long.learn_one(x, y)
    assert 3_000 < short._raw_memory_usage < long._raw_memory_usage < 200_000
    others = [copy.deepcopy(short), pickle.loads(pickle.dumps(short))]
    for other in others:
        assert other._raw_memory_usage == pytest.approx(short._raw_memory_usage, rel=0.1)
        other.learn_one({"a": 1.0, "b": 1.0}, 9.0)
        assert other.coef != short.coef  # nothing is shared
    short.learn_one({"a": 1.0, "b": 1.0}, 9.0)
    for x, y in samples(20, seed=1):
        assert {other.predict_one(x) for other in others} == {short.predict_one(x)}
        for model in (short, *others):
            model.learn_one(x, y)
