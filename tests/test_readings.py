"""Readings of every size, from what underflows to what overflows: finite or marked, and recovered afterwards."""

import pytest
from contract_table import model_of, ready
from readings import failures

from driftfit import ARX, RLS, AdaptiveKalman, AugmentedFLS, Kalman


@pytest.mark.parametrize(
    "tracker", [ready(Kalman), ready(Kalman, form="sqrt"), RLS(0.98), AdaptiveKalman(), ready(AugmentedFLS)], ids=repr
)
def test_no_reading_leaves_a_trace_that_is_not_a_number(tracker):
    model = model_of(tracker, ARX(2, 2).bind(1))
    found, count = failures(model, tracker, [0, 1, 2, 3, 4, 5, 7, 20], 130)
    assert count == 432
    assert not found
