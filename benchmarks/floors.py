"""What a causal method can reach where parameters jump: the Bayesian filter that knows all but when they do.

It knows the noise, that nothing else changes, how often parameters jump, how far, and which of them may, and keeps the
200 most probable histories of jumps (and of outliers, in the rows that allow for them: one reading in fifty, ten times
as noisy, which do not occur). Errors of the parameters are divided by those of the oracle of `benchmarks.scenarios`,
which knows the samples of the jumps; the geometric mean over runs, and that of `AdaptiveKalman`, which knows nothing.

Run: python -m benchmarks.floors [--runs 20] [--quick]
"""

from __future__ import annotations

import argparse
from zlib import crc32

import numpy as np

from benchmarks.scenarios import error, oracle
from benchmarks.unseen import found
from driftfit import AdaptiveKalman, track
from driftfit.engine.kernel import Array, Driver

HISTORIES, NEGLIGIBLE = 200, 16.0
"""Histories that are kept, and the distance in log probability from the best at which one is dropped."""


@Driver
def best_histories(phi: Array, y: Array, r: Array, moves: Array, logs: Array, theta: Array) -> None:
    """theta (T, n) from histories of events: ``moves`` (J, n + 1) are variances of a jump and the factor of the noise,
    ``logs`` (J, J) the log probabilities of the events (columns) after each event (rows); the first precedes all."""
    T, n = phi.shape
    J, most = len(moves), HISTORIES
    m, P, w = np.zeros((most, n)), np.zeros((most, n, n)), np.zeros(most)
    m_next, P_next, w_next = np.zeros((most, n)), np.zeros((most, n, n)), np.zeros(most)
    e, g, score = np.zeros(most), np.zeros(n), np.zeros(most * J)
    last, last_next = np.zeros(most, np.int64), np.zeros(most, np.int64)
    for i in range(n):
        P[0, i, i] = 1e6
    alive = 1
    for t in range(T):
        for b in range(alive):
            h, e[b] = 0.0, y[t]
            for i in range(n):
                e[b] -= phi[t, i] * m[b, i]
                for j in range(n):
                    h += phi[t, i] * P[b, i, j] * phi[t, j]
            for j in range(J):
                v = h + r[t] * moves[j, n]
                for i in range(n):
                    v += moves[j, i] * phi[t, i] ** 2
                score[b * J + j] = w[b] + logs[last[b], j] - 0.5 * (np.log(v) + e[b] ** 2 / v)
        order, kept, total = np.argsort(-score[: alive * J]), 0, 0.0
        for at in order[:most]:
            lost = score[order[0]] - score[at]
            if lost > NEGLIGIBLE:
                break
            b, j = at // J, at % J
            v = r[t] * moves[j, n]
            for i in range(n):
                g[i] = moves[j, i] * phi[t, i]
                for k in range(n):
                    g[i] += P[b, i, k] * phi[t, k]
                v += g[i] * phi[t, i]
            for i in range(n):
                m_next[kept, i] = m[b, i] + g[i] * e[b] / v
                for k in range(n):
                    P_next[kept, i, k] = P[b, i, k] - g[i] * g[k] / v
                P_next[kept, i, i] += moves[j, i]
            w_next[kept], last_next[kept] = -lost, j
            total += np.exp(-lost)
            kept += 1
        alive = kept
        for i in range(n):
            theta[t, i] = 0.0
        for b in range(alive):
            m[b], P[b], w[b], last[b] = m_next[b], P_next[b], w_next[b] - np.log(total), last_next[b]
            for i in range(n):
                theta[t, i] += np.exp(w[b]) * m[b, i]


KNOWN: dict[str, tuple[str, float, list[list[float]]]] = {
    "one of 4 jumps, any": ("one_sided_jump", 0.002, [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]),
    "one of 4 jumps, which is known": ("one_sided_jump", 0.002, [[0, 0, 1, 0]]),
    "switch, any one or all": ("switch", 0.01, [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1], [1, 1, 1, 1]]),
    "switch, direction is known": ("switch", 0.01, [[2.25, 0, 0.36, 0]]),
}
"""Scenario, probability of a jump, and the variances of the parameters' jumps."""


def events(rate: float, jumps: Array, outliers: tuple[float, float] = (0.0, 1.0)) -> tuple[Array, Array]:
    """Moves and log probabilities of what may happen at a sample, whatever happened before; ``outliers`` are their
    probability and their variance in units of the noise."""
    still = np.concatenate([np.zeros((1, jumps.shape[1])), jumps])
    prob = np.array([1.0 - rate, *np.full(len(jumps), rate / len(jumps))])
    moves = np.column_stack([still, np.ones(len(still))])
    if outliers[0] > 0.0:
        far = np.column_stack([still, np.full(len(still), outliers[1])])
        moves, prob = np.concatenate([moves, far]), np.concatenate([(1.0 - outliers[0]) * prob, outliers[0] * prob])
    return moves, np.tile(np.log(prob), (len(prob), 1))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--quick", action="store_true", help="two runs of one line")
    given = parser.parse_args()
    print(f"{'':32}{'no outliers':>14}{'outliers':>14}{'AdaptiveKalman':>16}")
    for name, (scenario, rate, jumps) in list(KNOWN.items())[: 1 if given.quick else None]:
        ratios = []
        for seed in range(2 if given.quick else given.runs):
            case = found()[scenario](np.random.default_rng([seed, crc32(scenario.encode())]))
            phi, theta = np.ascontiguousarray(case.u), np.empty(case.u.shape)
            c = np.mean(phi**2, axis=0)
            row = [track(case.model, AdaptiveKalman(), case.y, case.u).theta]
            for outliers in ((0.0, 1.0), (0.02, 100.0)):
                best_histories(phi, case.y, case.r, *events(rate, np.array(jumps, float), outliers), theta)
                row.insert(-1, theta.copy())
            ratios.append([error(case, path, c) / error(case, oracle(case, phi), c) for path in row])
        print(f"{name:32}" + "{:14.2f}{:14.2f}{:16.2f}".format(*np.exp(np.mean(np.log(ratios), axis=0))), flush=True)


if __name__ == "__main__":
    main()
