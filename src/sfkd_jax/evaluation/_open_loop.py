"""Open-loop prediction errors of models by horizon, and a bicycle fitted to data."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sfkd_jax.geometry import HEADING, LATERAL, PATH_SPEED, wrap_angle
from sfkd_jax.rollout import in_batches, rollout, sliding_windows, state_errors
from sfkd_jax.types import (
    BODY,
    Control,
    Environment,
    Model,
    Params,
    State,
    Trajectory,
)

STEEP = 1.4
"""Largest steering angle [rad]; larger numbers are no angles."""


def open_loop(
    model: Model, params: Params, trajectories: Trajectory, *, horizon: int
) -> Float[Array, "horizon 4"]:
    """Return the RMSE of free-running predictions 1 … horizon steps ahead.

    Predictions start at every `horizon`-th step of each trajectory.

    Columns: along and across the true heading [m] (so that each axis means the same on
    every trajectory), yaw [rad], speed [m/s]. In path coordinates: 0, e_y [m], e_ψ
    [rad], speed [m/s].

    Args:
        model: that predicts.
        params: of the model.
        trajectories: held out from training.
        horizon: steps.
    """
    windows = sliding_windows(trajectories, length=horizon, stride=horizon)

    def squares(window: Trajectory) -> Float[Array, "horizon 4"]:
        predicted, true = rollout(model, params, window)[0], window.states[1:]
        if not model.along_path:
            return state_errors(predicted, true)[:, :4] ** 2
        gap = (predicted - true)[:, BODY]
        # Along a path nothing is predicted of the way along it.
        still, yaw = jnp.zeros(gap.shape[0]), wrap_angle(gap[:, HEADING])
        columns = [still, gap[:, LATERAL], yaw, gap[:, PATH_SPEED]]
        return jnp.column_stack(columns) ** 2

    return jnp.sqrt(jnp.mean(in_batches(squares, windows, size=128), axis=0))


@dataclass(frozen=True, eq=False)
class FittedBicycle:
    """A kinematic bicycle with parameters fitted to data.

        v̇ = a_0 + a_1 u_2 + a_2 v,   κ = k_0 + k_1 tan δ,   ψ̇ = v κ,
        ṗ = v (cos(ψ + β), sin(ψ + β)),   β = b_0 + b_1 κ

    Attributes:
        acceleration: (a_0, a_1, a_2).
        curvature: (k_0, k_1); 1/k_1 is the wheelbase [m].
        slip: (b_0, b_1); b_1 is the distance of the position from the rear axle [m].
        is_angle: whether u_1 is a steering angle δ; otherwise it replaces tan δ.
        dt: sampling period [s].
    """

    acceleration: Float[np.ndarray, " 3"]
    curvature: Float[np.ndarray, " 2"]
    slip: Float[np.ndarray, " 2"]
    is_angle: bool
    dt: float

    @classmethod
    def fit(cls, train: Trajectory, *, dt: float) -> FittedBicycle:
        """Fit by least squares to the single steps of a batch of trajectories."""
        states = np.asarray(train.states, dtype=np.float64)[..., :4]
        before, after = states[:, :-1].reshape(-1, 4), states[:, 1:].reshape(-1, 4)
        controls = np.asarray(train.controls, dtype=np.float64).reshape(-1, 2)
        # Logs may hold a steering command in other units than radians.
        is_angle = bool(np.abs(controls[:, 0]).max() < STEEP)
        steering = np.tan(controls[:, 0]) if is_angle else controls[:, 0]
        ones, speed = np.ones(len(before)), 0.5 * (before[:, 3] + after[:, 3])
        # A step turns by less than half a turn, so the difference is wrapped.
        turned = np.mod(after[:, 2] - before[:, 2] + np.pi, 2 * np.pi) - np.pi
        course = before[:, 2] + 0.5 * turned
        moved = after[:, :2] - before[:, :2]
        across = -np.sin(course) * moved[:, 0] + np.cos(course) * moved[:, 1]

        def regress(features: list[Any], target: Any) -> np.ndarray:
            return np.linalg.lstsq(np.column_stack(features), target, rcond=None)[0]

        # Three linear regressions in a row: curvature enters that of the slip.
        acceleration = regress(
            [ones, controls[:, 1], before[:, 3]], (after[:, 3] - before[:, 3]) / dt
        )
        curvature = regress([speed, speed * steering], turned / dt)
        kappa = curvature[0] + curvature[1] * steering
        slip = regress([speed, speed * kappa], across / dt)
        return cls(acceleration, curvature, slip, is_angle, dt)

    def step(self, state: State, control: Control, env: Environment) -> State:
        """The midpoint rule; states beyond the speed are left as they are."""
        del env
        a, k, b = map(jnp.asarray, (self.acceleration, self.curvature, self.slip))
        steering = jnp.tan(control[0]) if self.is_angle else control[0]
        change = self.dt * (a[0] + a[1] * control[1] + a[2] * state[3])
        curvature = k[0] + k[1] * steering
        length = self.dt * (state[3] + 0.5 * change)
        turned = length * curvature
        course = state[2] + 0.5 * turned + b[0] + b[1] * curvature
        x, y = length * jnp.cos(course), length * jnp.sin(course)
        return state.at[:4].add(jnp.stack([x, y, turned, change]))
