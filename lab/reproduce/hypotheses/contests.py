"""The trackers and the records: the settings of every row of the tables."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from driftfit.bank.bank import Bank
from driftfit.bank.change import Change
from driftfit.bank.reduction import GPB, IMM, Beam, Decide, FirstFloor, Hybrid, Reduction
from driftfit.bank.results.results import Hypotheses
from driftfit.bank.sensor import Sensor
from driftfit.engine.kernel import Array
from driftfit.trackers.base import Tracker
from driftfit.trackers.kalman import Kalman
from driftfit.trackers.rls import RLS
from lab.jumps import Jumping
from lab.reproduce.hypotheses.references import Row, references
from lab.reproduce.hypotheses.rivals import tuned

R = 0.09
P0 = 2.0
DRIFTING = Change(0.002**2, prob=0.99, name="drift")
CHANGES = (DRIFTING, Change(0.6, prob=0.006, name="all"), Change([1e-6, 1e-6, 1.5], prob=0.004, name="gain"))
REGIMES = ((0.99, 0.01), (0.025, 0.975))
STATIONARY = 0.01 / 0.035
OK = Sensor.nominal(R)
OUTLIER = Sensor.outlier(10.0, plus=True)
SPIKE = Sensor.outlier(10.0, "additive", plus=True)
WIDTH = float(np.sqrt(2.0 * np.pi * 4e-6))
FROZEN = Sensor.frozen(WIDTH, prob=0.06)
FREEZES = (None, ((0.996, 0.004), (1.0 / 15.0, 14.0 / 15.0)))
FREEZES_OR_OUTLIERS = (
    None,
    ((0.976, 0.02, 0.004), (0.976, 0.02, 0.004), (0.98 / 15.0, 0.02 / 15.0, 14.0 / 15.0)),
)


Alarm = Callable[[Hypotheses], Array]
"""(T,) bool: whether a bank calls a change after each sample."""


def likeliest(lag: int) -> Alarm:
    """Samples at which a change is likelier than none, given ``lag`` more levels."""

    def on(found: Hypotheses) -> Array:
        p = np.nan_to_num(found.lag_prob[:, lag]).reshape(len(found.run), -1, found.sensors).sum(axis=2)
        return np.asarray(p.argmax(axis=1) > 0)

    return on


def decided(found: Hypotheses) -> Array:
    """When a change is decided."""
    on = np.zeros(len(found.run), bool)
    on[[d.decided for d in found.decisions if d.event >= found.sensors]] = True
    return on


def window(threshold: float) -> Alarm:
    """While the probability of a change in the window passes a threshold."""
    return lambda found: np.asarray(found.window > threshold)


class Entry(NamedTuple):
    """A row of a table: a tracker, when it reports a change, and its view of the record."""

    tracker: Tracker
    alarm: Alarm | None = None
    literal: bool = False
    """Regressors of outputs as measured: no leaf cleans them."""
    prior: Callable[[Jumping], Array] | None = None
    """Probabilities of events that it is given."""


class Contest(NamedTuple):
    """A table: records, and who runs on them."""

    title: str
    fault: str
    K: float
    runs: int
    T: int
    offset: int
    build: Callable[[], dict[str, Entry]]
    table: str
    """Its name among the reference values."""
    against: int = 60
    """Records behind the reference values."""

    @property
    def entries(self) -> dict[str, Entry]:
        """Its rows."""
        return self.build()

    @property
    def reference(self) -> dict[str, Row]:
        """The reference values of its rows."""
        return references(self.table)


def bank(
    reduce: Reduction, *others: Sensor, transition: Any = None, changes: Any = CHANGES, uncertain: bool = False
) -> Bank:
    """A bank with known noise; the reference takes output lags that leaves predicted for certain."""
    return Bank(changes, (OK, *others), transition, reduce, p0=P0, lag_variance=uncertain)


def kalman(q: Any = (0.004, 0.004, 0.04), r: float = R) -> Entry:
    return Entry(Kalman(q, r, p0=P0))


def decide(d: int, *others: Sensor, literal: bool = False, **more: Any) -> Entry:
    loss = more.pop("loss", "map")
    return Entry(bank(Decide(d, loss, force=True), *others, **more), decided, literal)


def gpb(n: int, *others: Sensor, literal: bool = False, **more: Any) -> Entry:
    return Entry(bank(GPB(n), *others, **more), likeliest(n - 1), literal)


def beam(M: int, *others: Sensor, **more: Any) -> Entry:
    return Entry(bank(Beam(M), *others, **more), likeliest(3))


def hybrid(M: int, *others: Sensor) -> Entry:
    return Entry(bank(Hybrid(M, remembered=5), *others), window(0.5))


def imm(*others: Sensor, literal: bool = False, **more: Any) -> Entry:
    return Entry(bank(IMM(), *others, **more), likeliest(0), literal)


def oracle(*others: Sensor, changes: Any = CHANGES) -> Entry:
    """A filter that is given every event."""
    Hm = 1 + len(others)

    def events(record: Jumping) -> Array:
        prior = np.zeros((len(record.y), len(changes) * Hm))
        prior[np.arange(len(prior)), record.kinds * Hm + (record.bad if others else 0)] = 1.0
        return prior

    return Entry(bank(GPB(1), *others, changes=changes), prior=events)


def loss_of(miss: float) -> tuple[tuple[float, ...], ...]:
    """L[true, decided] of the changes: ``miss`` for a jump that is called none, 1 for other errors."""
    return ((0.0, 1.0, 1.0), (miss, 0.0, 1.0), (miss, 1.0, 0.0))


def joint_loss(miss: float) -> tuple[tuple[float, ...], ...]:
    """The same for changes with two sensors, whose confusion costs 1."""
    wide = np.kron(np.array(loss_of(miss)), np.ones((2, 2)))
    return tuple(map(tuple, np.where((wide == 0.0) & (np.eye(6) == 0.0), 1.0, wide).tolist()))


def auto(tau: float, cost: float | None = None, loss: Any = "map") -> Entry:
    return Entry(bank(Decide("auto", loss, max_depth=6, tau=tau, wait_cost=cost)), decided)


def contests() -> list[Contest]:
    """All tables."""
    return [
        Contest("Clean", "none", 10.0, 300, 600, 0, clean, "clean", 100),
        Contest("5 % innovation outliers of ten sigma", "innovation", 10.0, 300, 600, 2000, outliers, "outliers"),
        Contest("The same, merging and a beam", "innovation", 10.0, 300, 400, 2000, mixed, "hybrid", 50),
        Contest("5 % additive outliers", "additive", 10.0, 300, 600, 3000, additive, "additive"),
        Contest("Sensor frozen for 5 % of the time", "frozen", 10.0, 300, 600, 4000, frozen, "frozen"),
        Contest("Regimes of fast drift that persist", "regimes", 10.0, 300, 600, 5000, persistent, "regimes"),
        Contest("Variable depth", "none", 10.0, 300, 400, 0, variable, "variable", 50),
        Contest("Alarms", "none", 10.0, 300, 600, 0, alarming, "alarms", 100),
    ]  # fmt: skip


def rls(fault: str, offset: int) -> dict[str, Entry]:
    """Recursive least squares, tuned on other records of the kind."""
    tracker = tuned(fault, offset)
    return {f"RLS-EF {tracker.forgetting:g}": Entry(tracker)}


@cache
def clean() -> dict[str, Entry]:
    mean = np.einsum("i,ijk->jk", [0.99, 0.006, 0.004], [change.increments(3)[0] for change in CHANGES])
    return {
        "RLS-EF 0.75": Entry(RLS(0.75, p0=P0 / R)), "RLS-DF 0.4": Entry(RLS(0.4, p0=P0 / R, kind="directional")),
        "KF diag(.004,.004,.04)": kalman(), "KF Qbar=sum p_i Q_i (untuned)": kalman(mean),
        **{f"Decide d={d}": decide(d) for d in range(1, 7)},
        "FirstFloor posterior d=2": Entry(bank(FirstFloor(2)), likeliest(1)),
        **{f"GPB({n})": gpb(n) for n in range(1, 5)}, "IMM": imm(),
        **{f"Beam M={M}": beam(M) for M in (3, 5, 9)}, "oracle (events known)": oracle(),
        "Bank(), nothing given": Entry(Bank(), likeliest(3)),
        **{f"Decide d=2, a miss costs {miss:g}": decide(2, loss=loss_of(miss)) for miss in (3.0, 10.0, 30.0, 100.0)},
    }  # fmt: skip


@cache
def outliers() -> dict[str, Entry]:
    return {
        **rls("innovation", 2500), "KF tuned Q, r": kalman((0.002, 0.002, 0.02), 4.0 * R),
        "Decide d=2, no sensor alternative": decide(2),
        "GPB(2), no sensor alternative": gpb(2), "IMM joint": imm(OUTLIER),
        **{f"joint Decide d={d}": decide(d, OUTLIER) for d in range(1, 5)},
        "joint Decide d=2 asym jump-miss=5": decide(2, OUTLIER, loss=joint_loss(5.0)),
        "GPB(2) joint": gpb(2, OUTLIER), "GPB(3) joint": gpb(3, OUTLIER),
        "joint Beam M=5": beam(5, OUTLIER), "joint Beam M=32": beam(32, OUTLIER), "oracle": oracle(OUTLIER),
    }  # fmt: skip


@cache
def mixed() -> dict[str, Entry]:
    return {
        **rls("innovation", 2500), "KF tuned Q, r": kalman((0.002, 0.002, 0.02), 4.0 * R),
        "GPB(2) joint": gpb(2, OUTLIER), "Beam 16": beam(16, OUTLIER),
        "Hybrid M=9": hybrid(9, OUTLIER), "Hybrid M=16": hybrid(16, OUTLIER),
        "joint Decide d=3": decide(3, OUTLIER), "GPB(3) joint": gpb(3, OUTLIER), "IMM joint": imm(OUTLIER),
        "oracle": oracle(OUTLIER),
    }  # fmt: skip


@cache
def additive() -> dict[str, Entry]:
    return {
        **rls("additive", 3500), "KF diag(.004,.004,.04)": kalman(),
        "KF Q/4, 12r": kalman((0.001, 0.001, 0.01), 12.0 * R),
        "IMM joint, leaf-cleaned": imm(SPIKE), "GPB(2), no sensor alternative": gpb(2),
        "joint Decide d=2, literal (dirty regressor)": decide(2, SPIKE, literal=True),
        **{f"joint Decide d={d}, leaf-cleaned regressor": decide(d, SPIKE) for d in (2, 3, 4)},
        "GPB(2) joint, literal": gpb(2, SPIKE, literal=True), "GPB(2) joint, leaf-cleaned": gpb(2, SPIKE),
        "Beam M=16 leaf-cleaned": beam(16, SPIKE), "GPB(2) joint, uncertain lags": gpb(2, SPIKE, uncertain=True),
        "Beam M=16, uncertain lags": beam(16, SPIKE, uncertain=True),
        "IMM joint, uncertain lags": imm(SPIKE, uncertain=True),
    }  # fmt: skip


@cache
def frozen() -> dict[str, Entry]:
    return {
        **rls("frozen", 4500), "KF diag(.004,.004,.04)": kalman(),
        "KF 2Q, 8r": kalman((0.008, 0.008, 0.08), 8.0 * R), "GPB(2), no sensor alternative": gpb(2),
        "Decide d=2 outlier sensor only": decide(2, SPIKE),
        "Decide d=2 ok/frozen literal (dirty regr.)": decide(2, FROZEN, transition=FREEZES, literal=True),
        "Decide d=2 ok/outl/frozen cleaned, Markov": decide(2, SPIKE, FROZEN, transition=FREEZES_OR_OUTLIERS),
        "Decide d=2 ok/frozen cleaned, Markov": decide(2, FROZEN, transition=FREEZES),
        "GPB(2) ok/frozen cleaned, Markov": gpb(2, FROZEN, transition=FREEZES),
        "Beam 9 ok/frozen cleaned, Markov": beam(9, FROZEN, transition=FREEZES),
        "IMM ok/frozen Markov": imm(FROZEN, transition=FREEZES),
        "GPB(2) ok/frozen, uncertain lags": gpb(2, FROZEN, transition=FREEZES, uncertain=True),
        "Beam 9 ok/frozen, uncertain lags": beam(9, FROZEN, transition=FREEZES, uncertain=True),
        "IMM ok/frozen, uncertain lags": imm(FROZEN, transition=FREEZES, uncertain=True),
    }  # fmt: skip


@cache
def persistent() -> dict[str, Entry]:
    moving = (Change(0.002**2, prob=1.0 - STATIONARY), Change(0.06**2, prob=STATIONARY, name="fast"))
    rows = {**rls("regimes", 5500), "KF tuned 0.001": kalman(0.001)}
    for name, transition in (("iid", None), ("Markov", REGIMES)):
        for d in (2, 7):
            rows[f"Decide d={d} {name}"] = decide(d, transition=transition, changes=moving)
        for n in (2,) if transition is None else (1, 2, 4):
            rows[f"GPB({n}) {name}"] = gpb(n, transition=transition, changes=moving)
        rows[f"IMM {name}"] = imm(transition=transition, changes=moving)
    rows["Beam 16 Markov"] = beam(16, transition=REGIMES, changes=moving)
    rows["oracle (regime known)"] = oracle(changes=moving)
    return rows


@cache
def variable() -> dict[str, Entry]:
    return {
        **rls("none", 1000), "KF diag(.004,.004,.04)": kalman(), "IMM": imm(),
        "fixed d=5": decide(5), "fixed d=3": decide(3), "threshold tau=0.02 dmax=6": auto(0.02),
        "threshold tau=0.001 dmax=6": auto(0.001), "look-ahead c=0.005 dmax=6": auto(0.0, 0.005),
        "look-ahead c=.01 dmax=6 asym10": auto(0.0, 0.01, loss_of(10.0)),
    }  # fmt: skip


@cache
def alarming() -> dict[str, Entry]:
    short = bank(Beam(9, window=3))
    return {
        "Beam(9), MAP at lag 3": beam(9), "Beam(9), window 3 > .5": Entry(short, window(0.5)),
        **{f"Beam(9), window 8 > .{p}": Entry(bank(Beam(9, window=8)), window(p / 10.0)) for p in (5, 9)},
        "IMM, MAP": imm(),
    }  # fmt: skip
