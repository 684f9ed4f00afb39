"""The machines of a bank: the one of `advance`, and it with some of its parts exchanged."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

from driftfit.engine.drivers import TrackerSteps
from driftfit.engine.kernel import Outside, exchanged
from driftfit.trackers.bank.leaves import square_root_form
from driftfit.trackers.bank.leaves.own_sensor import chosen, own_likelihood
from driftfit.trackers.bank.machine.advance import bank
from driftfit.trackers.bank.machine.steps import STEPS


@cache
def made(factored: bool, own: tuple[Callable[..., Any], ...]) -> tuple[Outside, TrackerSteps]:
    """The machine and the steps that run it, for leaves that keep factors, or sensors with likelihoods of the user's
    ``own``; compiled when it is first asked for.
    """
    others: dict[Any, Any] = dict(square_root_form.PARTS) if factored else {}
    if own:
        others[own_likelihood] = chosen(own)
    if not others:
        return bank, STEPS
    (machine,) = exchanged([bank], others)
    correct, begin = exchanged([STEPS.correct, STEPS.begin], {bank: machine})
    return machine, STEPS._replace(correct=correct, begin=begin)
