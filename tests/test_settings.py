"""Wrong settings raise at construction or when a run begins: what was passed, the rule, the way out."""

import re

import numpy as np
import pytest
from contract_table import model_of

from driftfit import ARX, RLS, AugmentedFLS, Kalman, Live, Regression, track
from driftfit.trackers import found

ONES = np.ones(10)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: Kalman(q=-1.0, r=1.0), ["Kalman", "q", "at least 0", "-1.0"]),
        (lambda: Kalman(q=[0.1, -0.2], r=1.0), ["q", "at least 0", "-0.2"]),
        (lambda: Kalman(q=np.nan, r=1.0), ["q", "finite", "nan"]),
        (lambda: Kalman(q="fast", r=1.0), ["q", "numeric", "'fast'"]),
        (lambda: Kalman(q=np.ones((2, 3)), r=1.0), ["q", "square", "(2, 3)"]),
        (lambda: Kalman(q=np.ones((2, 2, 2)), r=1.0), ["q", "3 axes", "at most 2"]),
        (lambda: Kalman(q=[[1.0, 0.5], [0.2, 1.0]], r=1.0), ["q", "symmetric"]),
        (lambda: Kalman(q=[[1.0, 2.0], [2.0, 1.0]], r=1.0), ["q", "positive semi-definite", "eigenvalue -1"]),
        (lambda: Kalman(q=[[1.0, np.inf], [np.inf, 1.0]], r=1.0), ["q", "finite"]),
        (lambda: Kalman(q=0.1, r=0.0), ["r", "above 0", "0.0"]),
        (lambda: Kalman(q=0.1, r=[1.0, 2.0]), ["r", "1 axes", "at most 0"]),
        (lambda: Kalman(q=0.1, r=1.0, p0=-1.0), ["p0", "at least 0", "-1.0"]),
        (lambda: Kalman(q=0.1, r=1.0, theta0=np.inf), ["theta0", "finite", "inf"]),
        (lambda: Kalman(q=0.1, r=1.0, theta0=np.eye(2)), ["theta0", "2 axes", "at most 1"]),
        (lambda: RLS(0.0), ["RLS", "forgetting", "above 0", "0.0"]),
        (lambda: RLS(1.01), ["forgetting", "(0, 1]", "1.01"]),
        (lambda: RLS(0.9, c_max=0.5), ["c_max", "at least 1", "0.5"]),
        (lambda: RLS(0.9, p0=[[1.0, 2.0], [2.0, 1.0]]), ["p0", "positive semi-definite"]),
        (lambda: AugmentedFLS(mu=0.0), ["AugmentedFLS", "mu", "above 0", "0.0"]),
        (lambda: AugmentedFLS(mu=np.inf), ["mu", "finite", "inf"]),
        (lambda: AugmentedFLS(1.0, alpha=2.0), ["alpha", "(0, 2)", "2.0"]),
        (lambda: ARX(-1, 1), ["ARX", "na", "at least 0", "-1"]),
        (lambda: ARX(1.5, 1), ["na", "whole number", "1.5"]),
        (lambda: ARX(True, 1), ["na", "whole number", "True"]),
        (lambda: ARX(1, -1), ["nb", "at least 0", "-1"]),
        (lambda: ARX(1, [1, 1.5]), ["nb", "whole number", "1.5"]),
        (lambda: ARX(1, 1, nk=-1), ["nk", "at least 0", "-1"]),
        (lambda: ARX(1, [1, 1], nk=[1, 1, 1]), ["nb=(1, 1)", "nk=(1, 1, 1)", "different numbers of inputs"]),
        (lambda: ARX(1, [1, 1], inputs=["flow"]), ["inputs=('flow',)", "different numbers of inputs"]),
        (lambda: ARX(1, 1, inputs=-1), ["inputs", "at least 0", "-1"]),
        (lambda: ARX(1, 1, start="cold"), ["start", "'drop', 'zero'", "'cold'"]),
        (lambda: ARX(0, 0), ["nothing to estimate", "na=0", "nb=0"]),
        (lambda: Regression(0), ["Regression", "nothing to estimate"]),
        (lambda: Regression(-2), ["regressors", "at least 0", "-2"]),
        (lambda: Live(Regression(), RLS(0.9)), ["the number of regressors", "Regression(3)"]),
    ],
)
def test_wrong_settings_are_named(build, message):
    with pytest.raises(ValueError) as error:
        build()
    for word in message:
        assert word in str(error.value)


