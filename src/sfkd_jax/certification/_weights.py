"""The explicit weights of a model in float64, or the reason for refusing them."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, TypeAlias

import jax
import numpy as np

from sfkd_jax.rollout import fold, on_host, unfold
from sfkd_jax.types import BODY, BODY_FRAME, Frame, Model, Params, Samples

ACTIVATIONS = ("tanh", "relu", "sigmoid", "softplus", "elu")
"""Activations with slopes in [0, 1] everywhere, which excludes gelu and silu."""
TRANSPORTS = ("identity", "rotation")
"""Kinds of transport that do not enlarge distances of latent states."""
RESERVED = ("latent", "residual_slopes", "transport", "step", "step_slopes")
"""Names of errors and attacks that are not about an output; no output may have them."""
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


def require(holds: object, reason: str) -> None:
    """Refuse a certificate unless a condition holds.

    Callers write comparisons that are false for a NaN.

    Args:
        holds: the condition.
        reason: for the refusal.

    Raises:
        CertificationRefused: it does not hold.
    """
    if not holds:
        raise CertificationRefused(reason)


def require_all(checks: Mapping[str, object], where: str = "") -> None:
    """Refuse the first claim that does not hold.

    Args:
        checks: whether each claim holds, by its name.
        where: is written before the name.

    Raises:
        CertificationRefused: a claim does not hold.
    """
    for name, holds in checks.items():
        require(holds, f"{where}{name} does not follow from its witness")


@contextmanager
def well_formed() -> Iterator[None]:
    """Turn errors about values of unexpected types into a refusal, in one line."""
    try:
        yield
    except KeyError as reason:
        raise CertificationRefused(f"the certificate lacks {reason}") from None
    except MALFORMED as reason:
        raise CertificationRefused(
            f"the certificate is malformed: {' '.join(str(reason).split())}"
        ) from None


def exported(model: Model, params: Params) -> Exported:
    """Return the explicit weights of a model in float64.

    They are computed from the folded parameters, as in a controller.

    Raises:
        CertificationRefused: the model has no explicit weights, they are not finite, or
            too little is known about its operators, activation or transport.
    """
    explicit = model.structure.explicit
    if explicit is None:
        raise CertificationRefused("this model exposes no explicit weights to certify")
    weights = on_host(explicit, fold(model, params, on_host))
    _require_outputs(model.frame, weights)
    # Every float32 number is a float64 number, so that nothing is rounded here.
    weights = jax.tree.map(lambda leaf: np.asarray(leaf, dtype=np.float64), weights)
    finite = all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(weights))
    require(finite, "the weights are not finite")
    # However dense samples are, A(e) in between is unknown.
    if isinstance(weights.operators, Samples):
        raise CertificationRefused(
            f"grid-only evidence: {len(weights.operators.operators)} sampled "
            "environments prove nothing about those in between"
        )
    activation = weights.declared.activation
    transport = weights.declared.transport
    require(
        activation in ACTIVATIONS,
        f"slopes of the activation {activation!r} are not known in [0, 1]",
    )
    require(
        transport in TRANSPORTS,
        f"the transport {transport!r} is not known to be nonexpansive",
    )
    return weights


def _require_outputs(frame: Frame, weights: Exported) -> None:
    """Refuse a frame with outputs that no claim can be about.

    Args:
        frame: of the model.
        weights: of the model.
    """
    where = f"the frame {frame.name!r}"
    require(
        bool(weights.decoder) == frame.has_pose,
        f"{where} must have a pose exactly if the model has a decoder",
    )
    if frame.has_pose:
        # A decoder gives the position and the yaw, in this order.
        stated = BODY_FRAME.outputs
        require(
            list(frame.outputs.items()) == list(stated.items()),
            f"a certificate bounds the outputs {stated} of a state with a pose, in "
            f"this order; {where} states {dict(frame.outputs)}",
        )
        return
    require(frame.outputs, f"{where} states no outputs")
    size = BODY.start + len(weights.readout)
    for name in frame.outputs:
        require(
            name not in RESERVED,
            f"{where} states the output {name!r}, a name that has another meaning in "
            "a certificate",
        )
        try:
            entries = np.arange(size)[frame.entries(name)]
        except IndexError:
            entries = np.zeros(0)
        # The entries of the pose are always 0 in this frame.
        require(
            len(entries) and np.min(entries) >= BODY.start,
            f"{where} states the output {name!r} = {frame.outputs[name]}, which must "
            f"be entries {BODY.start} to {size - 1} of a state",
        )


def fingerprint(params: Params) -> str:
    """Return the SHA-256 of all weights with their names, types and shapes."""
    digest = hashlib.sha256()
    leaves, _ = jax.tree_util.tree_flatten_with_path(unfold(params))
    for path, leaf in leaves:
        array = np.asarray(leaf)
        name = jax.tree_util.keystr(path)
        # Two trees of the same bytes are the same weights only if names, types and
        # shapes are the same, too.
        digest.update(f"{name} {array.dtype} {array.shape} ".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


@contextmanager
def one_thread() -> Iterator[None]:
    """Limit BLAS to one thread.

    The matrices are small. On busy cores two threads are a hundred times slower.
    """
    try:
        from threadpoolctl import threadpool_limits
    except ImportError:  # Without it everything still works, and is slower.
        yield
    else:
        with threadpool_limits(1, user_api="blas"):
            yield
