"""Structures: the loglik of a candidate is that of its own run, the right one is found, averages are the recursion."""

import numpy as np
import pytest
from scipy import stats
from support import arx_record, damaged

from benchmarks import select_orders
from driftfit import ARX, AdaptiveKalman, AugmentedFLS, Kalman, Regression, grid, select, track
from driftfit.models.base import Implicit, Model
from driftfit.models.hammerstein_wiener.basis import Polynomial
from driftfit.models.hammerstein_wiener.model import HammersteinWiener

K = Kalman(q=1e-4, r=0.01)
ORDERS = grid(ARX, na=[1, 2], nb=[1, 2])


@pytest.fixture(scope="module")
def record():
    return arx_record(500, 3)


@pytest.fixture(scope="module")
def selection(record):
    return select(ORDERS, *record, tracker=K)


def terms(run):
    return stats.norm.logpdf(run.innovation, scale=run.innovation_std)


def test_loglik_is_that_of_a_run_of_the_model_itself(record, selection):
    assert selection.scored == 400
    for row in selection.rows:
        run = track(selection.model(row.name), K, *record)
        # shorter lags of their own would let a structure begin a sample earlier
        learned = 0.5 * row.n * np.log(100.0)  # in the samples that are not scored
        assert row.loglik == pytest.approx(np.sum(terms(run)[100:]) - learned, rel=1e-4)
        assert row.rms == pytest.approx(np.sqrt(np.mean(run.innovation[100:] ** 2)), rel=1e-4)
        assert row.n == run.model.n


def test_the_true_structure_is_found(selection):
    assert selection.model() == ARX(2, 2, inputs=1)
    assert selection.model(selection.simplest).n == 4
    assert selection.rows[0].below == 0.0
    assert all(a.loglik >= b.loglik for a, b in zip(selection.rows, selection.rows[1:], strict=False))
    assert selection.regressors() == ("a1", "a2", "b1", "b2")


def test_useless_lags_are_within_the_error_and_not_the_simplest():
    y, u = arx_record(400, 6, theta=[0.8, 0.0, 1.0, 0.0])
    selection = select(ORDERS, y, u, tracker=K)
    assert selection.model(selection.simplest).n == 2
    assert max(row.below for row in selection.rows) < 25.0


def test_delay_is_found_and_structures_share_their_samples():
    y, u = arx_record(400, 5)
    moved = np.concatenate([[np.nan] * 2, y[:-2]])  # an output that was recorded two samples late
    selection = select(grid(ARX, na=2, nb=2, nk=[1, 2, 3]), moved, u, tracker=K)
    assert selection.model().nk == 3


def test_subsets_are_all_up_to_five_and_a_search_beyond():
    rng = np.random.default_rng(0)
    u = rng.normal(size=(300, 7))
    y = u[:, 1] - 0.5 * u[:, 2] + 0.3 * rng.normal(size=300)
    calm = Kalman(q=1e-6, r=0.09)
    few = select(Regression(["a", "b", "c"]), y, u[:, :3], tracker=calm)
    assert len(few.rows) == 7
    assert set(few.regressors(few.simplest)) == {"b", "c"}
    with pytest.raises(ValueError, match="not a model by itself"):
        few.model()
    kept = select(Regression(["a", "b", "c"]), y, u[:, :3], tracker=calm, keep=["a"], most=2)
    assert {row.name for row in kept.rows} == {"a", "a b", "a c"}
    many = select(Regression(7), y, u, tracker=calm, most=3)
    assert {"theta2", "theta3"} <= set(many.regressors())
    assert len(many.rows) < 7 + 6 + 5 + 4
    assert max(row.n for row in many.rows) <= 3


