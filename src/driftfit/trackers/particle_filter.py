"""The Rao-Blackwellised particle filter: what bends is drawn, what is linear given that is computed.

    z = (theta, x) = (a, b):  b is drawn (``sampled``), a is Gaussian given the path of b; for each particle p

    predict   z <- f(z);  P <- F P F' + q dt d;   b ~ N(z_b, P_bb),  z, P <- given b
    correct   y_hat = h(z);  s = h' P h + r / w;  weight <- weight N(y; y_hat, s);   z, P as in the Kalman filter
    mixture   theta = sum_p weight_p z_p,   P = sum_p weight_p (P_p + (z_p - theta)(z_p - theta)')

Where a is linear given b, no approximation is made but for the number of particles; otherwise each particle is an
extended Kalman filter in a. With nothing drawn, all particles are the same extended Kalman filter. Particles are
resampled (systematic) once their weights are worth fewer than half of them.

Use it where distributions have several peaks, as when an output depends on x^2 or an angle and the sign is to be found
out, or where `JointKalman` with both of its methods does not cover. ``theta`` is then the mean between the peaks, which
may be a value that cannot be; ``std`` says so. ``loglik`` is that of the mixture. A parameter that is drawn needs drift
(``q``): what does not move is never drawn again, and copies of one particle remain.

Random numbers depend on the seed and a counter in the state: a run gives the same bits again, live and in lanes.

Source: Schon, Gustafsson and Nordlund, Marginalized particle filters, IEEE Trans. Signal Processing 53 (2005); Doucet,
de Freitas, Murphy and Russell (2000). Departures: each particle carries the covariance of all of z, of which what is
drawn has none left; derivatives where a is not linear. Cost per sample: O(particles n^2), and an evaluation of the
equations with derivatives for each particle.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from driftfit.engine.drivers import TrackerSteps
from driftfit.engine.settings import near, whole
from driftfit.models.state_space import StateSpace
from driftfit.trackers.state_space.particle_steps import steps
from driftfit.trackers.state_space.tracker import StateSpaceTracker


@dataclass(frozen=True)
class ParticleFilter(StateSpaceTracker):
    """Rao-Blackwellised particle filter of parameters and hidden states, for `StateSpace`.

    Parameters
    ----------
    particles : int
        Their number.
    q, r, p0, theta0
        As for `JointKalman`.
    sampled : names or None
        Parameters and states that are drawn. None: all states that have drift (``q``).
    seed : int
        Of the random numbers.

    Raises
    ------
    ValueError
        If a variance is negative, r is not positive, there is no particle, or a name is neither parameter nor state.
    """

    particles: int | None = None
    q: Any = None
    r: float | None = None
    p0: Any = None
    theta0: Any = None
    sampled: tuple[str, ...] | None = None
    seed: int = 0

    required: ClassVar[tuple[str, ...]] = ("particles", *StateSpaceTracker.required)
    width: ClassVar[int] = 1
    outputs: ClassVar[tuple[str, ...]] = ("log_density",)
    density: ClassVar[str] = "log_density"
    scratch: ClassVar[tuple[str, ...]] = (
        "W", "gain", "shown", "spread", "fit", "column", "cloud_after", "own_after", "log_density"
    )  # fmt: skip

    def __post_init__(self) -> None:
        name = "ParticleFilter"
        self._check()
        if self.particles is not None:
            self._set("particles", whole(name, "particles", self.particles, 1))
        if self.sampled is not None:
            given = (self.sampled,) if isinstance(self.sampled, str) else self.sampled
            self._set("sampled", tuple(str(one) for one in given))
        self._set("seed", whole(name, "seed", self.seed, 0))

    def state_of(self, model: StateSpace, prior: Mapping[str, Any]) -> Mapping[str, Any]:
        n, count = model.n, 1 if self.particles is None else self.particles
        return {
            **prior, "drift_root": np.ones(n), "seed": self.seed, "drawn": 0,
            "cloud": np.repeat(prior["theta"][None], count, axis=0), "own": np.repeat(prior["P"][None], count, axis=0),
            "weight": np.full(count, 1.0 / count), "W": np.zeros((max(len(model.hidden), 1), n)),
            "gain": np.zeros((count, n)), "shown": np.zeros(count), "spread": np.zeros(count), "fit": np.zeros(count),
            "column": np.zeros(n), "cloud_after": np.zeros((count, n)), "own_after": np.zeros((count, n, n)),
            "log_density": 0.0,
        }  # fmt: skip

    def steps_of(self, model: StateSpace) -> TrackerSteps:
        chosen = model.hidden if self.sampled is None else self.sampled
        if self.sampled is None and self.q is not None:  # one without drift would be drawn once, and copies remain
            variance = dict(zip(model.names, np.diag(self.drift_of(model)), strict=True))
            chosen = tuple(name for name in chosen if variance[name] > 0.0)
        for one in chosen:
            if one not in model.names:
                raise ValueError(f"ParticleFilter: sampled names {one!r}; {near(one, model.names)}")
        places = tuple(sorted(model.names.index(one) for one in chosen))
        return steps(model.equations, model.input_names, len(model.hidden), model.system.timed, places)

    def widen(self, lane: Mapping[str, Any], p: Any) -> None:
        super().widen(lane, p)
        np.einsum("pii->pi", lane["own"])[:] += p

    def place(self, lane: Mapping[str, Any], which: Any, values: Any) -> None:
        super().place(lane, which, values)
        lane["cloud"][:, list(which)] = values
