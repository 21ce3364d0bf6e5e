"""The tests of a vehicle and its sensors while it drives."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool

from sfkd_jax.driving.path_coordinates import PathState
from sfkd_jax.driving.path_following.wrappers._innovations import (
    InnovationState,
    InnovationTest,
)
from sfkd_jax.driving.path_following.wrappers._odometry import (
    OdometryState,
    OdometryTest,
)
from sfkd_jax.types import Scalar, State


class TestsState(NamedTuple):
    """What the tests carry from one control step to the next; None without a test."""

    innovation: InnovationState | None
    odometry: OdometryState | None


class MeasurementTests(NamedTuple):
    """What raises an alarm; each test is optional.

    Attributes:
        innovation: of the vehicle against its nominal model; it takes into account what
            the controller estimates.
        odometry: of the position against the speed.
    """

    innovation: InnovationTest | None = None
    odometry: OdometryTest | None = None

    def later(self, state: TestsState) -> Scalar:
        """Return by how many periods commands act later than stated, as it seems."""
        if self.innovation is None or state.innovation is None:
            return jnp.zeros(())
        return jnp.asarray(self.innovation.later)[state.innovation.delay]

    def init(self) -> TestsState:
        """Return the state before the first measurement."""
        return TestsState(
            innovation=None if self.innovation is None else self.innovation.init(),
            odometry=None if self.odometry is None else self.odometry.init(),
        )

    def update(
        self,
        state: TestsState,
        xi: PathState,
        observation: State,
        used: Bool[Array, ""],
    ) -> tuple[TestsState, Scalar, Bool[Array, ""]]:
        """Return the state after a measurement, the largest statistic, and any alarm.

        The statistic is NaN without a test.

        Args:
            state: after the last step.
            xi: measured ξ.
            observation: in the world.
            used: whether all of it is measured, one period after the last one.
        """
        largest = jnp.asarray(jnp.nan)
        alarm = jnp.asarray(False)
        if self.innovation is not None and state.innovation is not None:
            seen = jnp.full(xi.shape, used)
            after, largest = self.innovation.update(state.innovation, xi, seen)
            state = state._replace(innovation=after)
            alarm = after.alarm
        if self.odometry is not None and state.odometry is not None:
            moved, statistic = self.odometry.update(state.odometry, observation, used)
            state = state._replace(odometry=moved)
            largest = jnp.fmax(largest, statistic)
            alarm = alarm | moved.alarm
        return state, largest, alarm
