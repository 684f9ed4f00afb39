"""The regressors of a record with the thresholds of its dead zones and saturations held at one value.

While it runs, the model takes the thresholds from its estimates, so the functions of the first inputs are those of
wrong thresholds, and constants that explain the later rows do not explain these: that looks like a change of the
parameters. A judgement of a whole record needs the same functions at all samples. Here theta is fitted to all rows, the
thresholds follow from its products, and the functions from the thresholds, until these stay (Gauss-Newton, as in the
stream):

    p_k = sum_j b_j (b_j p_k) / sum_j b_j^2

With thresholds at which a gain has no regressor, as those of a saturation at (0, 0), they begin again at their start.
Cost: a least squares fit of N rows per pass.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.models.hammerstein_wiener.curves.basis import INSIDE, Thresholds
from driftfit.models.hammerstein_wiener.curves.curve import Basis
from driftfit.models.hammerstein_wiener.products import Structure

PASSES = 20
CLOSE = 1e-6
"""The thresholds stay if they move by less than this share of u_max."""


def settled(
    phi: Array, y: Array, u: Array, at: Array, bases: Sequence[Basis], delays: Sequence[int], s: Structure
) -> Array:
    """phi (N, n) of the usable samples ``at`` (N,) of a record u (T, m), with outputs y (N,), in settled functions."""
    phi, moved = phi.copy(), np.inf
    last = {i: np.full(2, np.inf) for i, basis in enumerate(bases) if isinstance(basis, Thresholds)}
    for _ in range(PASSES if len(at) else 0):
        theta = np.linalg.lstsq(phi, y)[0]
        moved, b, products = 0.0, s.na, s.na + sum(s.nb) + s.n_out - 1
        for i, basis in enumerate(bases):
            nb = s.nb[i]
            if isinstance(basis, Thresholds):
                unseen = not phi[:, b : b + nb].any()  # no input is where its gain can be learned
                gain, each = theta[b : b + nb], theta[products : products + 2 * nb].reshape(2, nb)
                room = INSIDE * basis.u_max * np.array([[0.0, 1.0], [-1.0, 0.0]])
                found = basis.own_numbers[:2] if unseen else each @ gain / max(float(gain @ gain), 1e-300)
                found = np.clip(found, *room.T)
                moved = max(moved, float(np.max(np.abs(found - last[i]))) / basis.u_max)
                last[i] = found
                f = -basis.split(u[:, i], u[:, i] > found[0], u[:, i] < found[1])  # as in the rows of the model
                lagged = np.stack([f[at - delays[i] - j] for j in range(nb)], axis=1)
                phi[:, b : b + nb] = lagged[:, :, 0]
                phi[:, products : products + 2 * nb] = lagged[:, :, 1:].transpose(0, 2, 1).reshape(len(at), 2 * nb)
            b, products = b + nb, products + nb * (basis.n - 1)
        if moved < CLOSE:
            break
    return phi
