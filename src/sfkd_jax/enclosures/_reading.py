"""Programs of jax, read into lists of operations on numbered places."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

MOVES = frozenset(
    {
        *("reshape", "broadcast_in_dim", "squeeze", "expand_dims", "slice", "split"),
        *("concatenate", "stack", "unstack", "tile", "transpose", "rev", "copy"),
        *("gather", "scatter", "select_n", "dynamic_slice", "copy_p"),
        *("stop_gradient", "convert_element_type"),
    }
)
"""Primitives that only move entries."""
CALLS = ("jit", "pjit", "closed_call", "custom_jvp_call", "custom_vjp_call", "remat2")


class UnknownPrimitive(Exception):
    """A program contains what has no enclosure here; the message names it."""


class Operation(NamedTuple):
    """One operation of a program.

    Attributes:
        name: of the primitive, or "softmax".
        inputs: places of its operands.
        output: place of its result.
        params: of the primitive.
        moved: of a move, indices into the entries of all operands.
    """

    name: str
    inputs: tuple[int, ...]
    output: int
    params: dict[str, Any]
    moved: np.ndarray | None = None


@dataclass(eq=False)
class Reader:
    """Reads jaxprs into operations.

    Attributes:
        operations: read so far.
        constants: place -> exact array.
        shapes: of all places.
        makers: place -> operation that makes it.
        aliases: place -> another with the same value.
    """

    operations: list[Operation] = field(default_factory=list)
    constants: dict[int, np.ndarray] = field(default_factory=dict)
    shapes: list[tuple[int, ...]] = field(default_factory=list)
    makers: dict[int, Operation] = field(default_factory=dict)
    aliases: dict[int, int] = field(default_factory=dict)

    def place(self, shape: tuple[int, ...]) -> int:
        """Return a new place."""
        self.shapes.append(tuple(shape))
        return len(self.shapes) - 1

    def constant(self, value: Any) -> int:
        """Return the place of a constant."""
        array = np.asarray(value)
        place = self.place(array.shape)
        self.constants[place] = array
        return place

    def alias(self, place: int) -> int:
        """Return the first place with the value of a place."""
        while place in self.aliases:
            place = self.aliases[place]
        return place

    def read(
        self, jaxpr: Any, consts: Sequence[Any], inputs: Sequence[int]
    ) -> list[int]:
        """Read a jaxpr and return the places of its results."""
        places = dict(zip(jaxpr.invars, inputs, strict=True))
        places.update(
            (var, self.constant(value))
            for var, value in zip(jaxpr.constvars, consts, strict=True)
        )

        def of(var: Any) -> int:
            is_literal = hasattr(var, "val")
            return self.constant(var.val) if is_literal else self.alias(places[var])

        for equation in jaxpr.eqns:
            results = self._equation(equation, [of(var) for var in equation.invars])
            places.update(zip(equation.outvars, results, strict=True))
        return [of(var) for var in jaxpr.outvars]

    def _equation(self, equation: Any, inputs: list[int]) -> list[int]:
        """Read one equation."""
        name = equation.primitive.name
        params = equation.params
        if name in CALLS:
            inner = params.get("jaxpr", params.get("call_jaxpr"))
            if inner is None:
                raise UnknownPrimitive(f"{name}: its program is not known")
            consts = getattr(inner, "consts", ())
            return self.read(getattr(inner, "jaxpr", inner), consts, inputs)
        if name == "scan":
            return self._scan(params, inputs)
        if all(place in self.constants for place in inputs):
            exact = name in MOVES or not np.issubdtype(
                equation.outvars[0].aval.dtype, np.floating
            )
            if exact:
                return self._folded(equation, inputs)
        if name in MOVES:
            return self._move(equation, inputs)
        if len(equation.outvars) != 1:
            raise UnknownPrimitive(f"{name}: it has several results")
        shifted = self._softmax(name, inputs)
        if shifted is not None:
            name = "softmax"
            inputs = [shifted]
        return [self._add(name, inputs, equation.outvars[0].aval.shape, params)]

    def _add(
        self,
        name: str,
        inputs: Sequence[int],
        shape: tuple[int, ...],
        params: dict[str, Any],
        moved: np.ndarray | None = None,
    ) -> int:
        """Add an operation, and return the place of its result."""
        operation = Operation(name, tuple(inputs), self.place(shape), params, moved)
        self.operations.append(operation)
        self.makers[operation.output] = operation
        return operation.output

    def _folded(self, equation: Any, inputs: list[int]) -> list[int]:
        """Evaluate an exact operation on constants."""
        values = [jnp.asarray(self.constants[place]) for place in inputs]
        results = equation.primitive.bind(*values, **equation.params)
        several = equation.primitive.multiple_results
        return [self.constant(value) for value in (results if several else [results])]

    def _scan(self, params: dict[str, Any], inputs: list[int]) -> list[int]:
        """Read a loop of known length without inputs and results of each step."""
        fixed = params["num_consts"]
        carried = params["num_carry"]
        body = params["jaxpr"]
        if len(inputs) > fixed + carried or len(body.jaxpr.outvars) > carried:
            raise UnknownPrimitive("scan: it has inputs or results of each step")
        carry = inputs[fixed:]
        for _ in range(params["length"]):
            carry = self.read(body.jaxpr, body.consts, [*inputs[:fixed], *carry])
        return carry

    def _move(self, equation: Any, inputs: list[int]) -> list[int]:
        """Read a move of entries, by moving their numbers in its place."""
        name = equation.primitive.name
        # Operands that are read as values, such as indices, must be constants.
        is_index = [
            not np.issubdtype(var.aval.dtype, np.floating) for var in equation.invars
        ]
        numbers = []
        moving = []
        first = 0
        for place, index, var in zip(inputs, is_index, equation.invars, strict=True):
            if index:
                if place not in self.constants:
                    raise UnknownPrimitive(f"{name}: an index is no constant")
                numbers.append(jnp.asarray(self.constants[place]))
                continue
            size = int(np.prod(var.aval.shape))
            values = np.arange(first, first + size).reshape(var.aval.shape)
            numbers.append(jnp.asarray(values, jnp.float64))
            moving.append(place)
            first += size
        params = dict(equation.params)
        if name == "convert_element_type":
            if not np.issubdtype(equation.outvars[0].aval.dtype, np.floating):
                raise UnknownPrimitive(f"{name}: to integers")
            params["new_dtype"] = np.dtype("float64")
        results = equation.primitive.bind(*numbers, **params)
        results = results if equation.primitive.multiple_results else [results]
        if not all(np.all(np.isfinite(result)) for result in results):
            raise UnknownPrimitive(f"{name}: from outside of its operands")
        return [self._moved(moving, np.asarray(result, int)) for result in results]

    def _moved(self, moving: list[int], indices: np.ndarray) -> int:
        """Return the place of moved entries; of one operand as it is, that operand."""
        first = 0
        for place in moving:
            shape = self.shapes[place]
            size = int(np.prod(shape))
            same = np.arange(first, first + size).reshape(shape)
            if indices.shape == shape and np.array_equal(indices, same):
                return place
            first += size
        return self._add("move", moving, indices.shape, {}, indices)

    def _softmax(self, name: str, inputs: list[int]) -> int | None:
        """Return x if a quotient is exp(x_i - s) / Σ_j exp(x_j - s), for any number s.

        s is the largest x in programs, and the value does not depend on it.
        """
        if name != "div":
            return None
        above = self.makers.get(inputs[0])
        below = self._source(inputs[1])
        if above is None or above.name != "exp" or below is None:
            return None
        all_of = below.name == "reduce_sum" and below.inputs == (above.output,)
        shift = self.makers.get(above.inputs[0])
        if not all_of or shift is None or shift.name != "sub":
            return None
        one = np.prod(self.shapes[inputs[1]]) == 1
        one &= np.prod(self.shapes[shift.inputs[1]]) == 1
        vector = len(self.shapes[shift.inputs[0]]) == 1
        return shift.inputs[0] if one and vector else None

    def _source(self, place: int) -> Operation | None:
        """Return what makes a number, before moves."""
        maker = self.makers.get(place)
        while maker is not None and maker.name == "move" and len(maker.inputs) == 1:
            maker = self.makers.get(maker.inputs[0])
        return maker
