"""Programs of jax, evaluated on forms.

A program is read as a function of real numbers: its constants are what they are in
float64, and conversions between types change nothing. Only the primitives listed here
are known; any other is refused by its name.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sfkd_jax.enclosures._curves import CURVES, INVERSE, Curve, applied, softmax
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
from sfkd_jax.enclosures._reading import Operation, Reader, UnknownPrimitive

FEW = 16
"""Entries of a move, up to which variables without influence are looked for."""


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
        reader = Reader()
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


def _applied(curve: Curve, params: dict[str, Any], form: Form) -> Form:
    """Return a function of each entry."""
    return applied(curve, form)


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
} | {name: partial(_applied, curve) for name, curve in CURVES.items()}
