"""A simulated plant of six pumps; the valve behind one of them closes. No file, broker or network is needed.

flow_t = 0.7 flow_(t-1) + gain_t pressure_(t-1) + 0.2 + v_t,    gain 0.5, in one pump 0.15 after its valve has closed
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from driftfit.service.connect.base import Batch, Reader, Samples, Source

PUMPS = 6
CLOSING = 3
"""The pump whose valve closes."""
GAIN, CLOSED, TAKES = 0.5, 0.15, 2.0
NOISE = 0.05


@dataclass(frozen=True)
class PlantSource(Source):
    """The plant."""

    interval: float = 0.05
    """Seconds between two samples."""
    before: int = 600
    """Samples that the plant has already delivered when the service starts."""
    after: float = 6.0
    """Seconds after the start at which the valve begins to close."""
    opens: float = 40.0
    """Seconds after which it opens again, and then closes again after as long."""
    seed: int = 1

    def open(self, position: Any) -> Reader:
        return _Plant(self)


class _Plant(Reader):
    def __init__(self, options: PlantSource) -> None:
        self.options = options
        self.rng = np.random.default_rng(options.seed)
        self.flow, self.pressure = np.zeros(PUMPS), np.zeros(PUMPS)
        self.zero = time.time()
        self.count = 0
        self.first = -options.before

    def _gain(self, seconds: float) -> float:
        """The gain of the pump whose valve closes and opens."""
        late = seconds - self.options.after
        if late < 0.0:
            return GAIN
        cycle, within = divmod(late, self.options.opens)
        share = min(1.0, within / TAKES)
        share = share if cycle % 2 == 0 else 1.0 - share
        return GAIN + share * (CLOSED - GAIN)

    def read(self, wait: float) -> Batch | None:
        step = self.options.interval
        due = int((time.time() - self.zero) / step) + self.options.before
        if due <= self.count:
            time.sleep(step)
            return None
        count = min(due - self.count, 1000)
        times = [(self.first + self.count + k) * step for k in range(count)]
        flow, pressure = np.zeros((count, PUMPS)), np.zeros((count, PUMPS))
        for k, t in enumerate(times):
            gain = np.full(PUMPS, GAIN)
            gain[CLOSING - 1] = self._gain(t)
            self.flow = 0.7 * self.flow + gain * self.pressure + 0.2 + NOISE * self.rng.normal(size=PUMPS)
            self.pressure = 2.0 + self.rng.normal(size=PUMPS)
            flow[k], pressure[k] = self.flow, self.pressure
        self.count += count
        at = [self.zero + t for t in times]
        samples = [
            Samples(f"plant/pump {j + 1}/sensors", count,
                    {"ts": at, "flow": flow[:, j].tolist(), "pressure": pressure[:, j].tolist()})
            for j in range(PUMPS)
        ]  # fmt: skip
        return Batch(samples, arrived=time.monotonic())
