"""Every verdict on a paper follows from numbers: made-up ones, on either side of its rule, turn it round."""

from types import SimpleNamespace

import numpy as np
import pytest

from lab.reproduce.fls import claims as fls_claims
from lab.reproduce.fls import verdicts as fls
from lab.reproduce.hammerstein_wiener import claims as hw_claims
from lab.reproduce.hammerstein_wiener import verdicts as hw
from lab.reproduce.hypotheses import claims as banks

OTHERS, REVERSE = {"sinusoids": 0.0, "switching": 100.0, "exp-ar": 13.0}, {"sinusoids": 100.0}
MOST = dict.fromkeys(OTHERS, 90.0)
WEIGHTS = {"sinusoids": 1e-4, "rational": 6.8e4, "switching": 51.0, "exp-ar": 2.3e6}
TIMES = {"A-FLS on-line": 0.17, "T-FLS on-line": 0.22, "exact smoother": 1.1, "banded": 0.29, "dense inverse": 3720.0}
LEFT = {"sinusoids": 0.5}
METHODS = {"average": (0.0198, 0.0231), "svd": (0.02, 0.025), "svd-joint": (0.0188, 0.02), "gls": (0.0167, 0.02)}
NOISE = {"fast": 0.43, "clean": 0.011, "start": 0.39, "aware": 0.087, "output error": 0.056, "bias": 0.181}
EFFORT = {"average": 63.0, "svd": 271.0, "filter": 333.0}
ARRIVE = {0.01: (15.0, 1.0), 10.0: (15.0, 1.0), 1000.0: (16.0, 1.0)}
EKF = {0.01: (77.0, 1.0), 10.0: (226.0, 1.0), 1000.0: (float("inf"), 0.0)}

CASES = [
    (fls.judge_accuracy, [
        ((fls.Accuracy(100, 92, 95, 0.105, 0.106, OTHERS, REVERSE),), "holds at the paper's weight, not in general"),
        ((fls.Accuracy(100, 60, 95, 0.105, 0.106, OTHERS, REVERSE),), "does not hold"),
        ((fls.Accuracy(100, 92, 95, 0.08, 0.106, MOST, REVERSE),), "holds"),
        ((fls.Accuracy(100, 60, 95, 0.08, 0.106, MOST, REVERSE),), "holds in general, not at the paper's weight"),
    ]),
    (fls.judge_lag, [
        ((0.418, 0.417, 0.7, 2), "they lag"), ((0.418, 0.1, 0.7, 2), "they are noisy"),
        ((0.418, 0.417, 0.7, 0), "they are noisy"), ((0.05, 0.04, 0.7, 2), "holds"),
    ]),
    (fls.judge_cost, [
        ((2000, TIMES), "holds per sample"), ((2000, TIMES | {"A-FLS on-line": 0.3}), "does not hold"),
    ]),
    (fls.judge_output_fit, [
        ((LEFT, 1.41, 0.3, 2.31), "says little a posteriori"), ((LEFT, 1.41, 1.2, 2.31), "holds"),
        ((LEFT, 1.41, 0.3, 0.9), "holds"),
    ]),
    (fls.judge_convergence, [
        ((0.204, 5e-17), "without noise"), ((0.004, 5e-17), "holds"), ((0.204, 0.1), "does not hold"),
    ]),
    (fls.judge_weights, [
        ((WEIGHTS, 1e-5), "does not hold"),
        ((WEIGHTS | {"sinusoids": 3e6, "rational": 4e6}, 1e-5), "holds"),
        ((WEIGHTS | {"sinusoids": 3e6}, 1e-5), "does not hold"),
    ]),
    (fls.judge_structure, [
        ((1.021, 0.018), "where the coefficients change slowly in the order used"),
        ((0.05, 0.018), "holds"), ((1.021, 0.5), "does not hold"),
    ]),
    (fls.judge_limits, [
        ((1.2, 2e-18, 3e-12, 2e-11), "of the on-line recursion only"), ((1e9, 2e-18, 3e-12, 2e-11), "holds"),
        ((1.2, 2e-3, 3e-12, 2e-11), "holds"), ((1.2, 2e-18, 3e-12, 0.1), "holds"),
        ((1.2, 2e-18, 0.2, 2e-11), "does not hold"),
    ]),
    (fls.judge_iteration, [
        (({0.5: 0.25, 0.001: 0.482}, 0.173, 2e-10), "does not hold"),
        (({0.5: 0.25, 0.001: 0.18}, 0.173, 2e-10), "holds"),
    ]),
    (fls.judge_count, [
        ((30, 60, 0.4), "holds"), ((30, 60, float("inf")), "does not hold"), ((60, 60, 0.4), "does not hold"),
    ]),
    (hw.start, [
        ((ARRIVE,), "holds without noise and with P0 = 1e8 I"),
        ((ARRIVE | {10.0: (15.0, 0.96)},), "not in all runs"), ((ARRIVE | {10.0: (150.0, 1.0)},), "not in all runs"),
    ]),
    (hw.rivals, [
        ((EKF, 15.0), "holds"), ((EKF, 70.0), "it fails, and is not slower"),
        ((EKF | {1000.0: (300.0, 0.9)}, 15.0), "it is slower, and does not fail"),
        ((EKF | {1000.0: (300.0, 0.9)}, 70.0), "does not hold"),
    ]),
    (hw.separation, [
        ((METHODS, 2.4), "not in these runs"),
        ((METHODS | {"average": (0.0198, 20.0)}, 2.4), "only through the spikes of AVE"),
        ((METHODS | {"svd": (0.01, 0.02)}, 2.4), "holds"),
    ]),
    (hw.drift, [((0.43, 0.1), "only without noise"), ((0.08, 0.1), "holds")]),
    (hw.noise, [
        ((NOISE,), "we could not reproduce it with a small R"), ((NOISE | {"fast": 0.02},), "holds"),
    ]),
    (hw.order, [
        (({4: 0.34, 5: 0.42, 6: 0.45}, 0.01, (1e-4, 4e-4, 0.99)), "we could not reproduce it with raw powers"),
        (({4: 0.34, 5: 0.32, 6: 0.3}, 0.01, (1e-4, 4e-4, 0.99)), "holds"),
        (({4: 0.34}, 0.01, (1e-4, 4e-4, 0.99)), "not judged with one order"),
    ]),
    (hw.bound, [
        ((2e-5, 708.0, 1.4e5, 6e-4), "correct, and no error bar"),
        ((2e-5, 708.0, 3e-3, 6e-4), "correct, and an error bar"),
        ((2e-5, 708.0, 3e-4, 6e-4), "does not hold"),
    ]),
    (hw.effort, [
        ((EFFORT,), "holds"), ((EFFORT | {"average": 300.0},), "AVE is not faster"),
        ((EFFORT | {"svd": 5000.0},), "SVD is too slow"),
    ]),
    (banks.probabilities, [
        (({1: banks.Calibrated(0.66, 0.5, 0.7, 0.022, 0.018)},),
         "not to the sample and above 0.1, once branches have been cut"),
        (({1: banks.Calibrated(0.95, 0.5, 0.7, 0.022, 0.018)},), "holds"),
        (({1: banks.Calibrated(0.95, 0.5, 0.7, 0.022, 0.2)},), "not below 0.1"),
        (({1: banks.Calibrated(0.66, 0.5, 0.7, 0.022, 0.001)},), "does not hold"),
    ]),
]  # fmt: skip