@pytest.mark.parametrize("kind", list(found().values()), ids=list(found()))
def test_missing_settings_are_named_with_the_way_to_give_them(kind):
    model = model_of(kind, ARX(2, 2))
    for run in (lambda: track(model, kind(), ONES, ONES), lambda: Live(model, kind())):
        if kind.required:
            way_out = f"{kind.__name__}({', '.join(f'{name}=...' for name in kind.required)})"
            with pytest.raises(ValueError, match=re.escape(way_out)):
                run()
        else:
            run()


@pytest.mark.parametrize("kind", list(found().values()), ids=list(found()))
def test_settings_are_frozen_and_compared_by_value(kind):
    one, two = kind(), kind()
    assert one == two
    assert hash(one) == hash(two)
    for name in one.settings():
        with pytest.raises(AttributeError):
            setattr(one, name, 1.0)


def test_arrays_are_taken_as_values():
    """What is done to an array after it was given changes nothing."""
    q = np.array([0.1, 0.2])
    tracker = Kalman(q=q, r=1.0)
    q[0] = 9.0
    assert tracker.q == (0.1, 0.2)
    assert tracker == Kalman(q=[0.1, 0.2], r=1)


@pytest.mark.parametrize(
    ("setting", "shape"), [({"q": [0.1, 0.2, 0.3]}, "(3,)"), ({"p0": np.eye(3)}, "(3, 3)"), ({"theta0": [1.0]}, "(1,)")]
)
def test_settings_that_do_not_fit_the_model_name_both_sizes(setting, shape):
    tracker = Kalman(**({"q": 0.1, "r": 1.0} | setting))
    with pytest.raises(ValueError, match=re.escape(shape)) as error:
        Live(ARX(1, 1), tracker)
    assert "the model has 2 parameters" in str(error.value)


@pytest.mark.parametrize(
    ("model", "names"),
    [
        (ARX(2, 1), ("a1", "a2", "b1")),
        (ARX(1, [1, 2], intercept=True), ("a1", "b1[u1]", "b1[u2]", "b2[u2]", "intercept")),
        (ARX(1, 2, inputs=["flow"]), ("a1", "b1[flow]", "b2[flow]")),
        (ARX(1, 1, inputs="flow"), ("a1", "b1[flow]")),
        (ARX(2, 0), ("a1", "a2")),
        (ARX(0, 2, nk=0), ("b1", "b2")),
        (Regression(2), ("theta1", "theta2")),
        (Regression(["income", "rate"], intercept=True), ("income", "rate", "intercept")),
        (Regression("income"), ("income",)),
    ],
)
def test_names_of_parameters(model, names):
    assert model.names == names
    assert model.n == len(names)


def test_whole_numbers_of_numpy_are_whole_numbers():
    assert ARX(np.int64(2), np.int32(1), inputs=np.int64(1)) == ARX(2, 1, inputs=1)
    assert ARX(1, np.array([1, 2]), nk=np.array([0, 1])) == ARX(1, [1, 2], nk=[0, 1])
    assert Regression(np.int64(3)) == Regression(3)


def test_binding_names_and_counts():
    assert ARX(1, 1).bind(3).m == 3
    assert ARX(1, 1).bind(["flow", "head"]).names == ("a1", "b1[flow]", "b1[head]")
    assert ARX(1, 1, inputs=2).bind(["flow", "head"]).names == ("a1", "b1[flow]", "b1[head]")
    assert Regression().bind(2) == Regression(2)
    assert Regression(2).bind(["flow", "head"]) == Regression(["flow", "head"])


def test_polynomials_carry_the_other_sign():
    A, B = ARX(2, [2, 1], nk=[1, 0]).polynomials(np.array([[1.2, -0.5, 1.0, 0.4, 3.0]]))
    assert A.tolist() == [[1.0, -1.2, 0.5]]
    assert [b.tolist() for b in B] == [[[0.0, 1.0, 0.4]], [[3.0]]]
    run = track(Regression(1), RLS(1.0), ONES, ONES)
    with pytest.raises(ValueError, match="Regression has no polynomials"):
        run.polynomials()