def test_average_is_the_recursion_written_out(selection):
    got = selection.average(0.95)
    order = [s.name for s in selection.structures]
    w = np.full(len(order), 1.0 / len(order))
    y = selection.pool.y
    for t in range(len(y)):
        raised = w**0.95
        raised /= raised.sum()
        assert got.weights[t] == pytest.approx(raised, abs=1e-9)
        likelihood = np.exp([p.loglik[t] for p in selection.predictions])
        if np.isfinite(likelihood).all():
            w = np.maximum(raised * likelihood / np.sum(raised * likelihood), 1e-300)
    t = 300
    y_k = np.array([p.y_hat[t] for p in selection.predictions])
    s_k = np.array([p.s[t] for p in selection.predictions])
    mean = got.weights[t] @ y_k
    assert got.y_hat[t] == pytest.approx(mean)
    assert got.std[t] ** 2 == pytest.approx(got.weights[t] @ (s_k + (y_k - mean) ** 2))
    assert got.inclusion[t, 0] == pytest.approx(1.0)
    assert got.rms == pytest.approx(np.sqrt(np.mean((y - got.y_hat)[selection.judged] ** 2)))


def test_an_average_forgets_nothing_over_missing_samples(record):
    """Weights after an outage are those before it; they continue once outputs are observed again."""
    y, u = record[0].copy(), record[1]
    y[200:260] = np.nan
    got = select(ORDERS, y, u, tracker=K).average(0.9)
    assert got.weights[259] == pytest.approx(got.weights[200], abs=1e-12)
    assert got.weights[201:260] == pytest.approx(np.tile(got.weights[200], (59, 1)), abs=1e-12)
    assert np.abs(got.weights[262:300] - got.weights[200]).max() > 1e-6


def test_average_follows_a_change_of_structure():
    rng = np.random.default_rng(4)
    u = rng.normal(size=(600, 2))
    y = np.where(np.arange(600) < 300, u[:, 0], u[:, 1]) + 0.2 * rng.normal(size=600)
    both = select(Regression(["first", "second"]), y, u, tracker=Kalman(q=1e-5, r=0.04)).average(0.9)
    first, second = (both.inclusion[:, both.regressors.index(name)] for name in ("first", "second"))
    assert first[280] > 0.9
    assert second[280] < 0.6
    assert second[580] > 0.9


def test_a_model_that_is_no_set_of_columns_runs_by_itself(record):
    class Bent(Regression, Implicit):
        """A regression that claims a Jacobian, so that it is none of the known kinds."""

        outputs, implicit = ("y",), property(lambda self: self)

        def output_slope(self, theta, y):
            return np.full(len(y), np.exp(0.25))

    y, u = record
    models: list[Model] = [Regression(1), Bent(1)]
    selection = select(models, y, u, tracker=K)
    plain, bent = (next(row for row in selection.rows if row.name.startswith(name)) for name in ("Regression", "Bent"))
    assert bent.loglik - plain.loglik == pytest.approx(0.25 * selection.scored)


def test_damaged_records_and_the_table(selection):
    y, u = damaged(*arx_record(500, 3))
    assert select(ORDERS, y, u, tracker=K).model().n == 4
    assert selection.table["name"].to_list() == [row.name for row in selection.rows]
    assert selection.table["below"].to_list() == sorted(row.below for row in selection.rows)
    lines = str(selection).splitlines()
    shown = [line for line in lines if line.startswith(" ARX(")]
    assert [float(line.split()[-3]) for line in shown[:4]] == pytest.approx(
        [row.below for row in selection.rows], abs=0.06
    )
    assert f" best: {selection.best}" in lines
    distances, losses = selection.plot(4).axes
    assert distances.lines[0].get_xdata() == pytest.approx([-row.below for row in selection.rows[:4]])
    drawn = {line.get_label(): line.get_ydata()[-1] for line in losses.lines[:3]}
    order = {
        one.name: found.loglik[selection.judged].sum()
        for one, found in zip(selection.structures, selection.predictions, strict=True)
    }
    assert drawn == pytest.approx({row.name: order[row.name] - order[selection.best] for row in selection.rows[1:4]})