@pytest.mark.parametrize(("judge", "cases"), CASES, ids=lambda x: f"{x.__module__}.{x.__name__}" if callable(x) else "")
def test_numbers_turn_a_verdict_round(judge, cases):
    verdicts = []
    for numbers, verdict in cases:
        claim = judge(*numbers)
        assert claim.verdict == verdict
        assert claim.rule in claim.text(10_000, "")
        assert claim.measured in claim.text(10_000, "")
        verdicts.append(claim.verdict)
    assert len(set(verdicts)) > 1


def test_no_verdict_is_left_out():
    judged = {judge for judge, _ in CASES}
    assert judged >= {getattr(fls, name) for name in dir(fls) if name.startswith("judge_")}
    own = {name for name in vars(hw) if callable(getattr(hw, name)) and getattr(hw, name).__module__ == hw.__name__}
    assert judged >= {getattr(hw, name) for name in own}
    assert not [name for module in (fls_claims, hw_claims) for name in vars(module) if "Claim(" in name]


class Made:
    """Tables of banks whose values are 1 except where given, by (table, row, column)."""

    def __init__(self, **result):
        self.said = {tuple(key.split("|")): value for key, value in result.items()}

    def __getitem__(self, table):
        return _Table(self, table)


class _Table:
    def __init__(self, made, table):
        self.made, self.table = made, table

    def __getitem__(self, row):
        given = [self.made.said.get((self.table, row, str(column)), 1.0) for column in range(10)]
        return SimpleNamespace(values=given, each=np.ones(3))

    def __iter__(self):
        return iter(["Decide d=2 iid"])


def made(table, values, column=0):
    return Made(**{f"{table}|{row}|{column}": value for row, value in values.items()})


