"""The one-step error of a model of a closed loop, as a program over cells of its law.

    d = F(encode ξ; ν, ρ, e) - encode f(ξ, clip(law(ξ + n; ρ, e) + ν), ρ, e)

A cell is a box of the table of the law, inside of which the law is a polynomial. The
variables of a cell are in [-1, 1]: (ρ, e), then y with ξ = middle + basis y, then ν
relative to its largest value, then the noise n of the sensors relative to its bound.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Any, NamedTuple, TypeAlias

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from sfkd_jax import enclosures
from sfkd_jax.enclosures import Boxes, Form, Question
from sfkd_jax.systems import ClosedLoop, SteadyState
from sfkd_jax.types import BODY, Model, Params

Table: TypeAlias = Any
"""Arrays of numpy, and of jax inside of a program."""


class Cells(NamedTuple):
    """The cells of the table of a law.

    Attributes:
        middle: (ρ, e) in the middle of each cell, (cell, axis).
        half: half the widths of the cells, (cell, axis).
        state: ξ* at the corners, (cell, 2, …, 2, state).
        control: u* at the corners, (cell, 2, …, 2, control).
        gain: K at the corners, (cell, 2, …, 2, control, state).
    """

    middle: Table
    half: Table
    state: Table
    control: Table
    gain: Table


class States(NamedTuple):
    """States ξ = middle + basis y with normals @ y ≤ 1, all |y| ≤ 1.

    Attributes:
        middle: (state,).
        basis: (state, state).
        normals: (face, state); none for the whole box.
    """

    middle: Float[np.ndarray, " state"]
    basis: Float[np.ndarray, "state state"]
    normals: Float[np.ndarray, "face state"]


def cells_of(law: Any) -> Cells:
    """Return the cells of a table, all corners beside each other."""
    axes = len(law.low)
    counts = law.control.shape[:axes]
    low = np.asarray(law.low, np.float64)
    high = np.asarray(law.high, np.float64)
    width = (high - low) / (np.asarray(counts) - 1)
    places = [*product(*(range(count - 1) for count in counts))]

    def corners_of(table: Array) -> np.ndarray:
        values = np.asarray(table, np.float64)
        parts = [values[tuple(slice(i, i + 2) for i in place)] for place in places]
        return np.stack(parts)

    half = np.broadcast_to(0.5 * width, (len(places), axes))
    return Cells(
        middle=low + (np.asarray(places) + 0.5) * width,
        half=half,
        state=corners_of(law.state),
        control=corners_of(law.control),
        gain=corners_of(law.gain),
    )


@dataclass(frozen=True, eq=False)
class OneStep:
    """The one-step error of a model of a loop.

    Attributes:
        loop: the closed loop, with the step of its system.
        model: of the loop; its latent is the state in other coordinates.
        params: its weights.
        states: at which the error is bounded.
        noise: largest |n| of each sensor.
        curved: variables of a cell whose products enclosures keep.
    """

    loop: ClosedLoop
    model: Model
    params: Params
    states: States
    noise: Float[np.ndarray, " state"]
    curved: tuple[int, ...] = ()

    @cached_property
    def cells(self) -> Cells:
        """The cells of the law."""
        return cells_of(self.loop.law)

    @property
    def variables(self) -> int:
        """Number of variables of a cell."""
        axes = self.cells.middle.shape[1]
        return axes + 2 * len(self.noise) + self.loop.controls

    def parts(self, at: Array) -> tuple[Array, Array, Array, Array]:
        """Return places in the cell, y, ν relative to its largest value, and noise."""
        axes = self.cells.middle.shape[1]
        states = len(self.noise)
        controls = self.loop.controls
        edges = np.cumsum([axes, states, controls])
        place, y, nu, noise = jnp.split(at, edges)
        return place, y, nu, noise

    def situation(
        self, at: Array, cell: Cells
    ) -> tuple[Array, Array, Array, Array, Array, SteadyState]:
        """Return ξ, n, ν, ρ and e of variables of a cell, and what the law has."""
        place, y, nu, noise = self.parts(at)
        steady = SteadyState(
            state=_between(cell.state, place),
            control=_between(cell.control, place),
            gain=_between(cell.gain, place),
        )
        inputs = len(self.loop.tracked.frame.input_names)
        where = jnp.asarray(cell.middle) + jnp.asarray(cell.half) * place
        error = jnp.asarray(self.states.middle) + jnp.asarray(self.states.basis) @ y
        largest = jnp.asarray(self.loop.law.perturbation)
        off = jnp.asarray(self.noise) * noise
        return error, off, largest * nu, where[:inputs], where[inputs:], steady

    def after(self, at: Array, cell: Cells) -> Array:
        """Return ξ of the system one sampling period later."""
        error, off, nu, inputs, env, steady = self.situation(at, cell)
        applied = self.loop.applied(steady, error + off, nu)
        return self.loop.tracked.step(error, applied, inputs, env)

    def difference(self, at: Array, cell: Cells) -> Array:
        """Return d in the latent."""
        error, _, nu, inputs, env, _ = self.situation(at, cell)
        model = self.model
        fiber = model.fiber(self.params, env)
        latent = model.encode(fiber, _padded(error))
        predicted = model.step(fiber, latent, jnp.concatenate([nu, inputs]))
        reached = model.encode(fiber, _padded(self.after(at, cell)))
        return model.vector(predicted) - model.vector(reached)

    def error_in(self, metric: Float[np.ndarray, "latent latent"]) -> Question:
        """Return the question of |d|_P."""
        root = np.linalg.cholesky(np.asarray(metric, np.float64)).T

        def scaled(at: Array, cell: Cells) -> Array:
            return jnp.asarray(root) @ self.difference(at, cell)

        return self._question(scaled, enclosures.norms)

    def _question(self, function: Any, measure: Any) -> Question:
        """Return the question of a function of variables and a cell."""
        cells = self.cells
        example = Cells(*(part[0] for part in cells))
        at = np.zeros(self.variables)
        read = enclosures.program(
            lambda at, *cell: function(at, Cells(*cell)), at, *example
        )

        def enclose(boxes: Boxes) -> Form:
            tables = [enclosures.of_boxes(part[boxes.roots]) for part in cells]
            at = enclosures.variables(boxes.centres, boxes.radii, self.curved)
            return read(at, *tables)[0]

        return Question(
            enclose=enclose,
            measure=measure,
            outside=self._outside,
            roots=len(cells.middle),
            variables=self.variables,
        )

    def _outside(self, boxes: Boxes) -> Bool[np.ndarray, " box"]:
        """Return whether boxes have no state of the domain."""
        first = self.cells.middle.shape[1]
        along = slice(first, first + len(self.noise))
        normals = self.states.normals
        nearest = boxes.centres[:, along] @ normals.T
        nearest = nearest - boxes.radii[:, along] @ np.abs(normals).T
        return np.any(nearest > 1.0 + 1e-9, axis=1)


def _padded(error: Array) -> Array:
    """Return the state of a model without a pose."""
    return jnp.concatenate([jnp.zeros(BODY.start), error])


def _between(table: Table, place: Array) -> Array:
    """Interpolate the values at the corners of a cell, at a place in [-1, 1].

    One axis at a time, so that an enclosure is of differences of the corners.
    """
    for share in place:
        middle = 0.5 * (table[0] + table[1])
        table = middle + share * (0.5 * (table[1] - table[0]))
    return table
