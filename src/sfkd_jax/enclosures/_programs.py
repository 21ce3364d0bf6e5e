"""Programs of jax as lists of operations, and their evaluation on forms.

A program is read as a function of real numbers: its constants are what they are in
float64, and conversions between types change nothing. Only the primitives listed here
are known; any other is refused by its name.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sfkd_jax.enclosures._curves import CURVES, INVERSE, applied, softmax
from sfkd_jax.enclosures._forms import (
    Form,
    add,
    aligned,
    constant,
    larger,
    multiply,
    negative,
    pruned,
    total,
    union,
    weighted,
)

MOVES = frozenset(
    "reshape broadcast_in_dim squeeze expand_dims slice concatenate transpose split "
    "rev stack unstack tile gather scatter select_n dynamic_slice copy copy_p stop_gradient "
    "convert_element_type".split()
)
"""Primitives that only move entries."""
FEW = 16
"""Entries of a move, up to which variables without influence are looked for."""
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


@dataclass(frozen=True, eq=False)
class Program:
    """A program of jax, flat and without what its results do not need.

    Attributes:
        operations: in order.
        constants: place -> exact array.
        inputs: places of the arguments.
        outputs: places of the results.
        shapes: place -> shape.
    """

    operations: tuple[Operation, ...]
    constants: dict[int, np.ndarray]
    inputs: tuple[int, ...]
    outputs: tuple[int, ...]

    def __call__(self, *arguments: Form) -> list[Form]:
        """Return enclosures of the results on all boxes of the arguments."""
        places: dict[int, Any] = dict(self.constants)
        places.update(zip(self.inputs, arguments, strict=True))
        last = {place: n for n, op in enumerate(self.operations) for place in op.inputs}
        with np.errstate(all="ignore"):
            for n, operation in enumerate(self.operations):
                operands = [places[place] for place in operation.inputs]
                places[operation.output] = _evaluated(operation, operands)
                for place in operation.inputs:
                    if last[place] == n and place not in self.outputs:
                        places.pop(place, None)
        return [_as_form(places[place]) for place in self.outputs]


def program(function: Callable[..., Any], *examples: Any) -> Program:
    """Return the program of a function of arrays.

    Args:
        function: traceable; returns an array, or a tuple of arrays.
        examples: arrays of the shapes of its arguments.

    Raises:
        UnknownPrimitive: the function contains what has no enclosure.
    """
    with jax.enable_x64(True):
        examples = tuple(jnp.asarray(example, jnp.float64) for example in examples)
        closed = jax.make_jaxpr(function)(*examples)
        reader = _Reader()
        inputs = tuple(reader.place(var.aval.shape) for var in closed.jaxpr.invars)
        outputs = reader.read(closed.jaxpr, closed.consts, inputs)
    outputs = tuple(reader.alias(place) for place in outputs)
    kept = _needed(reader.operations, outputs)
    used = {place for operation in kept for place in operation.inputs} | {*outputs}
    constants = {k: v for k, v in reader.constants.items() if k in used}
    for operation in kept:
        if operation.moved is None and operation.name not in _KNOWN:
            raise UnknownPrimitive(
                f"{operation.name}: a program with this primitive has no enclosure"
            )
    return Program(tuple(kept), constants, inputs, outputs)


def _needed(operations: list[Operation], outputs: Sequence[int]) -> list[Operation]:
    """Return the operations on which the results depend."""
    wanted = {*outputs}
    kept = []
    for operation in reversed(operations):
        if operation.output in wanted:
            kept.append(operation)
            wanted.update(operation.inputs)
    return kept[::-1]


@dataclass(eq=False)
class _Reader:
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


def _as_form(value: Any) -> Form:
    """Return a form of a form or an exact constant."""
    return value if isinstance(value, Form) else constant(value)


def _alike(left: Form, right: Form) -> tuple[Form, Form]:
    """Return forms of the same shape, where one of them is a single number."""
    shape = np.broadcast_shapes(left.shape, right.shape)

    def spread(form: Form) -> Form:
        if form.shape == shape:
            return form
        missing = (1,) * (len(shape) - len(form.shape))

        def change(part: np.ndarray) -> np.ndarray:
            rows = part.shape[:1]
            part = part.reshape(*rows, *missing, *part.shape[1:])
            return np.broadcast_to(part, (*rows, *shape))

        return form.mapped(change)

    return spread(left), spread(right)


def _evaluated(operation: Operation, operands: list[Any]) -> Form:
    """Evaluate one operation."""
    if operation.moved is not None:
        moved = _move_forms([_as_form(value) for value in operands], operation.moved)
        return pruned(moved) if moved.error[0].size <= FEW else moved
    if operation.name == "dot_general":
        return _dot(operands, operation.params["dimension_numbers"])
    forms = [_as_form(value) for value in operands]
    return _KNOWN[operation.name](operation.params, *forms)


def _move_forms(forms: list[Form], indices: np.ndarray) -> Form:
    """Return the entries with these numbers, counted through all forms."""
    if len(forms) == 1:
        size = int(np.prod(forms[0].shape))
        return forms[0].mapped(lambda part: part.reshape(len(part), size)[:, indices])
    boxes = max(len(form.error) for form in forms)
    active, pairs, curved = union(forms)

    def flat(part: np.ndarray, form: Form) -> np.ndarray:
        rows = part.shape[: part.ndim - len(form.shape)]
        part = part.reshape(*rows, int(np.prod(form.shape)))
        return np.broadcast_to(part, (*rows[:-1], boxes, part.shape[-1]))

    parts = [flat(aligned(form, active, pairs).parts, form) for form in forms]
    error = np.concatenate([flat(form.error, form) for form in forms], axis=-1)
    moved = np.concatenate(parts, axis=-1)[:, :, indices]
    return Form(moved, active, pairs, curved, error[:, indices])


def _dot(operands: list[Any], dimensions: Any) -> Form:
    """Return a product of matrices or vectors."""
    (over_left, over_right), (batch, _) = dimensions
    if batch:
        raise UnknownPrimitive("dot_general: with axes of a batch")
    left, right = operands
    if isinstance(left, Form) and isinstance(right, Form):
        return _dot_of_forms(left, right, tuple(over_left), tuple(over_right))
    exact_left = not isinstance(left, Form)
    if exact_left:
        form, over, weights, over_weights = _as_form(right), over_right, left, over_left
    else:
        form, over, weights, over_weights = left, over_left, right, over_right
    weights = np.asarray(weights, np.float64)
    free = [axis for axis in range(weights.ndim) if axis not in over_weights]
    rows = tuple(weights.shape[axis] for axis in free)
    flat = weights.transpose(*free, *over_weights).reshape(int(np.prod(rows)), -1)
    kept = [axis for axis in range(len(form.shape)) if axis not in over]
    outer = tuple(form.shape[axis] for axis in kept)

    def arranged(part: np.ndarray) -> np.ndarray:
        order = (0, *(axis + 1 for axis in kept), *(axis + 1 for axis in over))
        return part.transpose(order).reshape(len(part), *outer, flat.shape[1])

    product = weighted(form.mapped(arranged), flat)

    def back(part: np.ndarray) -> np.ndarray:
        part = part.reshape(len(part), *outer, *rows)
        if not exact_left:
            return part
        axes = range(1, part.ndim)
        split = len(outer)
        return part.transpose(0, *axes[split:], *axes[:split])

    return product.mapped(back)


def _dot_of_forms(
    left: Form, right: Form, over_left: tuple[int, ...], over_right: tuple[int, ...]
) -> Form:
    """Return a product of two forms, entry by entry and summed."""
    free_left = [axis for axis in range(len(left.shape)) if axis not in over_left]
    free_right = [axis for axis in range(len(right.shape)) if axis not in over_right]

    def of_left(part: np.ndarray) -> np.ndarray:
        order = (0, *(a + 1 for a in free_left), *(a + 1 for a in over_left))
        part = part.transpose(order)
        split = 1 + len(free_left)
        ones = (1,) * len(free_right)
        return part.reshape(*part.shape[:split], *ones, *part.shape[split:])

    def of_right(part: np.ndarray) -> np.ndarray:
        order = (0, *(a + 1 for a in free_right), *(a + 1 for a in over_right))
        part = part.transpose(order)
        return part.reshape(len(part), *(1,) * len(free_left), *part.shape[1:])

    product = multiply(*_alike(left.mapped(of_left), right.mapped(of_right)))
    count = len(product.shape)
    return total(product, tuple(range(count - len(over_left), count)))


def _power(params: dict[str, Any], form: Form) -> Form:
    """Return x^n for a whole n."""
    exponent = params.get("y", 2)
    result = form
    for _ in range(abs(exponent) - 1):
        result = multiply(result, form)
    if exponent == 0:
        return constant(np.ones(form.shape))
    return applied(INVERSE, result) if exponent < 0 else result


def _clamped(low: Form, form: Form, high: Form) -> Form:
    """Return x, limited to [low, high]."""
    above = larger(*_alike(form, low))
    return _smaller(*_alike(above, high))


def _smaller(left: Form, right: Form) -> Form:
    """Return min(x, y)."""
    return negative(larger(negative(left), negative(right)))


def _of_two(function: Callable[[Form, Form], Form]) -> Callable[..., Form]:
    """Return an operation of two forms that may need the same shape first."""
    return lambda params, left, right: function(*_alike(left, right))


_KNOWN: dict[str, Callable[..., Form]] = {
    "add": _of_two(add),
    "add_any": _of_two(add),
    "sub": _of_two(lambda left, right: add(left, negative(right))),
    "mul": _of_two(multiply),
    "div": _of_two(lambda left, right: multiply(left, applied(INVERSE, right))),
    "max": _of_two(larger),
    "min": _of_two(_smaller),
    "neg": lambda params, form: negative(form),
    "abs": lambda params, form: larger(form, negative(form)),
    "clamp": lambda params, *forms: _clamped(*forms),
    "integer_pow": _power,
    "square": _power,
    "reduce_sum": lambda params, form: total(form, tuple(params["axes"])),
    "softmax": lambda params, form: softmax(form),
    "dot_general": lambda params, *forms: _dot([*forms], params["dimension_numbers"]),
} | {
    name: (lambda curve: lambda params, form: applied(curve, form))(curve)
    for name, curve in CURVES.items()
}
