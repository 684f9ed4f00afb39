"""A model with the number of parameters and the memory of a larger one, so that both run in one compiled driver."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

from driftfit.models.base import Model


@dataclass(frozen=True)
class Wider(Model):
    """A bound model in the record of a larger one of ``size`` parameters: regressors after its own are 0."""

    model: Model
    size: int

    def bind(self, inputs: int | Sequence[str]) -> Self:
        return self

    @property
    def m(self) -> int:
        return self.model.m

    @property
    def names(self) -> tuple[str, ...]:
        own = self.model.names
        return (*own, *(f"absent{i + 1}" for i in range(self.size - len(own))))
