"""The tests of a vehicle and its sensors while it drives."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sfkd_jax.driving.path_coordinates import PathState
from sfkd_jax.driving.path_following.wrappers._delays import DelayEstimator, DelayState
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
    delay: DelayState | None


class MeasurementTests(NamedTuple):
    """What raises an alarm, and what estimates the latency; each is optional.

    Attributes:
        innovation: of the vehicle against its nominal model; it takes into account what
            the controller estimates.
        odometry: of the position against the speed.
        delay: by how much the commands act later than stated.
    """

    innovation: InnovationTest | None = None
    odometry: OdometryTest | None = None
    delay: DelayEstimator | None = None

    def init(self) -> TestsState:
        """Return the state before the first measurement."""
        return TestsState(
            innovation=None if self.innovation is None else self.innovation.init(),
            odometry=None if self.odometry is None else self.odometry.init(),
            delay=None if self.delay is None else self.delay.init(),
        )

    def later(self, state: TestsState) -> Scalar:
        """Return by how many periods commands act later than stated, as it seems."""
        if self.delay is None or state.delay is None:
            return jnp.zeros(())
        return self.delay.delay(state.delay)

    def largest_turn(self, state: TestsState) -> Scalar:
        """Return the largest innovation of the heading that noise explains [rad].

        After an alarm the model is no measure any more, and it is infinite.
        """
        if self.innovation is None or state.innovation is None:
            return jnp.asarray(jnp.inf)
        largest = self.innovation.largest_turn(state.innovation.level)
        return jnp.where(state.innovation.alarm, jnp.inf, largest)

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
        changed = jnp.asarray(False)
        if self.delay is not None and state.delay is not None:
            before = self.later(state)
            state = state._replace(delay=self.delay.update(state.delay, xi, used))
            changed = self.later(state) != before
        if self.innovation is not None and state.innovation is not None:
            # What it has seen until now was under another delay.
            innovation = self.innovation.anew(state.innovation, changed)
            seen = jnp.full(xi.shape, used)
            after, largest = self.innovation.update(innovation, xi, seen)
            state = state._replace(innovation=after)
            alarm = after.alarm
        if self.odometry is not None and state.odometry is not None:
            moved, statistic = self.odometry.update(state.odometry, observation, used)
            state = state._replace(odometry=moved)
            largest = jnp.fmax(largest, statistic)
            alarm = alarm | moved.alarm
        return state, largest, alarm

    def expect(
        self,
        state: TestsState,
        readings: Float[Array, " chart"],
        observers: Float[Array, "delay coordinate"],
        level: Scalar,
    ) -> TestsState:
        """Return the state with what is expected of the next measurement.

        Args:
            state: after this measurement.
            readings: for the test of the innovations; NaN if nothing is to be compared.
            observers: ξ by each observer of the delay.
            level: of the prediction, see `SteadyTurn.level`.
        """
        if state.innovation is not None:
            innovation = state.innovation._replace(expected=readings, level=level)
            state = state._replace(innovation=innovation)
        if state.delay is not None:
            delay = state.delay._replace(expected=observers, level=level)
            state = state._replace(delay=delay)
        return state