def test_wrong_settings(record, selection):
    u = np.random.default_rng(0).normal(size=(80, 31))
    for models, match in (([], "no candidate"), (Regression(31), "at most 30")):
        with pytest.raises(ValueError, match=match):
            select(models, u[:, 0], u, tracker=K)
    with pytest.raises(ValueError, match="no variance"):
        select(ORDERS, *record, tracker=AugmentedFLS(mu=1.0))
    with pytest.raises(ValueError, match="no regressor"):
        select(ARX(2, 2), *record, tracker=K, keep=["a9"])
    with pytest.raises(ValueError, match="forgetting"):
        selection.average(1.5)
    with pytest.raises(ValueError, match="no structure"):
        selection.model("ARX(9)")
    with pytest.raises(ValueError, match="grid"):
        grid(ARX, na=[-1])
    assert len(grid(ARX, na=[0, 1], nb=[0, 1])) == 3


def test_orders_and_basis_of_a_hammerstein_wiener_model():
    """The open problem of choosing na, nb and the basis: the true ones are found."""
    rng = np.random.default_rng(1)
    u = rng.uniform(-1.5, 1.5, 400)
    w, v = np.zeros(400), u + 0.5 * u**2
    for t in range(1, 400):
        w[t] = 0.5 * w[t - 1] + v[t - 1] + 0.02 * rng.normal()
    candidates = grid(HammersteinWiener, na=1, nb=1, inputs=1, input=[None, Polynomial(2), Polynomial(3)])
    selection = select(candidates, w, u, tracker=Kalman(q=1e-8, r=4e-4))
    assert selection.model().input == Polynomial(2)
    run = track(selection.model(), Kalman(q=1e-8, r=4e-4), w, u)
    shared = selection.predictions[candidates.index(selection.model())]  # in a driver that all candidates share
    np.testing.assert_array_equal(shared.y_hat, run.prediction)
    np.testing.assert_array_equal(shared.loglik, run.log_density)
    w[4] = np.nan
    run = track(selection.model(), Kalman(q=1e-8, r=4e-4), w, u)
    assert not run.verdict().drifts
    assert run.verdict().rms == pytest.approx(0.02, rel=3.3 / np.sqrt(2.0 * 350))  # of 350 residuals


def test_few_and_many_parameters_with_the_default_tracker(record):
    """Of few parameters each has a filter in which it drifts alone; these have no room in the record of many."""
    y, u = record
    plants = [ARX(1, 1), ARX(2, 5), ARX(6, 4)]
    selection = select(plants, y, u)
    for row in selection.rows:
        run = track(selection.model(row.name), AdaptiveKalman(), y, u)
        assert row.rms == pytest.approx(
            np.sqrt(np.mean(run.innovation[100:] ** 2)), rel=0.05
        )  # lags of its own begin earlier
    orders = ((1, 1, None), (2, 1, None), (3, 2, Polynomial(3)))
    blocks = [HammersteinWiener(na=na, nb=nb, input=f, output=Polynomial(2)) for na, nb, f in orders]
    selection = select(blocks, y, u)
    for model, found in zip(blocks, selection.predictions, strict=True):
        np.testing.assert_array_equal(found.y_hat, track(model, AdaptiveKalman(), y, u).prediction)


@pytest.mark.parametrize("level", [5.0, np.nan])
def test_a_record_that_compares_nothing_says_so(level):
    """A sensor that stands still, and one that is missing."""
    selection = select(ARX(2, 2), np.full(300, level), np.random.default_rng(0).normal(size=300))
    assert "nothing can be compared" in str(selection)
    assert selection.simplest in {row.name for row in selection.rows}


class Lagged(Regression):
    """A regression of the user's own on the last input and output."""

    n, names, terms = 2, ("a", "b"), (("u", 0, 1), ("y", 0, 1))


def test_a_regression_of_the_users_own_may_have_lags():
    y, u = arx_record(300)
    found = select([Lagged(1), ARX(1, 1)], y, u, tracker=Kalman(q=0.0, r=0.01))
    assert found.rows[0].loglik == pytest.approx(found.rows[1].loglik)


def test_the_default_tracker_finds_orders():
    y, u = select_orders.record(np.random.default_rng(54), 300, False, False)
    assert select(select_orders.CANDIDATES, y, u).best == select_orders.TRUTH
