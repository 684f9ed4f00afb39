"""The machines of a bank, and the steps that run them."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

from driftfit.engine.drivers import TrackerSteps
from driftfit.engine.kernel import Machine
from driftfit.engine.substitute import substituted
from driftfit.trackers.bank.leaves import square_root_form
from driftfit.trackers.bank.leaves.own_sensor import entry_of, own_address
from driftfit.trackers.bank.machine.advance import bank
from driftfit.trackers.bank.machine.steps import STEPS


@cache
def _factored() -> Machine:
    """The machine of `advance` with the parts substituted that work on covariances."""
    (machine,) = substituted([bank], square_root_form.PARTS)
    return machine  # type: ignore[no-any-return]


@cache
def made(factored: bool, own: tuple[Callable[..., Any], ...]) -> tuple[Machine, TrackerSteps]:
    """The machine for leaves that keep factors or covariances, and steps that also know where the user's ``own``
    likelihoods are.
    """
    others: dict[Any, Any] = {bank: _factored()} if factored else {}
    machines = STEPS.machines
    if own:
        entry, others[own_address] = entry_of(own)
        machines = (*machines, entry)
    if not others:
        return bank, STEPS
    correct, begin = substituted([STEPS.correct, STEPS.begin], others)
    return others.get(bank, bank), STEPS._replace(correct=correct, begin=begin, machines=machines)
