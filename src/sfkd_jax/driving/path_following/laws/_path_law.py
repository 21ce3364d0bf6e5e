"""A path-following law as tables of steady turns and feedback gains."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.driving.path_coordinates import PATH_SPEED, PathState
from sfkd_jax.driving.path_following.laws._steady_turn import SteadyTurn
from sfkd_jax.geometry import put
from sfkd_jax.ranges import Positive
from sfkd_jax.tables import corners, interpolated
from sfkd_jax.types import Control, Environment, Scalar

TEXTBOOK = {
    "stanley": (0.5, 1.0, 2.0, 4.0, 8.0),
    "pure_pursuit": (0.3, 0.5, 0.8, 1.2, 2.0),
}
"""Values of the one constant of a steering law from a textbook, see `textbook_law`."""


class PathLaw(NamedTuple):
    """Feedback around steady turns, tabulated over a = v² κ, v and e.

        u = u*(a, v, e) − K(a, v, e) (ξ − ξ*(a, v, e))

    Interpolation is linear. The tables are over the lateral acceleration a of a turn
    and not over κ, because the limit of the tyres is then a box. The law is a pytree of
    arrays, so it can be stored beside the weights that were learned around it.

    Attributes:
        low: lower ends of the axes (a [m/s²], v_ref [m/s], e_1, …).
        high: upper ends of the axes; every axis is divided evenly.
        perturbation: largest |ν| that data and planners add to u [rad, control unit],
            (2,).
        state: ξ* of the steady turns, (*axes, coordinate).
        control: u*, (*axes, 2).
        gain: K, (*axes, 2, coordinate).
    """

    low: Float[Array, " axis"]
    high: Float[Array, " axis"]
    perturbation: Float[Array, " 2"]
    state: Float[Array, "*axes coordinate"]
    control: Float[Array, "*axes 2"]
    gain: Float[Array, "*axes 2 coordinate"]

    def turn(self, curvature: Scalar, speed: Scalar, env: Environment) -> SteadyTurn:
        """Interpolate the steady turn; outside the axes, the value at their ends.

        Args:
            curvature: κ [1/m].
            speed: reference speed [m/s], also that of the steady turn; below 0 it
                counts as 0, since the tables are about driving forward.
            env: e.
        """
        speed = jnp.maximum(speed, 0.0)
        sharpest = self.high[0]
        counts = self.control.shape[:-1]
        # The limit of the tyres has the same v² κ at every speed of the table.
        at = jnp.concatenate([jnp.stack([curvature * speed**2, speed]), env])
        rows, weights = corners(at, self.low, self.high, counts)

        axes = len(at)
        state = interpolated(self.state, rows, weights, axes)
        control = interpolated(self.control, rows, weights, axes)
        gain = interpolated(self.gain, rows, weights, axes)
        # Below the speeds of the table less drive keeps the speed, and at rest none
        # does.
        share = jnp.clip(speed / self.low[1], 0.0, 1.0)
        control = put(control, 1, control[1] * share)
        # The sharpest turns of the table, to either side.
        right, left = self._steerings(slice(None, None, counts[0] - 1), at[1:])
        tabled_speed = jnp.clip(speed, self.low[1], self.high[1])
        slope = 0.5 * (left - right) * tabled_speed**2 / sharpest
        return SteadyTurn(
            state=put(state, PATH_SPEED, speed),
            control=control,
            gain=gain,
            grip=jnp.stack([slope, sharpest]),
        )

    def curvature(self, steering: Scalar, speed: Scalar, env: Environment) -> Scalar:
        """Return κ of the steady turn with this steering; NaN beyond the table."""
        steerings = self._steerings(slice(None), jnp.concatenate([speed[None], env]))
        turns = jnp.linspace(self.low[0], self.high[0], len(steerings))
        turn = jnp.interp(steering, steerings, turns, left=jnp.nan, right=jnp.nan)
        return turn / speed**2

    def _steerings(self, turns: slice, at: Array) -> Float[Array, " turn"]:
        """Return the steering of some of the tabled v² κ, at a speed and e.

        Args:
            turns: rows of the axis of v² κ.
            at: (speed, *e).
        """
        counts = self.control.shape[1:-1]
        table = self.control[turns, ..., 0]
        rows, weights = corners(at, self.low[1:], self.high[1:], counts)
        return table.reshape(len(table), -1)[:, rows] @ weights

    def __call__(
        self, xi: PathState, curvature: Scalar, speed: Scalar, env: Environment
    ) -> Control:
        """Return u, without any limit."""
        return self.turn(curvature, speed, env).feedback(xi)


def law_from_arrays(arrays: Mapping[str, Any]) -> PathLaw:
    """Return the law from a dictionary of arrays, such as `law._asdict()`."""
    return PathLaw(*jax.device_put([arrays[name] for name in PathLaw._fields]))


def textbook_law(
    law: PathLaw, name: str, constant: float, *, wheelbase: Positive
) -> PathLaw:
    """Return a law with the steering of a textbook in place of its gains.

        "stanley":       δ = δ* − ψ − k (e_y + ½ L ψ) / v
        "pure_pursuit":  δ = δ* − 2 L (e_y + T v ψ) / (T v)²

    ψ = e_ψ − e_ψ*. Here both laws are linear in the errors, which are small along a
    path. Stanley's law steers the front axle, half a wheelbase ahead of the position.

    Args:
        law: whose steady turns and drive are used.
        name: one of `TEXTBOOK`.
        constant: k [1/s], or the time T [s] to the point that is pursued.
        wheelbase: L [m].

    Source: Hoffmann et al. (2007); Coulter (1992).
    """
    axes = law.gain.ndim - 2
    speed = jnp.linspace(law.low[1], law.high[1], law.gain.shape[1])
    if name == "stanley":
        lateral = constant / speed
        heading = 1.0 + 0.5 * wheelbase * lateral
    else:
        lateral = 2.0 * wheelbase / (constant * speed) ** 2
        heading = constant * speed * lateral
    gain = law.gain
    zero = jnp.zeros_like(speed)
    steering = [lateral, heading, *[zero] * (gain.shape[-1] - 2)]
    rows = jnp.stack(steering, -1).reshape(1, -1, *[1] * (axes - 2), gain.shape[-1])
    return law._replace(gain=gain.at[..., 0, :].set(rows))
