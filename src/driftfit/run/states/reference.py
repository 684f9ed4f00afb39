"""One decision for many candidates: which readings are left out is decided by one run, and holds for all of them.

The reference is `AdaptiveKalman` on the largest of the models, so the decision depends neither on the settings that are
tried nor on their number. Refused readings are missing for every candidate, and samples with a refused input have no
weight, so that likelihoods are of the same readings.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from typing import Any

import numpy as np

from driftfit.data.record import Records
from driftfit.models.base import Model
from driftfit.readings.left_out import LeftOut
from driftfit.run.program import Program
from driftfit.run.result import track_record
from driftfit.run.states.gating import gate_of
from driftfit.trackers.adaptive_kalman import AdaptiveKalman

Decisions = Mapping[Hashable, LeftOut]
"""What was left out of each series, by its key."""


def decide(model: Model, records: Records, gate: Any) -> tuple[Records, Decisions]:
    """(the series as every candidate takes them, what was left out of each), given the largest model, bound, and a
    gate (None or False: none), or decisions that were made before; ValueError for a model that the reference does not
    follow.
    """
    if gate is None or gate is False:
        return records, {}
    if not isinstance(gate, LeftOut | Mapping):
        if model.hidden is not None:
            raise ValueError(
                f"gate: {type(model).__name__} has no reference run that could decide; give the decisions of a run, "
                "gate=track(model, tracker, y, u, gate=True).left_out."
            )
        reference = AdaptiveKalman()
        program = Program(model, reference, gate=gate_of(reference, gate))
        parts = zip(records.keys, map(records.part, range(len(records.keys))), strict=True)
        gate = {key: track_record(program, part).left_out for key, part in parts}
    return decided(records, gate)


def decided(records: Records, gate: LeftOut | Decisions) -> tuple[Records, Decisions]:
    """The series with decisions that were made before: of one series, or by its key."""
    if records.outputs:
        raise ValueError("gate: decisions are those of one output; give gate=True, or take one output after the other.")
    if isinstance(gate, LeftOut):
        if len(records.keys) > 1:
            raise ValueError("gate: decisions of one run are for one series; give a mapping from every key to its own.")
        gate = {records.keys[0]: gate}
    y, noise = records.y.copy(), np.array(np.broadcast_to(records.known.noise, len(records.y)))
    for key, begin, count in zip(records.keys, records.first.tolist(), records.length.tolist(), strict=True):
        if key in gate:
            part = slice(begin, begin + count)
            y[part], noise[part] = gate[key].applied(y[part], noise[part])
    return records._replace(y=y, known=records.known.changed(noise=noise), left_out=gate), gate
