"""Numbers that are not finite: where they are noticed, and what replaces them."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


def all_finite(tree: Any) -> Bool[Array, ""]:
    """Return whether every real or complex entry of every leaf is finite."""
    leaves = [jnp.asarray(leaf) for leaf in jax.tree.leaves(tree)]
    real = [leaf for leaf in leaves if jnp.issubdtype(leaf.dtype, jnp.inexact)]
    return jnp.all(
        jnp.stack([jnp.asarray(True), *(jnp.all(jnp.isfinite(leaf)) for leaf in real)])
    )


def replace_nonfinite(
    values: Float[Array, "*shape"], fill: float
) -> Float[Array, "*shape"]:
    """Return the values with `fill` in place of NaN and infinity."""
    return jnp.where(jnp.isfinite(values), values, fill)
