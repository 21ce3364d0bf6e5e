"""The step of a simulator that jax cannot trace, such as one in C++ or of gymnasium."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array

from sfkd_jax.ranges import AtLeastOne, Positive
from sfkd_jax.types import Control, Environment, State, Step

HostStep: TypeAlias = Callable[[np.ndarray, np.ndarray, np.ndarray], ArrayLike]
"""(x, u, e) in float64 -> x one sampling period later."""
WORD = 4
"""Bytes of a word."""


def simulated(
    simulate: HostStep,
    *,
    states: AtLeastOne,
    vectorized: bool = False,
    difference: Positive = 1e-4,
) -> Step:
    """Return the step of a simulator that runs on the host, for `System`.

    Its derivatives are central differences. The simulator must return the same for the
    same arguments: x is its whole state.

    Args:
        simulate: (x, u, e) -> x one sampling period later, with arrays of numpy in
            float64.
        states: number of entries of x.
        vectorized: whether it takes and returns many rows at once, (row, entry), which
            is much faster.
        difference: of the arguments to both sides, for derivatives. Choose it so large
            that the rounding of the simulator does not matter.

    Raises:
        ValueError: when called, if the simulator returns another shape.
    """
    on_host = _OnHost(simulate, states, vectorized, difference)

    @jax.custom_jvp
    def simulation(state: State, control: Control, env: Environment) -> State:
        return _called(on_host.values, states, state, control, env)

    @simulation.defjvp
    def with_tangents(points: Any, tangents: Any) -> tuple[State, State]:
        slope = _called(on_host.derivatives, states, *points, *tangents)
        return simulation(*points), slope

    def step(state: State, control: Control, env: Environment) -> State:
        dtype = jnp.result_type(float)
        return simulation(*(jnp.asarray(a, dtype) for a in (state, control, env)))

    return step


@dataclass(frozen=True)
class _OnHost:
    """A simulator and its derivatives, for any number of leading axes.

    Attributes:
        simulate: see `simulated`, like the other attributes.
        states: number of entries of x.
        vectorized: whether it takes many rows.
        difference: for derivatives.
    """

    simulate: HostStep
    states: int
    vectorized: bool
    difference: float

    def values(self, *arguments: np.ndarray) -> np.ndarray:
        """Return x one sampling period after (x, u, e)."""
        flat, lead = _flattened(arguments)
        return self._rows(*flat).reshape(*lead, self.states)

    def derivatives(self, *both: np.ndarray) -> np.ndarray:
        """Return the derivatives at the first three arguments along the others."""
        flat, lead = _flattened(both)
        points = flat[:3]
        tangents = flat[3:]
        largest = np.max(np.abs(np.concatenate(tangents, axis=1)), axis=1)
        # The change of the largest entry is `difference`.
        size = (self.difference / np.where(largest > 0.0, largest, 1.0))[:, None]
        above = [p + size * t for p, t in zip(points, tangents, strict=True)]
        below = [p - size * t for p, t in zip(points, tangents, strict=True)]
        slope = (self._rows(*above) - self._rows(*below)) / (2.0 * size)
        return slope.reshape(*lead, self.states)

    def _rows(self, *arguments: np.ndarray) -> np.ndarray:
        """Simulate rows of arguments, (row, entry)."""
        if self.vectorized:
            after = np.asarray(self.simulate(*arguments), float)
        else:
            # A copy, because simulators like to keep what they are given.
            steps = [
                np.asarray(self.simulate(*map(np.array, row)), float)
                for row in zip(*arguments, strict=True)
            ]
            after = np.stack(steps)
        count = len(arguments[0])
        if after.shape != (count, self.states):
            expected = (count, self.states) if self.vectorized else (self.states,)
            got = after.shape if self.vectorized else after.shape[1:]
            raise ValueError(
                f"the simulator must return an array of shape {expected}, got {got}"
            )
        return after


def _called(
    function: Callable[..., np.ndarray], states: int, *arguments: Array
) -> State:
    """Return what a function returns on the host.

    The bits of numbers come and go as words: a callback would round numbers in
    float64, since jax_enable_x64 may be set in the thread of the caller alone.
    """
    dtype = arguments[0].dtype

    def on_words(*words: Any) -> np.ndarray:
        values = [np.asarray(word).view(dtype).astype(float) for word in words]
        return function(*values).astype(dtype).view(np.uint32)

    count = states * dtype.itemsize // WORD
    shape = jax.ShapeDtypeStruct((count,), jnp.uint32)
    words = jax.pure_callback(
        on_words, shape, *map(_words, arguments), vmap_method="broadcast_all"
    )
    return jax.lax.bitcast_convert_type(
        words.reshape(states, -1) if count > states else words, dtype
    )


def _words(values: Array) -> Array:
    """Return the bits of numbers, as words."""
    return jax.lax.bitcast_convert_type(values, jnp.uint32).reshape(-1)


def _flattened(
    arguments: tuple[np.ndarray, ...],
) -> tuple[list[np.ndarray], tuple[int, ...]]:
    """Return arguments with one leading axis, and their leading axes."""
    flat = [argument.reshape(-1, argument.shape[-1]) for argument in arguments]
    return flat, arguments[0].shape[:-1]
