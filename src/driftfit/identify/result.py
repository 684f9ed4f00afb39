"""The answer as data: what moves, by how much, how well it predicts, and what was chosen."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

from driftfit.identify.roles import Roles
from driftfit.identify.structure import Structure
from driftfit.identify.working_point import Cause
from driftfit.judge.alarms.detect import Alarms
from driftfit.judge.verdict import Verdict
from driftfit.models.arx import ARX
from driftfit.models.hammerstein_wiener.basis import Polynomial
from driftfit.models.hammerstein_wiener.model import HammersteinWiener
from driftfit.results import Track
from driftfit.show.text import Printed
from driftfit.trackers.rls import RLS
from driftfit.tracking import track


class Errors(NamedTuple):
    """Root mean square errors ``steps`` ahead, by method, on ``samples`` samples."""

    steps: int
    rms: dict[str, float]
    samples: int


class Effect(NamedTuple):
    """The effect of an input with constants: in the long run, sum b / (1 - sum a), or in a sample, sum b, where the
    output may have a unit root; without inputs the level of the output. Its standard error; the change half-way that
    would be found in 4 of 5 records.
    """

    name: str
    gain: float
    std: float
    least: float


class Memory(NamedTuple):
    """Sum of the lags of y with its standard error; ``root``: whether 1 is within two of them."""

    value: float
    std: float

    @property
    def root(self) -> bool:
        return self.value + 2.0 * self.std >= 1.0


class Move(NamedTuple):
    """What an event did to one effect: the static gain of an input, the ``memory`` (sum of a) or the ``level``."""

    what: str
    kind: str
    before: float
    after: float
    first: str
    last: str
    at: int
    instead: tuple[str, ...]


@dataclass(frozen=True)
class Answer(Printed):
    """What `identify` finds for one record.

    Attributes
    ----------
    kind, why : str
        "moves", "a static curve explains it", "both", "no drift found", or "cannot decide" and why.
    model, track, verdict
        The `ARX` model that was chosen, its run with the default tracker, and the verdict on its parameters.
    roles, structure, cause
        What each column is; what was chosen and what came second; what explains the record, in nats.
    effects, moves, memory, errors
        Effects of the inputs with constants; what changed; the lags of y; errors one step and ``horizon`` steps ahead.
    notes, undecided : tuple of str
        Problems of the data; what could not be decided.
    """

    kind: str
    why: str
    model: ARX
    track: Track = field(repr=False)
    verdict: Verdict = field(repr=False)
    roles: Roles = field(repr=False)
    structure: Structure
    cause: Cause = field(repr=False)
    effects: tuple[Effect, ...]
    moves: tuple[Move, ...]
    memory: Memory
    errors: tuple[Errors, ...]
    notes: tuple[str, ...]
    undecided: tuple[str, ...]
    source: str

    @property
    def code(self) -> int:
        """Exit code of the command: 0 answered, 1 undecided."""
        return int(self.kind == "cannot decide")

    @property
    def effect(self) -> str:
        """What the effects are: there may be no long run, and without inputs there is only a level."""
        lasting = "static gain" if self.model.input_names else "level"
        return "effect in a sample" if self.memory.root else lasting

    @cached_property
    def alarms(self) -> Alarms:
        """Alarms whose reference is what followed the last change; ``alarms.rule`` is armed from now on."""
        last, T = max((move.at for move in self.moves), default=0), len(self.track)
        start = last if T - last > T // 4 else 3 * T // 4
        return self.track.detect("glr", reference=(self.track.time[start], self.track.time[T - 1]))

    @cached_property
    def curve(self) -> Track:
        """A Hammerstein-Wiener model with the curve of one input, or of all where it is of several, with constants."""
        model, bent = self.model, self.cause.bent
        bases = [Polynomial(3) if bent < 0 or name == self.roles.inputs[bent] else None for name in model.input_names]
        nb, nk = zip(*model.lags, strict=True)
        curved = HammersteinWiener(model.na, nb, nk, input=bases, inputs=model.input_names, intercept=True)
        fitted: Track = track(curved, RLS(1.0), **self.roles.signals(model.input_names))
        return fitted
