"""A plant whose sensors and actuators are late."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.latency import (
    ON_TIME,
    CommandDelay,
    Latency,
    delayed,
    pushed,
    rows_needed,
)
from sfkd_jax.types import BODY, Control


class LateState(NamedTuple):
    """What is on its way: earlier states to the controller, and commands to the plant.

    Attributes:
        past: values at the last calls, newest last.
        sent: the last commands, newest last; NaN before the first one.
    """

    past: Float[Array, "time value"]
    sent: Float[Array, "step control"]


class Late(NamedTuple):
    """Late sensors and actuators, between a plant and its controller.

    Before the first call the vehicle drove straight on at its speed, and the first
    command acts at once.

    Attributes:
        sensors: delay of every observed value, in sampling periods; () for none.
        actuators: delays of the commands.
        dt: sampling period [s].
    """

    sensors: tuple[float, ...]
    actuators: CommandDelay
    dt: float

    @property
    def observed_ago(self) -> int:
        """Whole periods since the position that is observed."""
        return round(self.sensors[0]) if self.sensors else 0

    def init(self, values: Float[Array, " value"], controls: int = 2) -> LateState:
        """Return the state before the first call.

        Args:
            values: of the first call: pose, speed, further states, and the progress
                along the path.
            controls: number of them.
        """
        rows = rows_needed(self.sensors)
        moving = jnp.stack([jnp.cos(values[2]), jnp.sin(values[2])])
        way = self.dt * values[BODY.start]
        step = jnp.zeros_like(values).at[:2].set(way * moving).at[-1].set(way)
        ago = jnp.arange(rows, 0, -1)[:, None]
        return LateState(
            past=values - ago * step,
            sent=jnp.full((self.actuators.steps, controls), jnp.nan, dtype=float),
        )

    def observe(
        self, late: LateState, values: Float[Array, " value"]
    ) -> tuple[Float[Array, " value"], LateState]:
        """Return what arrives at a call, and the state with the values of now."""
        past = pushed(late.past, values)
        return delayed(past, self.sensors), late._replace(past=past)

    def actuate(self, late: LateState, command: Control) -> tuple[Control, LateState]:
        """Return what acts over the period after a call, and the state after it."""
        acting = self.actuators.acting(late.sent, command)
        return acting, late._replace(sent=pushed(late.sent, command))


def late_loop(latency: Latency, *, states: int, dt: float) -> Late:
    """Return the late sensors and actuators of a vehicle.

    Its observed values are the states, and then the progress along the path, which is
    as late as the position.

    Args:
        latency: of the vehicle.
        states: number of them.
        dt: sampling period [s].
    """
    if latency.is_none:
        return Late((), ON_TIME, dt)
    sized = latency.sized(states, 2)
    periods = sized.observation(dt)
    return Late((*periods, periods[0]), sized.actuators(dt), dt)
