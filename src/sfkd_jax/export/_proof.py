"""The proved part of a certificate as bytes, for the checker in C.

Integers are little-endian uint32, numbers are little-endian float64, and matrices are
written row by row, in the order of `read_proof` in `check_proof.c`:

    magic, version, rank, vertices, layers, outputs, widths of the hidden layers,
    SHA-256 of the weights, A of every vertex, W_1 … W_L, and for every output:
    bytes of its name, rows of C, name, α, L, P, C, multipliers of every vertex.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from sfkd_jax.certificate import OutputMetric
from sfkd_jax.policy import Policy, SystemPolicy

MAGIC = b"SFKDPRF\0"
VERSION = 1
"""Version of the order of the bytes; `check_proof.c` reads no other version."""
CHECKER = "check_proof.c"
"""The program in the export that checks the proof without Python."""
DOCUMENT = "proof.bin"


def exported_proof(trained: Policy | SystemPolicy) -> bytes | None:
    """Return the proof of a policy for the checker in C, None if there is none.

    There is none without a certificate, and where no output has a metric of its own, as
    in a frame with a pose.
    """
    certificate = trained.certificate
    if certificate is None or not certificate.proof.outputs:
        return None
    from sfkd_jax import certification  # loaded only to write a proof

    model = trained.model
    weights = certification.exported(model, trained.params)
    return proof_bytes(
        weights,
        certification.readouts(weights, model.frame),
        certificate.proof.outputs,
        trained.weights_sha256,
    )


def proof_bytes(
    weights: Any,
    readouts: Mapping[str, Float[np.ndarray, "rows rank"]],
    outputs: Mapping[str, OutputMetric],
    weights_sha256: str,
) -> bytes:
    """Return what the proof of the metrics of outputs needs, as bytes.

    Args:
        weights: explicit weights in float64, see `certification.exported`.
        readouts: rows of the read-out, by output.
        outputs: claims with their witnesses, by output.
        weights_sha256: hash of the weights, as 64 hexadecimal digits.
    """
    vertices = weights.operators.vertices
    hidden = [len(layer) for layer in weights.residual[:-1]]
    sizes = [vertices.shape[1], len(vertices), len(weights.residual), len(outputs)]
    parts = [MAGIC, _integers(VERSION, *sizes, *hidden)]
    parts += [bytes.fromhex(weights_sha256), _numbers([vertices, *weights.residual])]
    for name, claim in outputs.items():
        rows = readouts[name]
        encoded = name.encode()
        parts += [_integers(len(encoded), len(rows)), encoded]
        multipliers = (part for of_vertex in claim.joint for part in of_vertex)
        constants = [claim.alpha, claim.lipschitz]
        parts.append(_numbers([constants, claim.metric, rows, *multipliers]))
    return b"".join(parts)


def _integers(*values: int) -> bytes:
    return struct.pack(f"<{len(values)}I", *values)


def _numbers(arrays: Iterable[Any]) -> bytes:
    return b"".join(np.asarray(array, dtype="<f8").tobytes() for array in arrays)
