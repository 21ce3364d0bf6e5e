"""Fixed-step integrators with control and environment held over dt."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from sfkd_jax.types import Control, Environment, State, Step


def rk4(derivative: Step, *, dt: float, substeps: int = 1) -> Step:
    """Return a step by the classical Runge-Kutta method of order 4.

    Args:
        derivative: dx/dt = f(x, u, e).
        dt: sampling period [s].
        substeps: integration steps per sampling period.
    """
    h = dt / substeps

    def step(state: State, control: Control, env: Environment) -> State:
        def substep(x: State, _: None) -> tuple[State, None]:
            k1 = derivative(x, control, env)
            k2 = derivative(x + 0.5 * h * k1, control, env)
            k3 = derivative(x + 0.5 * h * k2, control, env)
            k4 = derivative(x + h * k3, control, env)
            return x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4), None

        return jax.lax.scan(
            substep, jnp.asarray(state), None, length=substeps, unroll=True
        )[0]

    return step
