"""The nominal model of the shield, and its comparison with the vehicle."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from sfkd_jax.control import all_finite
from sfkd_jax.driving.path_coordinates import LATERAL, PathState
from sfkd_jax.driving.path_following.laws._steady_turn import SteadyTurn
from sfkd_jax.driving.path_following.tasks._preview import Preview
from sfkd_jax.driving.path_following.wrappers._conditions import Conditions
from sfkd_jax.geometry import without_pose
from sfkd_jax.rollout import fold
from sfkd_jax.types import (
    BODY,
    Environment,
    Fiber,
    Key,
    Latent,
    Model,
    Params,
    Scalar,
)


class ShieldState(NamedTuple):
    """The wrapped controller and the nominal model between two control steps.

    Attributes:
        inner: state of the wrapped controller.
        latent: of the nominal model, in the fibre of `env`; 0 before the start.
        started: whether the nominal model is running, and the loop has been closed
            around the vehicle ever since. Otherwise it starts anew at the next
            measurement.
        env: environment of the last step, clipped to its box; NaN before the first one.
        offset: what the start adds to the bound of |e_y − ê_y| [m].
        rolling: bound of |e_y| at the next step, whatever steers [m]; NaN without one.
    """

    inner: Any
    latent: Latent
    started: Bool[Array, ""]
    env: Environment
    offset: Scalar
    rolling: Scalar


class Comparison(NamedTuple):
    """The nominal model of this step, after its comparison with the measurement.

    Attributes:
        state: with the nominal model in the fibre of the current environment, at the
            measured ξ if it starts anew.
        fiber: the fibre of the current environment.
        nominal_state: ξ of the nominal model, (coordinate,); NaN before its start.
        distance: |e_y − ê_y| [m]; NaN without a comparison.
        bound_exceeded: whether the distance exceeds what is allowed.
        outside_box: whether ξ, road or e is outside the conditions, or the law is not
            linear, as where the speed is far from that of the reference.
        env_inside: whether e is inside its box.
    """

    state: ShieldState
    fiber: Fiber
    nominal_state: PathState
    distance: Scalar
    bound_exceeded: Bool[Array, ""]
    outside_box: Bool[Array, ""]
    env_inside: Bool[Array, ""]


class NominalModel(NamedTuple):
    """A model that is driven with the inputs of the vehicle, without correction.

    It starts at a measurement. It starts anew where it was stopped, and where its
    distance from the vehicle exceeds the bound, which is then not that of this vehicle.

    Attributes:
        model: in path coordinates.
        conditions: where the certificate applies.
        tube: certified bound of |e_y − ê_y| [m]; infinite if none is known.
        noise_allowance: error of a measured e_y that is added to the tube [m].
        start_error: what a start at a measurement adds to the tube [m].
    """

    model: Model
    conditions: Conditions
    tube: Scalar | float
    noise_allowance: float
    start_error: float

    def zeros(self, key: Key, size: int, environment: int) -> Latent:
        """Return a latent of zeros, for ξ and e with these numbers of entries."""

        def encode(params: Params) -> Latent:
            fiber = self.model.fiber(params, jnp.zeros(environment))
            return self.model.encode(fiber, without_pose(jnp.zeros(size)))

        # Only shapes are evaluated.
        latent = jax.eval_shape(encode, jax.eval_shape(self.model.init, key))
        return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), latent)

    def compare(
        self,
        params: Params,
        before: ShieldState,
        xi: PathState,
        env: Environment,
        preview: Preview,
        turn: SteadyTurn,
    ) -> Comparison:
        """Compare the nominal model with a measurement, and start it if need be.

        Args:
            params: of the model.
            before: state after the last step.
            xi: measured ξ.
            env: measured e.
            preview: of the road, with what the gate says about the measurement.
            turn: of the law on this road. The model does not start where its control
                is not finite, and says nothing where it is not linear.
        """
        model = self.model
        inside = self.conditions.nearest(env)
        folded = fold(model, params)
        fiber = model.fiber(folded, inside)

        def unchanged() -> Latent:
            return before.latent

        def transported() -> Latent:
            old = model.fiber(folded, before.env)
            return model.transport(old, fiber, before.latent)

        latent = jax.lax.cond(jnp.all(inside == before.env), unchanged, transported)
        anchor = model.encode(fiber, without_pose(xi))
        readable = all_finite((anchor, turn.feedback(xi)))
        compared = before.started & preview.measured[LATERAL]
        distance = jnp.abs(xi - model.decode(fiber, latent)[BODY])[LATERAL]
        allowed = self.tube + self.noise_allowance + before.offset
        # Written so that a distance of NaN exceeds the bound.
        exceeded = compared & ~(distance <= allowed)
        # If the bound does not hold for this vehicle, all that follows is about a
        # nominal model that starts at the vehicle.
        starts = ~before.started | exceeded
        latent = jax.tree.map(partial(jnp.where, starts), anchor, latent)
        started = readable & all_finite(latent)
        env_inside = jnp.all(inside == env)
        covered = self.conditions.hold(xi, preview.road[0]) & env_inside
        covered &= turn.is_linear(xi)
        nominal = model.decode(fiber, latent)[BODY]
        return Comparison(
            state=before._replace(
                latent=latent,
                started=started,
                env=inside,
                offset=jnp.where(starts, self.start_error, before.offset),
            ),
            fiber=fiber,
            nominal_state=jnp.where(started, nominal, jnp.nan),
            distance=jnp.where(compared, distance, jnp.nan),
            bound_exceeded=exceeded,
            outside_box=started & ~covered,
            env_inside=env_inside,
        )
