"""Reductions: how the tree of a bank is kept small.

Each is a class of settings that gives the compiled code its kind and numbers, the largest number of leaves, and the
number of past levels that a leaf remembers. H is the number of joint events, H_d of changes, H_m of sensors.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from driftfit.bank.reducing import selection
from driftfit.engine.kernel import Array
from driftfit.engine.settings import Settings, numbers, one_of, plain, whole

REMEMBERED = 24
"""Number of past levels of the tree that leaves remember. Of two jumps of 1.6 standard deviations of the noise in four
hundred samples, twenty times, 25 of 40 were found with 8 levels, 37 with 16, and 40 with 24.
"""
MOST_UPDATES = 4096
"""Largest number of leaf updates per sample; a larger tree raises an error."""


class Shape(NamedTuple):
    """The requirements of a reduction on the compiled code: leaves before and after growth, levels remembered, its
    vector of settings, and the limits of the codes of joint events, sensors and changes.
    """

    parents: int
    children: int
    levels: int
    held: int
    knobs: Array
    bases: Array


class Reduction(Settings, ABC):
    """How the tree of a bank is kept small."""

    lowest: ClassVar[dict[str, int]] = {}
    """The smallest values of settings that are whole numbers."""

    def __post_init__(self) -> None:
        for name, low in self.lowest.items():
            if getattr(self, name) != "auto":
                self._set(name, whole(type(self).__name__, name, getattr(self, name), low))

    @abstractmethod
    def shape(self, Hd: int, Hm: int) -> Shape:
        """The shape for these numbers of changes and sensors."""

    def losses(self, H: int) -> Array:
        """L[true, decided]: by default the same for every error."""
        return 1.0 - np.eye(H)


def knobs(kind: int, **values: float) -> Array:
    """The vector of settings."""
    vector = np.zeros(9)
    vector[selection.KIND], vector[selection.TAU], vector[selection.WAIT] = kind, -1.0, -1.0
    for name, value in values.items():
        vector[getattr(selection, name.upper())] = value
    return vector


def tree(owner: str, H: int, depth: int, instead: str) -> int:
    """H^depth, or ValueError if a step cannot afford it."""
    if H**depth > MOST_UPDATES:
        raise ValueError(
            f"{owner}: {H} events to depth {depth} are {H**depth} leaf updates per sample, more than {MOST_UPDATES}; "
            f"{instead}."
        )
    return int(H**depth)


@dataclass(frozen=True)
class Decide(Reduction):
    """Fixed-lag Bayes decision (deferred decision, N-scan pruning): decide the oldest event, prune other branches.

    The oldest event that is still open has the marginal p; R_k = sum_e L[e, k] p_e; the k of least risk (of those with
    p_k > 0, the lowest on ties) is kept. The latency is depth - 1 used samples. Later results are conditional on the
    decision. With depth="auto" the event is decided as soon as the risk is at most ``tau``; with ``wait_cost`` c also
    if waiting for s more samples is not expected to pay, R* <= s c + E R(after s), for s from 1 to ``ahead``
    (`driftfit.bank.reducing.lookahead`). Cost: H^depth leaf updates per sample.

    Parameters
    ----------
    depth : int or "auto"
        Number of samples that are used to decide an event.
    loss : "map" or (H, H)
        L[true, decided]; "map" is 1 for every error. Asymmetric losses change the estimates too.
    max_depth, tau, wait_cost
        For "auto": the bound of the depth, the risk that is small enough, and the cost of a sample of delay.
    ahead : int
        For ``wait_cost``: how many samples ahead the rule looks. With 1 the rule decides at once if one more sample
        changes little, even if several would decide.
    force : bool
        Allow depth 1 with outliers, which always prefers "outlier" and so never adapts.
    """

    depth: Any = 3
    loss: Any = "map"
    max_depth: int = 6
    tau: float = 0.01
    wait_cost: float | None = None
    force: bool = False
    ahead: int = 1

    lowest: ClassVar[dict[str, int]] = {"depth": 1, "max_depth": 1, "ahead": 1}

    def __post_init__(self) -> None:
        super().__post_init__()
        self._set("tau", numbers("Decide", "tau", self.tau, ndim=0, low=0.0))
        if self.wait_cost is not None:
            self._set("wait_cost", numbers("Decide", "wait_cost", self.wait_cost, ndim=0, low=0.0, strict=True))
        if isinstance(self.loss, str):
            one_of("Decide", "loss", self.loss, ("map",))
        else:
            self._set("loss", plain(np.asarray(numbers("Decide", "loss", self.loss, ndim=2))))

    @property
    def deepest(self) -> int:
        """Largest number of open events."""
        return int(self.max_depth if self.depth == "auto" else self.depth)

    def shape(self, Hd: int, Hm: int) -> Shape:
        H, d = Hd * Hm, self.deepest
        children = tree("Decide", H, d, "use Beam(9) or Hybrid(9), whose cost is linear, or a smaller depth")
        auto = {} if self.depth != "auto" else {"tau": self.tau, "wait": self.wait_cost or -1.0, "ahead": self.ahead}
        vector = knobs(selection.CUT, depth=d, **auto)
        return Shape(children // H, children, d, d, vector, np.array([children * 1.0, 1, 1]))

    def losses(self, H: int) -> Array:
        if isinstance(self.loss, str):
            return super().losses(H)
        loss = np.asarray(self.loss)
        if loss.shape != (H, H):
            raise ValueError(f"Decide: loss L[true, decided] must be ({H}, {H}); got shape {loss.shape}.")
        return loss


@dataclass(frozen=True)
class GPB(Reduction):
    """Generalised pseudo-Bayes of order n: merge leaves that agree in the newest n - 1 events, matching moments.

    Cost: H^n leaf updates per sample. GPB(2) with a ``transition`` is for modes that persist.
    """

    order: int = 2
    lowest: ClassVar[dict[str, int]] = {"order": 1}

    def shape(self, Hd: int, Hm: int) -> Shape:
        children = tree("GPB", Hd * Hm, self.order, "use IMM(), or a smaller order")
        parents = children // (Hd * Hm)
        return Shape(parents, children, self.order, 1, knobs(selection.MERGE), np.array([parents * 1.0, 1, 1]))


@dataclass(frozen=True)
class IMM(Reduction):
    """Interacting multiple models (Blom and Bar-Shalom 1988): one leaf for every event, mixed before each sample.

    c_j = sum_i mu_i P_ij; leaf j continues from the mixture with weights mu_i P_ij / c_j. For independent events it is
    GPB(1). Cost: H leaf updates per sample.
    """

    def shape(self, Hd: int, Hm: int) -> Shape:
        H = tree("IMM", Hd * Hm, 1, "use fewer hypotheses")
        return Shape(H, H * Hm, 1, 1, knobs(selection.INTERACT), np.ones(3))


@dataclass(frozen=True)
class Beam(Reduction):
    """Keep the leaves with the largest weights (M-algorithm); ties go to the earlier leaf.

    ``window`` is the number of past levels that are remembered for the probabilities of events: a change that takes
    more samples to detect is not found. The dropped weight is missing from the evidence; it is reported. Cost: leaves
    times H.
    """

    leaves: int = 9
    window: int = REMEMBERED
    lowest: ClassVar[dict[str, int]] = {"leaves": 1, "window": 1}

    def shape(self, Hd: int, Hm: int) -> Shape:
        children = tree("Beam", Hd * Hm * self.leaves, 1, "use fewer leaves")
        return Shape(self.leaves, children, self.window, 1, knobs(selection.BEAM, leaves=self.leaves), np.ones(3))


@dataclass(frozen=True)
class Resample(Reduction):
    """Keep leaves at random, with weights that are right on average (optimal resampling, Fearnhead and Clifford 2003).

    Of more than ``leaves`` leaves those with w > c keep their weight, where sum min(w / c, 1) = leaves. The others get
    the weight c or none: they are lined up by the times of their last changes, and those are kept that hold a point u,
    u + c, u + 2 c, .. of the sum of their weights, u uniform in (0, c) (stratified, Fearnhead and Liu 2007). The
    expected weight of every leaf is its weight, and of all unbiased choices this one has the least sum of variances, so
    bands do not become narrower by pruning. ``seed`` and the number of the sample give u: a stream, a record and a
    fleet draw the same numbers. Cost: leaves times H.
    """

    leaves: int = 16
    window: int = REMEMBERED
    seed: int = 0
    lowest: ClassVar[dict[str, int]] = {"leaves": 1, "window": 1, "seed": 0}

    def shape(self, Hd: int, Hm: int) -> Shape:
        children = tree("Resample", Hd * Hm * self.leaves, 1, "use fewer leaves")
        vector = knobs(selection.RESAMPLE, leaves=self.leaves, seed=self.seed)
        return Shape(self.leaves, children, self.window, 1, vector, np.ones(3))


@dataclass(frozen=True)
class Hybrid(Reduction):
    """Merge leaves that agree in the changes of the window, the last sensor events and their age; then keep a beam.

    For the probabilities of events ``remembered`` levels are kept, averaged over merged leaves.

    Old sensor events are nuisance parameters and merged early, while changes are of interest and kept apart. Ages above
    ``age_cap`` count as equal. Cost: leaves times H.
    """

    leaves: int = 9
    window: int = 5
    sensor_events: int = 1
    age_cap: int = 40
    remembered: int = REMEMBERED
    lowest: ClassVar[dict[str, int]] = {"leaves": 1, "window": 1, "sensor_events": 0, "age_cap": 1, "remembered": 1}

    def shape(self, Hd: int, Hm: int) -> Shape:
        children = tree("Hybrid", Hd * Hm * self.leaves, 1, "use fewer leaves")
        bases = np.array([1.0, float(Hm) ** self.sensor_events, float(Hd) ** self.window])
        if bases.prod() * (self.age_cap + 1) > 2.0**53:
            raise ValueError(
                f"Hybrid: a window of {self.window} with {Hd} changes cannot be distinguished; use a smaller one."
            )
        vector = knobs(selection.HYBRID, leaves=self.leaves, cap=self.age_cap)
        return Shape(self.leaves, children, self.remembered, 1, vector, bases)


@dataclass(frozen=True)
class FirstFloor(Reduction):
    """Merge the mixture over the oldest event into one density and grow the tree again; for comparison only.

    weights="prior" is one Kalman filter with sum p_i Q_i; "posterior" uses the samples of the tree twice.
    """

    depth: int = 2
    weights: str = "posterior"
    lowest: ClassVar[dict[str, int]] = {"depth": 1}

    def __post_init__(self) -> None:
        super().__post_init__()
        one_of("FirstFloor", "weights", self.weights, ("posterior", "prior"))

    def shape(self, Hd: int, Hm: int) -> Shape:
        if Hm > 1:
            raise ValueError("FirstFloor: it supports one sensor only; use GPB.")
        children = tree("FirstFloor", Hd, self.depth, "use a smaller depth")
        vector = knobs(selection.REFILTER, depth=self.depth, prior=float(self.weights == "prior"))
        return Shape(children // Hd, children, self.depth, 1, vector, np.array([children * 1.0, 1, 1]))
