"""The explicit weights of a model in float64, or the reason for refusing them."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any, TypeAlias

import jax
import numpy as np

from sfkd_jax.rollout import unfold
from sfkd_jax.types import Model, Params, Samples

ACTIVATIONS = ("tanh", "relu", "sigmoid", "softplus", "elu")
"""Activations with slopes in [0, 1] everywhere, which excludes gelu and silu."""
TRANSPORTS = ("identity", "rotation")
COMPILER_OPTIONS = {"xla_backend_optimization_level": 1}
"""Less optimisation, since full optimisation compiles longer than it saves here."""
MALFORMED = (
    LookupError,
    TypeError,
    ValueError,
    ArithmeticError,
    AttributeError,
    RecursionError,
)
"""Errors that Python raises on a document with values of unexpected types."""
Exported: TypeAlias = Any
"""An `Explicit` whose leaves are float64 numpy arrays."""


class CertificationRefused(Exception):
    """Nothing is certified, or a claim does not hold; the message gives the reason."""


class CertificateStale(Exception):
    """The certificate is about other weights or settings."""


@contextmanager
def well_formed() -> Iterator[None]:
    """Refuse a document whose values are of unexpected types, in one line."""
    try:
        yield
    except MALFORMED as reason:
        raise CertificationRefused(
            f"the certificate is malformed: {' '.join(str(reason).split())}"
        ) from None


def exported(model: Model, params: Params) -> Exported:
    """Return the explicit weights in float64, checked to be certifiable.

    Args:
        model: any model.
        params: its weights.

    Raises:
        CertificationRefused: no explicit weights, weights that are not finite, sampled
            operators only, or an unknown activation or transport.
    """
    if model.structure.explicit is None:
        raise CertificationRefused("this model exposes no explicit weights to certify")
    evaluate = jax.jit(model.structure.explicit, compiler_options=COMPILER_OPTIONS)
    try:
        host = jax.local_devices(backend="cpu")[0]
    except RuntimeError:  # JAX_PLATFORMS names accelerators only
        host = None
    # Accelerators round float32 factors to ten bits, which the witnesses of another
    # machine do not survive: evaluated on the host, or else in full precision.
    with jax.default_device(host), jax.default_matmul_precision("float32"):
        weights = evaluate(jax.tree.map(np.asarray, unfold(params)))
    # float32 numbers are float64 numbers exactly: nothing is rounded here.
    weights = jax.tree.map(lambda leaf: np.asarray(leaf, dtype=np.float64), weights)
    if not all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(weights)):
        raise CertificationRefused("the weights are not finite")
    # A(e) between two samples is unknown, however dense they are.
    if isinstance(weights.operators, Samples):
        raise CertificationRefused(
            f"grid-only evidence: {len(weights.operators.operators)} sampled "
            "environments prove nothing about those in between"
        )
    activation, transport = weights.declared.activation, weights.declared.transport
    if activation not in ACTIVATIONS:
        raise CertificationRefused(
            f"slopes of the activation {activation!r} are not known in [0, 1]"
        )
    if transport not in TRANSPORTS:
        raise CertificationRefused(
            f"the transport {transport!r} is not known to be nonexpansive"
        )
    return weights


def fingerprint(params: Params) -> str:
    """Return the SHA-256 of all weights with their names, types and shapes."""
    digest = hashlib.sha256()
    # With names and shapes: two trees of the same bytes are not the same weights.
    for path, leaf in jax.tree_util.tree_flatten_with_path(unfold(params))[0]:
        array = np.asarray(leaf)
        digest.update(
            f"{jax.tree_util.keystr(path)} {array.dtype} {array.shape} ".encode()
        )
        digest.update(array.tobytes())
    return digest.hexdigest()


def one_thread() -> AbstractContextManager[object]:
    """Limit BLAS to one thread, which is faster for matrices of this size.

    On busy cores two threads are a hundred times slower.
    """
    try:
        from threadpoolctl import threadpool_limits
    except ImportError:  # to verify a certificate, no speed is needed
        return nullcontext()
    return threadpool_limits(1, user_api="blas")
