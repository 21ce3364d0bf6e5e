"""What a certificate is about: the weights as a model serves them, or the reason why nothing can be said about them."""

from __future__ import annotations

import hashlib
from contextlib import AbstractContextManager
from functools import cache
from typing import Any, TypeAlias

import jax
import numpy as np
from threadpoolctl import ThreadpoolController

from sfkd_jax.types import Incremental, Model, Params, Samples

ACTIVATIONS = ("tanh", "relu", "sigmoid", "softplus", "elu")
"""Those whose slopes lie in [0, 1] everywhere; gelu and silu leave it."""
TRANSPORTS = ("identity", "rotation")
ONCE = {"xla_backend_optimization_level": 1}
"""Of what is compiled to run a few times: full optimisation takes longer than it saves,
none costs milliseconds.
"""
Exported: TypeAlias = Any
"""An `Explicit` (or an `Incremental`) whose leaves are float64 numpy arrays."""


class CertificationRefused(Exception):
    """No certificate; the message is the reason."""


def exported(model: Model, params: Params) -> Exported:
    """The explicit weights in float64, as the model serves them.

    Raises:
        CertificationRefused: none, not finite, sampled operators only, an unknown
            activation or transport, or weights of a flow in continuous time.
    """
    weights = served(model, params)
    if isinstance(weights, Incremental):
        raise CertificationRefused(
            "what is proved of a continuous flow is its rate; no tube of its steps follows"
        )
    require_finite(weights)
    if isinstance(weights.operators, Samples):
        count = len(weights.operators.operators)
        raise CertificationRefused(
            f"grid-only evidence: {count} sampled environments say nothing about those between"
        )
    require_slopes(weights)
    if weights.declared.transport not in TRANSPORTS:
        raise CertificationRefused(
            f"the transport {weights.declared.transport!r} is not known to be nonexpansive"
        )
    return weights


def served(model: Model, params: Params) -> Exported:
    """What the model serves, in float64, unchecked.

    Raises:
        CertificationRefused: nothing.
    """
    if model.explicit is None:
        raise CertificationRefused("this model exposes no explicit weights to certify")
    evaluate = jax.jit(model.explicit, compiler_options=ONCE)
    return jax.tree.map(
        lambda leaf: np.asarray(leaf, dtype=np.float64), evaluate(params)
    )


def require_finite(weights: Exported) -> None:
    """Refuse weights that are not numbers."""
    if not all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(weights)):
        raise CertificationRefused("the weights are not finite")


def require_slopes(weights: Exported) -> None:
    """Refuse an activation that may leave the sector that every claim assumes."""
    if weights.declared.activation not in ACTIVATIONS:
        raise CertificationRefused(
            f"slopes of the activation {weights.declared.activation!r} are not known in [0, 1]"
        )


def fingerprint(params: Params) -> str:
    """SHA-256 of all weights with their names, types and shapes."""
    digest = hashlib.sha256()
    for path, leaf in jax.tree_util.tree_flatten_with_path(params)[0]:
        array = np.asarray(leaf)
        digest.update(
            f"{jax.tree_util.keystr(path)} {array.dtype} {array.shape} ".encode()
        )
        digest.update(array.tobytes())
    return digest.hexdigest()


def one_thread() -> AbstractContextManager[object]:
    """BLAS on one thread: matrices of this size lose on two, and lose a hundredfold on busy cores."""
    return _threads().limit(limits=1, user_api="blas")


@cache
def _threads() -> ThreadpoolController:
    """The libraries of this process; finding them takes milliseconds."""
    return ThreadpoolController()
