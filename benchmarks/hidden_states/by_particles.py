"""Four plants with particles (Chopin): each function returns a `StateSpaceModel` for its bootstrap filter.

The prior is that of the first sample, and not of the time before it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from particles import distributions as dists
from particles import state_space_models as ssm


def exchanger(u: Any) -> Any:
    class Exchanger(ssm.StateSpaceModel):
        def PX0(self) -> Any:  # noqa: N802
            return dists.Normal(2.5, 1.0)

        def PX(self, t: int, xp: Any) -> Any:  # noqa: N802
            return dists.Normal(xp, np.sqrt(2e-4))

        def PY(self, t: int, xp: Any, x: Any) -> Any:  # noqa: N802
            steam, inlet, flow = u[t]
            return dists.Normal(steam - (steam - inlet) * np.exp(-x / flow), 0.5)

    return Exchanger()


def battery(u: Any) -> Any:
    class Cell(ssm.StateSpaceModel):
        def moved(self, t: int, x: Any) -> Any:
            capacity, R1, R0, charge, v1 = x.T
            return capacity, R1, R0, charge - 10 * u[t] / 3600 / capacity, v1 + 10 * (R1 * u[t] - v1) / 60

        def PX0(self) -> Any:  # noqa: N802
            means, scales = (2.3, 0.03, 0.06, 0.5, 0.0), np.sqrt([0.25, 1e-4, 1e-3, 0.04, 1e-4])
            return dists.IndepProd(*(dists.Normal(m, s) for m, s in zip(means, scales, strict=True)))

        def PX(self, t: int, xp: Any) -> Any:  # noqa: N802
            scales = 2e-3, 0.0, 1e-4, 0.0, 1e-4
            return dists.IndepProd(*(dists.Normal(m, s) for m, s in zip(self.moved(t, xp), scales, strict=True)))

        def PY(self, t: int, xp: Any, x: Any) -> Any:  # noqa: N802
            _, _, R0, charge, v1 = x.T
            return dists.Normal(3.2 + 0.5 * charge + 0.4 * charge**3 - R0 * u[t] - v1, 0.01)

    return Cell()


def epidemic(u: Any) -> Any:
    class Cases(ssm.StateSpaceModel):
        def PX0(self) -> Any:  # noqa: N802
            return dists.IndepProd(dists.Normal(0.3, 0.1), dists.Normal(1.0, 0.0), dists.Normal(-9.0, 1.0))

        def PX(self, t: int, xp: Any) -> Any:  # noqa: N802
            contact, s, li = xp.T
            growth = contact * s - 0.15
            return dists.IndepProd(
                dists.Normal(contact, 0.01),
                dists.Normal(s - contact * s * np.exp(li), 0.0),
                dists.Normal(li + growth - 0.5 * growth**2, 0.02),
            )

        def PY(self, t: int, xp: Any, x: Any) -> Any:  # noqa: N802
            contact, s, li = x.T
            return dists.Normal(np.log(1e6 * contact * s) + li, 0.1)

    return Cases()


def vehicle(u: Any) -> Any:
    class Lorry(ssm.StateSpaceModel):
        def PX0(self) -> Any:  # noqa: N802
            return dists.IndepProd(dists.Normal(0.004, np.sqrt(1e-5)), dists.Normal(15.0, 5.0), dists.Normal(15.0, 1.0))

        def PX(self, t: int, xp: Any) -> Any:  # noqa: N802
            drag, mass, v = xp.T
            moved = v + (u[t, 0] - drag * v * abs(v)) / mass - 9.81 * u[t, 1]
            return dists.IndepProd(
                dists.Normal(drag, 0.0), dists.Normal(mass, np.sqrt(0.02)), dists.Normal(moved, 0.01)
            )

        def PY(self, t: int, xp: Any, x: Any) -> Any:  # noqa: N802
            return dists.Normal(x[:, 2], 0.2)

    return Lorry()
