"""The two forms of the compiled routine of a bank, and the steps that call it."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

from driftfit.engine.drivers import TrackerSteps
from driftfit.engine.kernel import Machine
from driftfit.trackers.bank.leaves import square_root_form
from driftfit.trackers.bank.leaves.own_sensor import entry_of, own_address
from driftfit.trackers.bank.machine.advance import bank
from driftfit.trackers.bank.machine.steps import STEPS
from driftfit.trackers.bank.substitute import substituted


@cache
def _factored() -> Machine:
    """The compiled routine of `advance`, with the parts that work on covariances replaced."""
    (machine,) = substituted([bank], square_root_form.PARTS)
    return machine  # type: ignore[no-any-return]


@cache
def steps_of(factored: bool, own: tuple[Callable[..., Any], ...]) -> TrackerSteps:
    """The steps for leaves that keep factors or covariances, which also know where the user's ``own`` likelihoods are.

    Both forms have the same steps; drivers call the routine of either form by the same symbol.
    """
    machine = _factored() if factored else bank
    steps = STEPS._replace(machines=(*STEPS.machines, machine), instead=((bank, machine),) if factored else ())
    if not own:
        return steps
    entry, address = entry_of(own)
    assert steps.start is not None
    correct, begin = substituted([steps.correct, steps.start.correct], {own_address: address})
    return steps._replace(correct=correct, start=steps.start._replace(correct=begin), machines=(*steps.machines, entry))
