"""Check what functions of a user return; one line names the function."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from sfkd_jax.types import Scalar


def as_cost(name: str, cost: Any) -> Scalar:
    """Return a cost as a real number.

    A truth value or an integer becomes a float: a sum of truth values would be true as
    soon as one of them is.

    Args:
        name: of the function that returned it.
        cost: what it returned.

    Raises:
        ValueError: the cost is not one real number of shape ().
    """
    if _is_leaf(cost) and jnp.shape(cost) == ():
        dtype = jnp.result_type(cost)
        if jnp.issubdtype(dtype, jnp.floating):
            return jnp.asarray(cost)
        if jnp.issubdtype(dtype, jnp.bool_) or jnp.issubdtype(dtype, jnp.integer):
            return jnp.asarray(cost, dtype=float)
    raise ValueError(f"{name} must return one real number, shape (), got {_say(cost)}")


def check_next_state(name: str, state: Any, after: Any) -> None:
    """Refuse a next state of other shapes or types than the state.

    Integers may become real numbers, but no real number an integer or truth value.

    Args:
        name: of the function that returned the next state.
        state: a pytree of arrays.
        after: the next state, or its shapes and types.

    Raises:
        ValueError: they do not fit together.
    """
    fits = jax.tree.structure(state) == jax.tree.structure(after) and all(
        jnp.shape(before) == jnp.shape(leaf)
        and _holds(jnp.result_type(leaf), jnp.result_type(before))
        for before, leaf in zip(
            jax.tree.leaves(state), jax.tree.leaves(after), strict=True
        )
    )
    if not fits:
        raise ValueError(
            f"{name} must return a state like the one it gets, {_say(state)}, "
            f"got {_say(after)}"
        )


def _is_leaf(value: Any) -> bool:
    """Return whether a value is one array or number, and no tree of them."""
    leaves = jax.tree.leaves(value)
    return len(leaves) == 1 and leaves[0] is value


def _holds(after: Any, before: Any) -> bool:
    """Return whether numbers of one type can become those of another one."""
    real = jnp.issubdtype(after, jnp.floating)
    return after == before or real or not jnp.issubdtype(before, jnp.floating)


def _say(value: Any) -> str:
    """Return the shapes and types of a value in a line."""

    def text(leaf: Any) -> str:
        try:
            return f"{jnp.result_type(leaf)}{list(jnp.shape(leaf))}"
        except TypeError:
            return type(leaf).__name__

    if _is_leaf(value):
        return text(value)
    return str(jax.tree.map(text, value)).replace("'", "")
