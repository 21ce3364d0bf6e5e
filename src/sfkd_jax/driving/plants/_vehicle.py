"""The `Vehicle` record, what all plants share, and a loop around the speed."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.driving.plants._variables import (
    ACCELERATION,
    CAR_SIZE,
    FRICTION_AND_WIND,
    STEERING,
    Size,
)
from sfkd_jax.rollout import runge_kutta
from sfkd_jax.types import GRAVITY, Control, Environment, Scalar, State, Step
from sfkd_jax.variables import ControlVariable, EnvironmentVariable, StateVariable

CAR_CONTROLS = (
    STEERING._replace(low=-0.5, high=0.5),
    ACCELERATION._replace(low=-6.0, high=3.0),
)
"""The controls of both benchmark cars."""
SPEED_RANGE = (0.0, 25.0)
"""Range of speed commands and of reference speeds [m/s]."""


class Vehicle(NamedTuple):
    """A plant sampled at dt.

    Attributes:
        name: of the plant.
        dt: sampling period [s].
        wheelbase: [m].
        states: pose first, then the body state.
        controls: steering first. They may lack limits if there is no step.
        step: (x, u, e) -> x one sampling period later.
        nominal: the same for the textbook kinematic bicycle, which knows neither
            friction nor wind.
        nominal_derivative: dx/dt of that bicycle, for models that add to it.
        wind_force: c_w of `side_force` [N s²/m²].
        environment: the entries of e.
        size: of the body.
        speed_loop: whether u_2 is a speed command [m/s] instead of an acceleration
            [m/s²].
        simulated: whether there is a step; False for a vehicle that is known from logs
            alone.
        derivative: dx/dt of the plant before any wrapper; None where only its step is
            known.
        hidden: number of further entries of the state of `step`, after `states`. No
            sensor shows them, and they begin at 0.
    """

    name: str
    dt: float
    wheelbase: float
    states: tuple[StateVariable, ...]
    controls: tuple[ControlVariable, ...]
    step: Step
    nominal: Step
    nominal_derivative: Step
    wind_force: float
    environment: tuple[EnvironmentVariable, ...] = FRICTION_AND_WIND
    size: Size = CAR_SIZE
    speed_loop: bool = False
    simulated: bool = True
    derivative: Step | None = None
    hidden: int = 0

    def whole(self, state: State) -> Float[Array, " whole"]:
        """Return a state at the start of a run, with what is hidden, for `step`."""
        return jnp.concatenate([state, jnp.zeros(self.hidden, state.dtype)])

    def shown(self, state: Float[Array, " whole"]) -> State:
        """Return the entries of a state of `step` that sensors show."""
        return state[: len(self.states)]

    def forgetting(self) -> Vehicle:
        """Return the vehicle with its hidden states at 0 before every step.

        Without hidden states it is the same vehicle.
        """

        def step(state: State, control: Control, env: Environment) -> State:
            return self.shown(self.step(self.whole(state), control, env))

        return self._replace(step=step, hidden=0) if self.hidden else self

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the states."""
        return tuple(state.name for state in self.states)

    @property
    def sensor_noise(self) -> tuple[float, ...]:
        """Standard deviations of the sensors, one per state; 0 for an exact sensor."""
        return tuple(state.deviation for state in self.states)

    @property
    def control_low(self) -> tuple[float, ...]:
        """Lower limits of the actuators; () if they are unknown."""
        return tuple(
            control.low for control in self.controls if control.low is not None
        )

    @property
    def control_high(self) -> tuple[float, ...]:
        """Upper limits of the actuators; () if they are unknown."""
        return tuple(
            control.high for control in self.controls if control.high is not None
        )


def side_force(wind: Scalar, *, wind_force: float) -> Scalar:
    """Return the lateral force of a side wind on the body, F = c_w w|w| [N]."""
    # w|w| instead of w²: wind from the other side pushes to the other side.
    return wind_force * wind * jnp.abs(wind)


def equivalent_wind(wind: Scalar, force: Scalar, *, wind_force: float) -> Scalar:
    """Return the wind w' [m/s] with c_w w'|w'| = c_w w|w| + F.

    Args:
        wind: w [m/s].
        force: F [N].
        wind_force: c_w [N s²/m²].
    """
    # Forces may be added. Winds may not, since the force is a signed square of them.
    total = side_force(wind, wind_force=wind_force) + force
    # Without a force the wind is returned as it is, so that an episode without side
    # forces stays the same to the last bit.
    return jnp.where(
        force == 0.0, wind, jnp.sign(total) * jnp.sqrt(jnp.abs(total) / wind_force)
    )


def resistance(speed: Scalar, *, mass: float, drag: float, rolling: float) -> Scalar:
    """Return the deceleration by air drag and rolling resistance [m/s²].

        ρ C_d A v²/(2m) + c_rr g tanh(v / 0.2 m/s)

    Args:
        speed: v [m/s].
        mass: m [kg].
        drag: ρ C_d A / 2 [N s²/m²].
        rolling: c_rr [-].
    """
    # The tanh makes the rolling resistance vanish smoothly at rest.
    return drag * speed**2 / mass + rolling * GRAVITY * jnp.tanh(speed / 0.2)


def nominal_derivative(length: float, rear_length: float, *, states: int = 4) -> Step:
    """Return dx/dt of the kinematic bicycle without friction or wind.

        κ = tan δ / L,   β = l_r κ,   ẋ = (v cos(yaw + β), v sin(yaw + β), v κ, a)

    Args:
        length: wheelbase L [m].
        rear_length: l_r, from the rear axle to the centre of mass [m].
        states: number of states. Those after (p_x, p_y, yaw, v) are constant.
    """

    def derivative(state: State, control: Control, env: Environment) -> State:
        yaw = state[2]
        speed = state[3]
        # Without slip both wheels turn about the same centre: κ = tan δ / L.
        curvature = jnp.tan(control[0]) / length
        # The centre of mass moves at the angle β ≈ l_r κ to the car, for small angles.
        course = yaw + rear_length * curvature
        x_rate = speed * jnp.cos(course)
        y_rate = speed * jnp.sin(course)
        rates = jnp.stack([x_rate, y_rate, speed * curvature, control[1]])
        return jnp.concatenate([rates, jnp.zeros(states - 4)])

    return derivative


def rk4(derivative: Step, *, dt: float, substeps: int = 1) -> Step:
    """Return a step by the Runge-Kutta method of order 4, with v ≥ 0 after every step.

    Brakes stop a car and do not reverse it. The derivative is therefore evaluated at
    max(v, 0): a car whose v falls below 0 within a step stands still, and neither its
    position nor its yaw moves backwards.

    Args:
        derivative: (x, u, e) -> dx/dt.
        dt: sampling period [s].
        substeps: integration steps per sampling period.
    """
    h = dt / substeps

    def without_reversing(state: State) -> State:
        # Entry 3 is the speed of every plant. v_y and others may be negative.
        return jnp.where((jnp.arange(state.shape[0]) == 3) & (state < 0.0), 0.0, state)

    def step(state: State, control: Control, env: Environment) -> State:
        def state_derivative(x: State) -> State:
            # In every stage: one at v < 0 would move the position backwards.
            return derivative(without_reversing(x), control, env)

        def substep(x: State, _: None) -> tuple[State, None]:
            return runge_kutta(state_derivative, x, h), None

        state = jnp.asarray(state)
        # The loop is unrolled, since for a few substeps its overhead would exceed the
        # cost of the steps.
        after, _ = jax.lax.scan(substep, state, None, length=substeps, unroll=True)
        return without_reversing(after)

    return step
