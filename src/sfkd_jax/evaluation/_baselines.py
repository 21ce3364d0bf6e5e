"""Naive predictors, against which the open-loop errors of a model are judged."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sfkd_jax.evaluation._open_loop import prediction_rmse
from sfkd_jax.geometry import CURVATURE, HEADING, PATH_SPEED, path_step, wrap_angle
from sfkd_jax.geometry import path_state as as_path_state
from sfkd_jax.types import BODY, Control, Environment, Scalar, State, Step, Trajectory

STEEP = 1.4
"""Largest steering angle [rad]; larger numbers are no angles."""

Predictor: TypeAlias = Callable[[Trajectory], Float[Array, "horizon state"]]
"""Window of a trajectory -> its states after the first, predicted."""


class FittedBicycle(NamedTuple):
    """A kinematic bicycle with parameters fitted to data.

        v̇ = a_0 + a_1 u_2 + a_2 v,   κ = k_0 + k_1 tan δ,   ψ̇ = v κ,
        ṗ = v (cos(ψ + β), sin(ψ + β)),   β = b_0 + b_1 κ

    Attributes:
        acceleration: (a_0, a_1, a_2).
        curvature: (k_0, k_1); 1/k_1 is the wheelbase [m].
        slip: (b_0, b_1); b_1 is the distance of the position from the rear axle [m].
        is_angle: whether u_1 is a steering angle δ; otherwise it replaces tan δ.
    """

    acceleration: Float[np.ndarray, " 3"]
    curvature: Float[np.ndarray, " 2"]
    slip: Float[np.ndarray, " 2"]
    is_angle: bool


def baselines(
    train: Trajectory,
    *,
    nominal: Step,
    dt: float,
    horizon: int,
    along_path: bool = False,
) -> dict[str, Callable[[Trajectory], Float[Array, "horizon 4"]]]:
    """Return naive predictors as trajectories -> RMSE on the windows of `open_loop`.

    "constant_velocity" keeps course and speed, "constant_turn" also the yaw rate,
    measured over the first step. "kinematic_bicycle" is the nominal model,
    "fitted_bicycle" one with parameters fitted to the training data (not in path
    coordinates, where controls are perturbations of a law).

    Args:
        train: for the fit.
        nominal: step of the kinematic bicycle on these states and controls.
        dt: sampling period [s].
        horizon: steps.
        along_path: whether states are those of `path_frame`.

    Raises:
        ValueError: the horizon does not fit the trajectories.
    """
    turn = _turn_along_path if along_path else _turn
    predictors: dict[str, Predictor] = {
        "constant_velocity": partial(_hold, turn(dt), lambda window: jnp.zeros(())),
        "constant_turn": partial(
            _hold, turn(dt), partial(_first_yaw_rate, dt=dt, along_path=along_path)
        ),
        "kinematic_bicycle": partial(_simulate, nominal),
    }
    # Controls along a path are perturbations of a law: no bicycle explains them.
    if not along_path:
        fitted = bicycle_step(fit_bicycle(train, dt=dt), dt=dt)
        predictors["fitted_bicycle"] = partial(_simulate, fitted)
    return {
        name: partial(prediction_rmse, predict, horizon=horizon, along_path=along_path)
        for name, predict in predictors.items()
    }


def fit_bicycle(train: Trajectory, *, dt: float) -> FittedBicycle:
    """Fit a kinematic bicycle by least squares on the single steps of trajectories.

    Args:
        train: a batch, states (trajectory, time + 1, state).
        dt: sampling period [s].
    """
    states = np.asarray(train.states, dtype=np.float64)[..., :4]
    before, after = (part.reshape(-1, 4) for part in (states[:, :-1], states[:, 1:]))
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
    acceleration = _least_squares(
        [ones, controls[:, 1], before[:, 3]], (after[:, 3] - before[:, 3]) / dt
    )
    curvature = _least_squares([speed, speed * steering], turned / dt)
    kappa = curvature[0] + curvature[1] * steering
    slip = _least_squares([speed, speed * kappa], across / dt)
    return FittedBicycle(acceleration, curvature, slip, is_angle)


def bicycle_step(bicycle: FittedBicycle, *, dt: float) -> Step:
    """Return the step of a fitted bicycle, by the midpoint rule.

    States beyond the speed are left as they are.

    Args:
        bicycle: fitted.
        dt: sampling period [s].
    """
    a, k, b = (jnp.asarray(part) for part in bicycle[:3])

    def step(state: State, control: Control, env: Environment) -> State:
        del env
        steering = jnp.tan(control[0]) if bicycle.is_angle else control[0]
        change = dt * (a[0] + a[1] * control[1] + a[2] * state[3])
        curvature = k[0] + k[1] * steering
        length = dt * (state[3] + 0.5 * change)
        turned = length * curvature
        course = state[2] + 0.5 * turned + b[0] + b[1] * curvature
        x, y = length * jnp.cos(course), length * jnp.sin(course)
        return state.at[:4].add(jnp.stack([x, y, turned, change]))

    return step


def _least_squares(
    features: list[Float[np.ndarray, " sample"]], target: Float[np.ndarray, " sample"]
) -> Float[np.ndarray, " feature"]:
    """Coefficients of a linear regression."""
    return np.linalg.lstsq(np.column_stack(features), target, rcond=None)[0]


def _simulate(step: Step, window: Trajectory) -> Float[Array, "horizon state"]:
    """States of a step function from the first state of a window on."""

    def advance(
        state: State, given: tuple[Control, Environment]
    ) -> tuple[State, State]:
        after = step(state, *given)
        return after, after

    return jax.lax.scan(advance, window.states[0], (window.controls, window.envs))[1]


def _hold(
    step: Step, yaw_rate: Callable[[Trajectory], Scalar], window: Trajectory
) -> Float[Array, "horizon state"]:
    """States at constant speed and yaw rate; the yaw rate is given as control 0."""
    held = jnp.full_like(window.controls[:, :1], yaw_rate(window))
    controls = jnp.concatenate([held, window.controls[:, 1:]], axis=1)
    return _simulate(step, window._replace(controls=controls))


def _turn(dt: float) -> Step:
    """A step on a circle: control 0 is the yaw rate, the others are not used."""

    def step(state: State, control: Control, env: Environment) -> State:
        del env
        half = 0.5 * control[0] * dt
        length, course = state[3] * dt * jnp.sinc(half / jnp.pi), state[2] + half
        move = [length * jnp.cos(course), length * jnp.sin(course), 2.0 * half]
        return state.at[:3].add(jnp.stack(move))

    return step


def _turn_along_path(dt: float) -> Step:
    """The same step in path coordinates; the curvature is that of the controls."""
    follow = path_step(_turn(dt))

    def step(state: State, control: Control, env: Environment) -> State:
        return as_path_state(follow(state[BODY], control, control[CURVATURE], env))

    return step


def _first_yaw_rate(window: Trajectory, *, dt: float, along_path: bool) -> Scalar:
    """Mean yaw rate of the first step of a window [rad/s]."""
    before, after = window.states[0], window.states[1]
    if not along_path:
        return wrap_angle(after[2] - before[2]) / dt
    turned = wrap_angle(after[BODY][HEADING] - before[BODY][HEADING]) / dt
    return turned + window.controls[0, CURVATURE] * before[BODY][PATH_SPEED]
