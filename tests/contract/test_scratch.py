"""Fields that a tracker declares as scratch carry nothing from one sample to the next."""

import numpy as np
import pytest
from support import arx_record, damaged

from driftfit import Live


@pytest.mark.parametrize("idle", [0, 50])
def test_scratch_carries_nothing(model, tracker, idle):
    """Also while columns are free, because the input has not moved yet."""
    y, u = damaged(*arx_record(90, 7))
    u[:idle] = 0.0
    live = Live(model, tracker)
    other = Live(model, tracker)
    for t in range(90):
        for name in set(tracker.scratch) & set(other.lane()):
            field = other.lane()[name]
            field[...] = np.nan if field.dtype.kind == "f" else -(2**40)
        steps = [one.update(y[t], u[t : t + 1]) for one in (live, other)]
        np.testing.assert_array_equal(*steps)
        assert live.to_bytes() == other.to_bytes(), t
