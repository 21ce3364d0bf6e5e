"""The nominal model of the shield beside the measurement of a vehicle."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool

from sfkd_jax.control import Comparison, NominalModel, NominalState, all_finite
from sfkd_jax.driving.path_coordinates import LATERAL, PathState
from sfkd_jax.driving.path_following.laws._steady_turn import SteadyTurn
from sfkd_jax.driving.path_following.tasks._preview import Preview
from sfkd_jax.driving.path_following.wrappers._conditions import Conditions
from sfkd_jax.types import Environment, Params, Scalar


class ShieldState(NamedTuple):
    """The wrapped controller and the nominal model between two control steps.

    Attributes:
        inner: state of the wrapped controller.
        nominal: of the nominal model. While it is running, the loop has been closed
            around the vehicle.
        offset: what the start adds to the bound of |e_y − ê_y| [m].
        rolling: bound of |e_y| at the next step, whatever steers [m]; NaN without one.
    """

    inner: Any
    nominal: NominalState
    offset: Scalar
    rolling: Scalar


class Compared(NamedTuple):
    """The nominal model beside a measurement, and what it is good for.

    Attributes:
        with_vehicle: the comparison of |e_y − ê_y| [m].
        started: whether the nominal model is running.
        offset: what its start adds to the bound of |e_y − ê_y| [m].
        outside_box: whether ξ, road or e is outside the conditions, or the law is not
            linear, as where the speed is far from that of the reference.
        env_inside: whether e is inside its box.
    """

    with_vehicle: Comparison
    started: Bool[Array, ""]
    offset: Scalar
    outside_box: Bool[Array, ""]
    env_inside: Bool[Array, ""]


def compare(
    nominal_model: NominalModel,
    params: Params,
    before: ShieldState,
    xi: PathState,
    env: Environment,
    preview: Preview,
    turn: SteadyTurn,
    *,
    conditions: Conditions,
    allowed: Scalar,
    start_error: float,
) -> Compared:
    """Compare the nominal model with a measurement, and start it if need be.

    Args:
        nominal_model: with e_y as its output.
        params: of the model.
        before: state after the last step.
        xi: measured ξ.
        env: measured e.
        preview: of the road, with what the gate says about the measurement.
        turn: of the law on this road. The nominal model does not start where its
            control is not finite, and nothing is claimed where it is not linear.
        conditions: where the certificate applies.
        allowed: largest |e_y − ê_y|, apart from what its start adds [m].
        start_error: what a start at a measurement adds [m].
    """
    inside = conditions.nearest(env)
    nominal = nominal_model.carried(params, before.nominal, inside)
    compared = nominal_model.compare(
        nominal,
        xi,
        (allowed + before.offset)[None],
        started=before.nominal.started,
        measured=preview.measured[LATERAL],
    )
    started = all_finite((xi, turn.feedback(xi), compared.nominal.latent))
    env_inside = jnp.all(inside == env)
    covered = conditions.hold(xi, preview.road[0]) & env_inside & turn.is_linear(xi)
    return Compared(
        with_vehicle=compared,
        started=started,
        offset=jnp.where(compared.starts, start_error, before.offset),
        outside_box=started & ~covered,
        env_inside=env_inside,
    )
