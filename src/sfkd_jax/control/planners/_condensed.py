"""Condensed linear prediction along a path: lifted states eliminated, squared cost."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.control.tasks._task import PlanningStart
from sfkd_jax.geometry import between, compose
from sfkd_jax.types import BODY, POSE, LinearPredictor, Reference, Scalar, State


class Prediction(NamedTuple):
    """The condensed prediction x_k = free_k + (gain u)_k, k = 1 … T.

    Attributes:
        free: response without control.
        gain: response to the stacked controls u_0 … u_{T-1}.
    """

    free: Float[Array, "horizon state"]
    gain: Float[Array, "horizon state inputs"]


class LeastSquares(NamedTuple):
    """The cost Σ_i w_i (g_iᵀ u + o_i)² of the stacked controls u.

    Attributes:
        gains: g_i.
        offsets: o_i.
        weights: w_i.
    """

    gains: Float[Array, "row inputs"]
    offsets: Float[Array, " row"]
    weights: Float[Array, " row"]


def condensed_cost(
    prediction: Prediction,
    start: State,
    speeds: Float[Array, " horizon"],
    previous: PlanningStart,
    *,
    weights: Float[Array, " term"],
    step_weights: Float[Array, " horizon"],
    dt: float,
) -> LeastSquares:
    """Return `tracking_cost` as squares of affine functions of the stacked controls.

    Args:
        prediction: of the states along the path.
        start: state along the path now.
        speeds: of the reference [m/s].
        previous: control, from which the first steering rate counts.
        weights: of lateral error, course, speed, steering rate and effort.
        step_weights: factor on all weights of each step.
        dt: sampling period [s].
    """
    horizon = speeds.shape[0]
    channels = jnp.eye(2 * horizon).reshape(horizon, 2, 2 * horizon)
    steering, drive = channels[:, 0], channels[:, 1]
    side, side_free = prediction.gain[:, 1], prediction.free[:, 1]
    travelled = speeds * dt + 1e-3
    gains = (
        side,
        jnp.diff(side, axis=0, prepend=0.0) / travelled[:, None],
        prediction.gain[:, 3],
        jnp.diff(steering, axis=0, prepend=0.0) / dt,
        drive,
    )
    offsets = (
        side_free,
        jnp.diff(side_free, prepend=start[1]) / travelled,
        prediction.free[:, 3] - speeds,
        jnp.zeros(horizon).at[0].set(-previous.control[0] / dt),
        jnp.zeros(horizon),
    )
    # Before the first control there is no steering rate.
    charged = (weights[:, None] * step_weights).at[3, 0].multiply(previous.known)
    return LeastSquares(
        jnp.concatenate(gains), jnp.concatenate(offsets), charged.ravel()
    )


def _curvature_of_steps(
    curvature: Float[Array, " horizon"],
) -> Float[Array, " horizon"]:
    """Mean curvature of each step; the first step has that of the first point."""
    return jnp.concatenate([curvature[:1], 0.5 * (curvature[1:] + curvature[:-1])])


def condense(
    predictor: LinearPredictor, start: State, curvature: Float[Array, " horizon"]
) -> Prediction:
    """Eliminate the lifted state: free response and Toeplitz matrix of C Aᵏ B.

    Args:
        predictor: of the environment.
        start: state along the path now.
        curvature: of the path at each reference point [1/m].
    """
    horizon = curvature.shape[0]

    def respond(
        carry: tuple[Array, Array], kappa: Scalar
    ) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        z, impulse = carry
        z = predictor.A @ z + predictor.d * kappa + predictor.c
        return (z, predictor.A @ impulse), (
            predictor.C @ z + predictor.o,
            predictor.C @ impulse,
        )

    _, (free, impulses) = jax.lax.scan(
        respond, (predictor.lift(start), predictor.B), _curvature_of_steps(curvature)
    )
    lag = jnp.arange(horizon)[:, None] - jnp.arange(horizon)
    gain = jnp.where((lag >= 0)[:, :, None, None], impulses[jnp.maximum(lag, 0)], 0.0)
    return Prediction(
        free, gain.transpose(0, 2, 1, 3).reshape(horizon, start.shape[0], -1)
    )


def to_world(
    along_path: Float[Array, "horizon state"],
    observation: State,
    reference: Reference,
    curvature: Float[Array, " horizon"],
) -> Float[Array, "horizon state"]:
    """Map predictions to the world by the circle that touches each reference point.

    Args:
        along_path: progress, lateral distance, relative yaw and body state.
        observation: state in the world now.
        reference: x, y, yaw, speed of each step.
        curvature: of the path at each reference point [1/m].
    """
    behind = between(reference[0, POSE], observation[POSE])[0]
    steps = jnp.hypot(*jnp.diff(reference[:, :2], axis=0).T)
    passed = jnp.concatenate([jnp.zeros(1), jnp.cumsum(steps)])

    def one_step(
        state: State, point: Float[Array, " 4"], kappa: Scalar, travelled: Scalar
    ) -> State:
        ahead = behind + state[0] - travelled
        foot = jnp.stack([ahead, 0.5 * kappa * ahead**2, kappa * ahead])
        aside = jnp.stack([jnp.zeros(()), state[1], state[2]])
        return jnp.concatenate([compose(point[:3], compose(foot, aside)), state[BODY]])

    return jax.vmap(one_step)(along_path, reference, curvature, passed)
