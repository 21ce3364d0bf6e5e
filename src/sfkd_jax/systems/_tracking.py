"""A system relative to a reference that moves."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from sfkd_jax.geometry import rotate, wrap_angle
from sfkd_jax.systems._frame import Tracking
from sfkd_jax.systems._system import System
from sfkd_jax.types import BODY, Control, Environment, Frame, Key, State

ReferenceState: TypeAlias = Float[Array, " reference"]
"""The states that the reference has, in the order of `Tracking.followed`."""
Inputs: TypeAlias = Float[Array, " inputs"]
"""ρ: the last derivative of each chain, then the states of the reference with a range.
"""
Error: TypeAlias = Float[Array, " state"]
"""ξ: the state less that of the reference, where the reference has it."""
INVARIANCE = 1e-3
"""Largest change of a step by what should not matter, relative to the step."""
BESIDE = 0.05
"""Share of the range of a rate by which a reference may differ from its chains."""
PLACES = 8
"""Number of places at which the invariance is tried."""
ROUNDING = 1e-9
"""Change of a step that is none."""
LENGTH = 0.1
"""What half the width of an entry of ξ counts in a training loss, in place of metres.
"""


@dataclass(frozen=True, eq=False)
class Tracked:
    """A system in the coordinates of a frame, ξ⁺ = f(ξ, u, ρ, e).

    Attributes:
        system: the system.
        frame: its coordinates.

    Raises:
        ValueError: the frame names a state that the system does not have, or as many
            states as there are controls cannot be held.
    """

    system: System
    frame: Tracking

    def __post_init__(self) -> None:
        frame = self.frame
        named = [*frame.followed, *frame.held, *frame.course]
        for states in frame.outputs.values():
            named.extend(states)
        for state in named:
            if state not in self.names:
                known = ", ".join(self.names)
                raise ValueError(f"no state is called {state!r}; there are {known}")
        if len(self.held) != len(self.system.controls):
            raise ValueError(
                f"held: as many states as there are controls "
                f"({len(self.system.controls)}), got "
                f"{', '.join(self.names[index] for index in self.held)}"
            )
        if len(set(self.held)) < len(self.held):
            raise ValueError(f"held: each state once, got {', '.join(frame.held)}")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the states, and of the entries of ξ."""
        return self.system.state_names

    @cached_property
    def held(self) -> tuple[int, ...]:
        """Entries of ξ that are 0 where the system follows its reference."""
        states = self.frame.held or self.frame.held_by_default
        return tuple(self.names.index(state) for state in states)

    @cached_property
    def followed(self) -> tuple[int, ...]:
        """Entries of the state that the reference has."""
        return tuple(self.names.index(state) for state in self.frame.followed)

    @cached_property
    def position(self) -> np.ndarray:
        """The two entries of the position of a course; none without a course."""
        course = self.frame.course[:2]
        return np.asarray([self.names.index(state) for state in course], int)

    @cached_property
    def _course_of(self) -> tuple[int, ...]:
        """Entries of the reference that are direction and velocity of a course."""
        return tuple(map(self.frame.followed.index, self.frame.course[2:]))

    @property
    def middle(self) -> ReferenceState:
        """The reference in the middle of its ranges, and 0 without a range."""
        return self._reference_of(jnp.mean(jnp.asarray(self.frame.input_box), axis=0))

    @cached_property
    def rows(self) -> dict[str, tuple[int, ...]]:
        """Entries of ξ of each output."""
        return {
            name: tuple(self.names.index(state) for state in states)
            for name, states in self.frame.outputs.items()
        }

    @cached_property
    def model_frame(self) -> Frame:
        """The frame of a model: a state is three zeros and ξ, a control (ν, ρ)."""
        variables = self.system.state_variables
        first = BODY.start
        units = {name: variables[rows[0]].unit for name, rows in self.rows.items()}
        angles = [first + i for i, state in enumerate(variables) if state.is_angle]
        return Frame(
            name="tracking",
            has_pose=False,
            outputs={
                name: tuple(first + row for row in rows)
                for name, rows in self.rows.items()
            },
            units=units,
            angles=tuple(angles),
            distances=(),
            lengths=(1.0, 1.0, 1.0),
            length=LENGTH,
            inputs=len(self.frame.input_names),
        )

    def coordinates(self, state: State, reference: ReferenceState) -> Error:
        """Return ξ of a state beside the reference."""
        error = state - self._whole(reference)
        is_angle = [variable.is_angle for variable in self.system.state_variables]
        # An angle that the reference does not have is no difference, and stays.
        is_followed = np.isin(np.arange(len(self.names)), self.followed)
        wraps = is_followed & np.asarray(is_angle)
        error = jnp.where(wraps, wrap_angle(error), error)
        return self._turned(error, reference, -1.0)

    def state(self, error: Error, reference: ReferenceState) -> State:
        """Return the state with this ξ."""
        return self._turned(error, reference, 1.0) + self._whole(reference)

    def inputs(
        self, reference: ReferenceState, rates: Float[Array, " chain"]
    ) -> Inputs:
        """Return ρ of a reference and the rates of its chains."""
        followed = self.frame.followed
        ranged = [reference[followed.index(state)] for state in self.frame.ranges]
        return jnp.concatenate([rates, jnp.stack(ranged)]) if ranged else rates

    def advance(
        self, reference: ReferenceState, rates: Float[Array, " chain"]
    ) -> ReferenceState:
        """Return the reference one sampling period later, at constant rates."""
        dt = self.system.dt
        after = self._chains(reference, rates, dt)
        if not self.frame.course:
            return after
        # Simpson's rule, which is Runge-Kutta of order 4 of the course.
        halfway = self._chains(reference, rates, 0.5 * dt)
        velocities = [self._velocity(at) for at in (reference, halfway, after)]
        velocity = (velocities[0] + 4.0 * velocities[1] + velocities[2]) / 6.0
        return jnp.concatenate([after, reference[len(after) :] + velocity * dt])

    def moves(
        self,
        reference: ReferenceState,
        rates: Float[Array, " chain"],
        after: ReferenceState,
    ) -> Bool[Array, ""]:
        """Return whether a reference moves to another as its chains say.

        It does if each state is where `advance` takes it, but for rounding and for what
        a share of `BESIDE` of the range of its rate changes in a sampling period.
        """
        dt = self.system.dt
        rooms = []
        for chain, (low, high) in self.frame.reference.items():
            room = BESIDE * (high - low) * dt
            rooms.extend([0.5 * room * dt, room] if len(chain) == 2 else [room])
        sizes = jnp.abs(reference)
        if self.frame.course:
            # Of a turn and of a change of velocity within the rooms above.
            rate = jnp.linalg.norm(self._velocity(reference))
            of_direction = rooms[self._course_of[0]]
            of_velocity = rooms[self._course_of[1]]
            room = (rate * of_direction + of_velocity) * dt
            rooms.extend([room, room])
            # In the axes of the reference each entry has the rounding of both.
            sizes = sizes.at[-2:].set(jnp.max(sizes[-2:]))
        epsilon = jnp.finfo(reference.dtype).eps
        room = jnp.asarray(rooms) + 4.0 * epsilon * (sizes + 1.0)
        expected = self._whole(self.advance(reference, rates))
        apart = self.coordinates(expected, after)[np.asarray(self.followed)]
        return jnp.all(jnp.abs(apart) <= room)

    def step(
        self, error: Error, control: Control, inputs: Inputs, env: Environment
    ) -> Error:
        """Return ξ one sampling period later.

        States of the reference without a range are 0 here: nothing depends on them, see
        `check_invariance`, and numbers stay small.
        """
        reference = self._reference_of(inputs)
        rates = inputs[: len(self.frame.reference)]
        after = self.system.step(self.state(error, reference), control, env)
        return self.coordinates(after, self.advance(reference, rates))

    def rates_between(
        self, reference: Float[Array, "point reference"]
    ) -> Float[Array, "gap chain"]:
        """Return the rates of the chains between the points of a reference."""
        last = np.cumsum([len(chain) for chain in self.frame.reference]) - 1
        variables = self.system.state_variables
        wraps = [variables[self.followed[index]].is_angle for index in last]
        change = jnp.diff(reference[:, last], axis=0)
        # The angles of a reference may be wrapped.
        return jnp.where(np.asarray(wraps), wrap_angle(change), change) / self.system.dt

    def check_invariance(self, key: Key) -> None:
        """Raise a ValueError if the system depends on a state of the reference.

        Args:
            key: of the places at which it is tried; consumed.
        """

        def moved(place: _Place, reference: ReferenceState) -> Error:
            state = self.state(place.error, reference)
            after = self.system.step(state, place.control, place.env)
            rates = jnp.zeros(len(self.frame.reference))
            return self.coordinates(after, self.advance(reference, rates)) - place.error

        # In float64: a difference may be small beside the states that are subtracted.
        with jax.enable_x64(True):
            middle = self.middle
            places = jax.vmap(self._place)(jax.random.split(key, PLACES))
            along = jax.jit(jax.vmap(moved, in_axes=(0, None)))
            start = along(places, middle)
            scale = jnp.max(jnp.abs(start), axis=0)
            for index, state in enumerate(self.frame.followed):
                if state in self.frame.ranges:
                    continue
                beside = middle.at[index].add(1.0)
                change = jnp.max(jnp.abs(along(places, beside) - start), axis=0)
                if not np.all(change <= INVARIANCE * scale + ROUNDING):
                    raise ValueError(
                        f"the system behaves differently where {state} of the "
                        "reference is another: give the range of the reference, as in "
                        f'ranges={{"{state}": (-1.0, 1.0)}}'
                    )

    def _place(self, key: Key) -> _Place:
        """Draw a place at which the invariance is tried."""
        error_key, control_key, env_key = jax.random.split(key, 3)
        return _Place(
            error=0.1 * jax.random.normal(error_key, (len(self.names),)),
            control=_drawn(control_key, self.system.control_box),
            env=_drawn(env_key, self.system.env_box),
        )

    def _whole(self, reference: ReferenceState) -> State:
        """Return a state that is that of the reference, and 0 elsewhere."""
        whole = jnp.zeros(len(self.names), reference.dtype)
        return whole.at[np.asarray(self.followed)].set(reference)

    def _turned(self, error: Error, reference: ReferenceState, side: float) -> Error:
        """Return an error whose position is turned by the direction of the reference.

        Args:
            error: in either axes.
            reference: with the direction.
            side: 1 from the axes of the reference to those of the world, -1 back.
        """
        if not self.frame.course:
            return error
        direction = side * reference[self._course_of[0]]
        turned = rotate(direction, error[self.position])
        return error.at[self.position].set(turned)

    def _chains(
        self, reference: ReferenceState, rates: Float[Array, " chain"], time: float
    ) -> Float[Array, " chained"]:
        """Return the states of the chains some time later, at constant rates."""
        after = []
        for chain, rate in zip(self.frame.reference, rates, strict=True):
            first = reference[len(after)]
            if len(chain) == 1:
                after.append(first + rate * time)
                continue
            second = reference[len(after) + 1]
            after.append(first + second * time + 0.5 * rate * time**2)
            after.append(second + rate * time)
        return jnp.stack(after)

    def _velocity(self, chained: Float[Array, " chained"]) -> Float[Array, " 2"]:
        """Return the velocity of a reference with a course, from its chains."""
        direction = chained[self._course_of[0]]
        velocity = chained[self._course_of[1]]
        return velocity * jnp.stack([jnp.cos(direction), jnp.sin(direction)])

    def _reference_of(self, inputs: Inputs) -> ReferenceState:
        """Return a reference with this ρ; what ρ does not say is 0."""
        frame = self.frame
        ranged = list(frame.ranges)
        first = len(frame.reference)
        entries = [
            inputs[first + ranged.index(state)] if state in ranged else jnp.zeros(())
            for state in frame.followed
        ]
        return jnp.stack(entries)


class _Place(NamedTuple):
    """Where a step is tried.

    Attributes:
        error: ξ.
        control: u.
        env: e.
    """

    error: Error
    control: Control
    env: Environment


def _drawn(key: Key, box: tuple[tuple[float, ...], tuple[float, ...]]) -> Array:
    """Draw a point of a box."""
    low, high = map(jnp.asarray, box)
    return jax.random.uniform(key, low.shape, minval=low, maxval=high)
