"""docs/from_matlab.md: what its rows estimate is the system from which the record came."""

import re
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import cont2discrete, lfilter

import driftfit

PAGE = (Path(__file__).parent.parent / "docs" / "from_matlab.md").read_text(encoding="utf-8")
ROWS = dict(re.findall(r"^\| (`.+?) \| .+? \| `(.+)` \|$", PAGE, re.MULTILINE))
B, A = [0.0, 1.0, 0.5], [1.0, -1.2, 0.4]
"""Of the system at the top of the page."""
ARX, OE = [1.2, -0.4, 1.0, 0.5], [1.0, 0.5, 1.2, -0.4]
IN_TIME = [9.1629, 31.342, 2.186, 235.06]
"""a1, a2, b1, b2 in continuous time, for inputs that are held for 0.1."""


def record(seed, noise, size, T=400):
    """y, u with noise filtered by ``noise``, a numerator and a denominator."""
    rng = np.random.default_rng(seed)
    u = lfilter([1.0], [1.0, -0.5], rng.normal(size=T))
    return lfilter(B, A, u) + lfilter(*noise, size * rng.normal(size=T)), u


def result(row, y, u):
    """The code of a row, run on a record; a stream takes all of it."""
    names = {**vars(driftfit), "np": np, "y": y, "u": u, "model": driftfit.ARX(2, 2)}
    names["run"] = driftfit.track(names["model"], driftfit.RLS(0.99), y, u)
    found = eval(ROWS[row].removesuffix(".theta[-1]"), names)
    if isinstance(found, driftfit.Live):
        for sample in zip(y, u, strict=True):
            found.update(*sample)
        return found.theta, found.std
    return (found.theta[-1], found.std[-1]) if isinstance(found, driftfit.Track) else found


WHITE = ([1.0], [1.0])


@pytest.mark.parametrize(
    ("row", "noise", "size", "truth"),
    [
        ("`arx`", ([1.0], A), 0.05, ARX),
        ("`recursiveARX`", ([1.0], A), 0.05, ARX),
        ("`iv4`, `ivx`", WHITE, 0.5, ARX),
        ("`armax`", ([1.0, 0.6], A), 0.5, [*ARX, 0.6]),
        ("`oe`", WHITE, 0.5, OE),
        ("`recursiveOE`, `roe`", WHITE, 0.5, OE),
        ("`bj`", ([1.0, 0.5], [1.0, -0.7]), 0.3, [1.0, 0.5, 0.5, 0.7, 1.2, -0.4]),
        ("`bj`, `oe`, `armax`, iterated", ([1.0, 0.5], [1.0, -0.7]), 0.3, [1.0, 0.5, 0.5, 0.7, 1.2, -0.4]),
        ("`tfest`", WHITE, 0.05, IN_TIME),
    ],
)
def test_the_truth_is_in_the_bands(row, noise, size, truth):
    """Of twenty normal deviates or more none is above 4, and their mean square is below 1.9, with probability .99."""
    z = []
    for seed in range(5):
        theta, std = result(row, *record(seed, noise, size))
        z.append((theta - truth) / std)
    assert np.max(np.abs(z)) < 4.0
    assert np.mean(np.square(z)) < 1.9


def test_the_system_in_continuous_time_is_that_of_the_page():
    numerator, denominator, _ = cont2discrete((IN_TIME[2:], [1.0, *IN_TIME[:2]]), 0.1, method="zoh")
    np.testing.assert_allclose(numerator.ravel(), B, atol=2e-4)
    np.testing.assert_allclose(denominator, A, atol=2e-4)


@pytest.mark.parametrize(
    ("row", "read", "truth"),
    [
        ("`polydata`", lambda found: np.r_[found[0][-1], found[1][0][-1]], [*A, *B]),
        ("`pole`", lambda found: np.abs(found[-1]), np.abs(np.roots(A))),
        ("`isstable`", lambda found: found.value[-1], np.sqrt(0.4)),
        ("`zero`", lambda found: found, [-0.5]),
        ("`dcgain`", lambda found: found.value[-1], [7.5]),
        ("`step`", lambda found: np.ravel(found.value), lfilter(B, A, np.ones(20))),
        ("`impulse`", lambda found: np.ravel(found.value), lfilter(B, A, np.eye(1, 20)[0])),
        ("`d2c`, `c2d`", lambda found: found.a, np.poly(np.roots(A) ** 2)[1:]),
    ],
)
def test_the_model_that_is_shown_is_the_system(row, read, truth):
    """The noise of the record is that of the page, where all errors are below a few per cent."""
    np.testing.assert_allclose(
        read(result(row, *record(0, ([1.0], A), 0.05))), truth, atol=0.04 * np.max(np.abs(truth))
    )
