"""Four plants with dynamax: each function returns the parameters of a `ParamsNLGSSM`, for both of its filters.

The prior is that of the first sample, and not of the time before it. dynamax follows whole records.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from dynamax.nonlinear_gaussian_ssm import ParamsNLGSSM

jax.config.update("jax_enable_x64", True)


def exchanger() -> Any:
    def f(z: Any, u: Any) -> Any:
        return z

    def h(z: Any, u: Any) -> Any:
        return jnp.array([u[0] - (u[0] - u[1]) * jnp.exp(-z[0] / u[2])])

    return ParamsNLGSSM(jnp.array([2.5]), jnp.eye(1), f, 2e-4 * jnp.eye(1), h, 0.25 * jnp.eye(1))


def battery() -> Any:
    def f(z: Any, u: Any) -> Any:
        capacity, R1, R0, charge, v1 = z
        return jnp.array([capacity, R1, R0, charge - 10 * u[0] / 3600 / capacity, v1 + 10 * (R1 * u[0] - v1) / 60])

    def h(z: Any, u: Any) -> Any:
        return jnp.array([3.2 + 0.5 * z[3] + 0.4 * z[3] ** 3 - z[2] * u[0] - z[4]])

    begins = jnp.array([2.3, 0.03, 0.06, 0.5, 0.0])
    P0 = jnp.diag(jnp.array([0.25, 1e-4, 1e-3, 0.04, 1e-4]))
    Q = jnp.diag(jnp.array([4e-6, 0.0, 1e-8, 0.0, 1e-8]))
    return ParamsNLGSSM(begins, P0, f, Q, h, 1e-4 * jnp.eye(1))


def epidemic() -> Any:
    def f(z: Any, u: Any) -> Any:
        contact, s, li = z
        growth = contact * s - 0.15
        return jnp.array([contact, s - contact * s * jnp.exp(li), li + growth - 0.5 * growth**2])

    def h(z: Any, u: Any) -> Any:
        return jnp.array([jnp.log(1e6 * z[0] * z[1]) + z[2]])

    P0, Q = jnp.diag(jnp.array([0.01, 1e-9, 1.0])), jnp.diag(jnp.array([1e-4, 0.0, 4e-4]))
    return ParamsNLGSSM(jnp.array([0.3, 1.0, -9.0]), P0, f, Q, h, 0.01 * jnp.eye(1))


def vehicle() -> Any:
    def f(z: Any, u: Any) -> Any:
        drag, mass, v = z
        return jnp.array([drag, mass, v + (u[0] - drag * v * abs(v)) / mass - 9.81 * u[1]])

    def h(z: Any, u: Any) -> Any:
        return z[2:]

    P0, Q = jnp.diag(jnp.array([1e-5, 25.0, 1.0])), jnp.diag(jnp.array([0.0, 0.02, 1e-4]))
    return ParamsNLGSSM(jnp.array([0.004, 15.0, 15.0]), P0, f, Q, h, 0.04 * jnp.eye(1))
