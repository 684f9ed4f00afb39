"""Every picture can be drawn in a new figure, in axes of the user's, or in as many axes as it has panels."""

import inspect

import pytest
from every_result import U, Y, every_result
from matplotlib.figure import Figure

import driftfit
from driftfit import (
    RLS,
    Bank,
    Decide,
    Live,
    Regression,
    Sensor,
    piecewise,
    plot_tree,
)
from driftfit.show.axes import panels


@pytest.fixture(scope="module")
def pictures():
    """Every function that draws a result, by name, with the number of its panels."""
    one = every_result()
    run = one["Track"]
    deciding = Live(Regression(1), Bank(sensors=[Sensor.nominal(r=0.01)], reduce=Decide()))
    for t in range(20):
        deciding.update(Y[t], [U[t]])
    return {
        "Track.plot": (run.plot, 6),
        "Track.plot_system": (run.plot_system, 4),
        "Track.plot_validation": (lambda ax=None: run.plot_validation(Y, U, ax=ax), 2),
        "Track.plot_blocks": (one["HammersteinWiener"].plot_blocks, 6),
        "Fleet.plot": (one["Fleet"].plot, 3),
        "Outputs.plot": (one["Outputs"].plot, 6),
        "Instants.plot": (one["Instants"].plot, 3),
        "Smoothed.plot": (one["Track.smooth"].plot, 4),
        "Segments.plot": (piecewise(run, [100]).plot, 4),
        "Segmentation.plot": (one["Segmentation"].plot, 5),
        "Diagnosis.plot": (one["Track.diagnose"].plot, 6),
        "Alarms.plot": (one["detect"].plot, 4),
        "Selection.plot": (one["Selection"].plot, 2),
        "Tuned.plot": (one["Tuned"].plot, 1),
        "Frontier.plot": (one["Frontier"].plot, 2),
        "Hypotheses.plot": (one["Bank.hypotheses"].plot, 5),
        "plot_tree": (lambda ax=None: plot_tree(deciding, ax=ax), 1),
    }


def drawn(axes):
    return bool(axes.lines or axes.collections or axes.patches or axes.texts)


def test_in_a_figure_of_its_own(pictures):
    for name, (plot, count) in pictures.items():
        figure = plot()
        assert isinstance(figure, Figure), name
        assert sum(map(drawn, figure.axes)) >= count, name


def test_in_the_place_of_one_axes(pictures):
    for name, (plot, count) in pictures.items():
        figure = Figure(figsize=(12, 8))
        left, right = figure.subplots(1, 2)
        assert plot(ax=left) is figure, name
        assert not drawn(right), name
        new = [left] if count == 1 else [axes for axes in figure.axes if axes not in (left, right)]
        assert len(new) >= count, name
        for axes in new:
            assert axes.get_position().x1 <= right.get_position().x0 + 1e-6, name


def test_in_one_axes_for_each_panel(pictures):
    for name, (plot, count) in pictures.items():
        figure = Figure(figsize=(12, 30))
        given = figure.subplots(count, 1, squeeze=False)
        assert plot(ax=given) is figure, name
        assert all(map(drawn, given.ravel())), name
        if count > 1:
            with pytest.raises(ValueError, match=f"one axes, or {count} of them"):
                plot(ax=list(Figure().subplots(count + 1, 1)))


def test_axes_without_a_grid_and_nested_ones():
    figure = Figure()
    loose = figure.add_axes((0.1, 0.2, 0.3, 0.4))
    _, (above, below) = panels(loose, (1, 1), 2, sharex=True)
    assert above.get_position().y1 == pytest.approx(0.6)
    assert below.get_position().bounds[:2] == pytest.approx((0.1, 0.2))
    _, inner = panels(below, (1, 1), 4, 2)
    assert inner[-1].get_position().x1 == pytest.approx(below.get_position().x1)
    assert not below.axison


def test_a_formula_takes_axes_too():
    formula = pytest.importorskip("driftfit.bridges.formula", reason="formulaic is not installed")
    import pandas as pd

    data = pd.DataFrame({"y": Y, "u": U})
    result = formula.TimeVaryingRegression.from_formula("y ~ u - 1", data, RLS(1.0)).fit()
    axes = Figure().subplots(2, 1)
    assert result.plot_cusum(ax=axes[0]) is axes[0].figure
    assert drawn(axes[0])
    assert result.plot_coefficients(ax=axes[1]) is axes[1].figure


def test_no_picture_is_forgotten(pictures):
    """Whatever draws in the library takes ax=, and is drawn above."""
    here = {name.split(".")[-1] for name in pictures}
    classes = [one for one in vars(driftfit).values() if inspect.isclass(one)]
    for one in classes:
        for name, method in vars(one).items():
            if name.startswith("plot"):
                assert "ax" in inspect.signature(method).parameters, f"{one.__name__}.{name}"
                assert name in here, name
