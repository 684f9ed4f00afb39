"""Structures of different sizes in one compiled driver: parameters that are known to be 0 and never excited.

A driver is compiled for one number of parameters. A structure of n parameters runs in a driver for N > n if the last
N - n regressors are 0 in all samples and their parameters are known: with a 1 on the diagonal of the square root of
information S they count as determined, and with zeros in all their other entries every sum over parameters gains terms
that are 0. Results are those of n parameters, bit for bit; the cost is that of N.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from driftfit.trackers.base import Tracker

SIZES = (6, 12, 24)
"""Numbers of parameters of shared drivers, so that a search meets few of them."""
WORK = 5e7
"""Samples of all structures times the square of the size, up to which a driver of that size saves time: some seconds of
`AdaptiveKalman`, as long as compiling another driver takes."""


def size_of(sizes: Sequence[int], most: int, samples: int) -> int:
    """The size of a driver for structures of these sizes, at most ``most``; 0 if each should have its own.

    ``samples`` is the number of samples of each.
    """
    size = min(next((size for size in SIZES if size >= max(sizes)), most), most)
    return size if len(sizes) * samples * size * size <= WORK else 0


def fits(tracker: Tracker, n: int, N: int) -> bool:
    """Whether the state of a tracker of n parameters has room in that of N: `AdaptiveKalman` has filters for single
    parameters if they are few.
    """
    small, large = tracker.state(n), tracker.state(N)
    pairs = [pair for name in large for pair in zip(np.shape(small[name]), np.shape(large[name]), strict=True)]
    return n <= N and all(own <= wide for own, wide in pairs)


def padded(tracker: Tracker, n: int, N: int) -> Mapping[str, Any]:
    """The state of a tracker of N parameters, of which those after the first n are known to be 0."""
    small, large = tracker.state(n), tracker.state(N)
    state = {name: _embedded(np.asarray(small[name]), np.array(value)) for name, value in large.items()}
    if "S" in state:
        absent = np.arange(n, N)
        state["S"][absent, absent] = 1.0
        state["absent"] = np.array(N - n if state["rank"] < N else 0)
        state["rank"] = state["rank"] + state["absent"]
    return state


def _embedded(small: Any, large: Any) -> Any:
    """The large array with the small one as its beginning along each axis."""
    large[tuple(slice(size) for size in small.shape)] = small
    return large


def places(name: str, own: tuple[int, ...], wide: tuple[int, ...], absent: int) -> Any:
    """Which entries (..) of a wide field of shape ``wide`` are those of the field of shape ``own``, both without lanes.

    They are the first along each axis, except factors of the likelihood, which are stored from the rank before the
    first sample on.
    """
    axes = [np.arange(size) for size in own]
    if name == "F":
        axes[0] += absent
    return np.arange(np.prod(wide, dtype=int)).reshape(wide)[np.ix_(*axes)]
