"""The first pulses of an input at rest are learned from, and a fault code among them is not."""

import numpy as np
import pytest

from driftfit import ARX, AdaptiveKalman, Regression, track

T, PLANT, SINGLE = 500, ARX(2, 2), Regression(1)


def gated(*given, **more):
    return track(*given, gate=True, **more)


FIRST = pytest.param(0, 5, marks=pytest.mark.xfail(reason="a code at the very first pulse is believed", strict=True))


@pytest.mark.parametrize(("code", "learned"), [(None, 2), FIRST, (1, 2)])
def test_the_first_pulses_of_an_input_at_rest_are_learned_from(code, learned):
    """Of two fault codes the first, at the first pulse of all, cannot be told from a response."""
    rng = np.random.default_rng(4)
    u, y = np.zeros((4, T)), 0.1 * rng.normal(size=(4, T))
    for row, height in enumerate((1.0, 10.0, 1e-3, -1.0)):
        pulses = np.arange(30 + 40 * row, T, 50)
        u[row, pulses] = height * rng.uniform(0.5, 1.5, len(pulses))
        y[row] += 5.0 * u[row] / height
        if code is not None:
            y[row, pulses[code]] = -999.0
    fleet = gated(SINGLE, AdaptiveKalman(), y, u, by="row")
    for row, height in enumerate((1.0, 10.0, 1e-3, -1.0)):
        pulses = np.flatnonzero(u[row])
        assert (~fleet[row].ok).sum() <= {None: 0, 0: 2, 1: 1}[code]
        assert fleet[row].theta[pulses[learned], 0] * height == pytest.approx(5.0, abs=0.5)
        assert fleet[row].theta[pulses[-1], 0] * height == pytest.approx(5.0, abs=0.2)