WRONG = {
    "nominal": (0.0, 0.25), "jump covariances x0.1": (0.0, 0.29), "jump covariances x10": (0.0, 0.253),
    "assumed r x0.25": (0.0, 0.39), "assumed r x4": (0.0, 0.32),
}  # fmt: skip
CUT = dict.fromkeys(("Decide d=2", "Decide d=3", "Decide d=4", "Beam M=9"), 0.8)
JOINT = {"joint Decide d=2": 0.9, "joint Decide d=3": 0.8, "GPB(2) joint": 0.8, "joint Beam M=32": 0.8}
BARE, SHALLOW = "Decide d=2, no sensor alternative", "joint Decide d=1"
CLEANED = "joint Decide d=2, leaf-cleaned regressor"
STUCK = "Decide d=2 ok/frozen cleaned, Markov"
COSTS = {f"Decide d=2, a miss costs {c}": x for c, x in ((3, 0.99), (10, 1.02), (30, 1.07), (100, 1.27))}
NEES = {"Decide d=1": 1.9, "Decide d=3": 1.3, "Decide d=5": 1.2, "GPB(1)": 0.8, "GPB(2)": 0.8, "GPB(4)": 0.9}
SLOW = {"threshold tau=0.02 dmax=6": 1.01, "look-ahead c=0.005 dmax=6": 1.02}


def both(first, second):
    first.said |= second.said
    return first


def delayed(costs, delay):
    return both(made("clean", costs), made("clean", dict.fromkeys(COSTS, delay), 5))


BANKS = [
    (banks.sparse, (made("clean", CUT),), (made("clean", CUT | {"Beam M=9": 1.1}),)),
    (banks.persistent,
     (made("regimes", {"Decide d=2 iid": 1.2, "GPB(2) Markov": 0.9, "IMM Markov": 0.9}),),
     (made("regimes", {"Decide d=2 iid": 0.9, "GPB(2) Markov": 0.9, "IMM Markov": 0.9}),)),
    (banks.outliers, (made("outliers", JOINT | {BARE: 1.9, SHALLOW: 3.0}),),
     (made("outliers", JOINT | {BARE: 0.9, SHALLOW: 3.0}),)),
    (banks.cleaning, (both(made("additive", {CLEANED: 0.9}), made("frozen", {STUCK: 0.9})),),
     (both(made("additive", {CLEANED: 0.9}), made("frozen", {STUCK: 1.1})),)),
    (banks.scale, (made("clean", {banks.KF: 0.352}), WRONG), (made("clean", {banks.KF: 0.5}), WRONG)),
    (banks.scale, (made("clean", {banks.KF: 0.352}), WRONG),
     (made("clean", {banks.KF: 0.352}), WRONG | {"jump covariances x10": (0.0, 0.5)})),
    (banks.losses, (delayed(COSTS, 0.4),), (delayed(COSTS, 1.0),)),
    (banks.losses, (delayed(COSTS, 0.4),), (delayed(COSTS | {"Decide d=2, a miss costs 3": 1.1}, 0.4),)),
    (banks.losses, (delayed(COSTS, 0.4),), (delayed(COSTS | {"Decide d=2, a miss costs 30": 1.0}, 0.4),)),
    (banks.covariances, (both(made("clean", NEES, banks.NEES), made("clean", {"GPB(2)": 1.7}, banks.STEADY)),),
     (both(made("clean", NEES | {"GPB(4)": 1.3}, banks.NEES), made("clean", {"GPB(2)": 1.7}, banks.STEADY)),)),
    (banks.wording, (made("clean", {"FirstFloor posterior d=2": 1.05}),),
     (made("clean", {"FirstFloor posterior d=2": 0.95}),)),
    (banks.depth, (made("variable", SLOW),), (made("variable", SLOW | {"look-ahead c=0.005 dmax=6": 1.2}),)),
    (banks.noise_variance,
     ({"r known": (0.24, 0.28, 0.55), "r = .09 assumed": (0.27, 0.28, 1.1), "unknown, from .09": (0.28, 0.29, 0.68)},),
     ({"r known": (0.24, 0.28, 0.55), "r = .09 assumed": (0.27, 0.28, 1.1), "unknown, from .09": (0.28, 0.29, 1.2)},)),
]  # fmt: skip


@pytest.mark.parametrize(("judge", "one", "other"), BANKS, ids=lambda x: getattr(x, "__name__", ""))
def test_tables_of_banks_turn_a_verdict_round(judge, one, other):
    assert judge(*one).verdict != judge(*other).verdict
    assert judge(*one).claim == judge(*other).claim


def test_verdicts_of_banks_on_the_printed_numbers():
    assert banks.scale(made("clean", {banks.KF: 0.352}), WRONG).verdict.startswith("it is required: r above all")
    found_claims = banks.losses(delayed(COSTS, 0.4)).verdict
    assert found_claims == "it buys delay; up to 3 it costs nothing, from 30 on it costs accuracy"
