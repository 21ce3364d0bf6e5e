"""The tube of the worst case: a proved bound of the one-step error, and what follows.

    |d(ξ, n, ν, ρ, e)|_P ≤ d_0 for all arguments of the domain
    ⟹  |z - ẑ|_P ≤ R = d_0 / (1 - α),   |y - ŷ| ≤ L R

The latent ẑ of the nominal model F, which is driven with the same ν, ρ and e, contracts
at the proved rate α:

    |z⁺ - ẑ⁺| ≤ |F(z) - F(ẑ)| + |d| ≤ α |z - ẑ| + d_0

So a distance of R at most stays so for every sequence of references, environments,
planners and sensor errors of the domain, for as long as the states of the system stay
in it. This is about the programs as functions of real numbers; the rounding of a step
in float32 is no part of it.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from sfkd_jax.certificate import OutputMetric
from sfkd_jax.enclosures import check_cover, search_cover
from sfkd_jax.ranges import AtLeastOne, Fraction, NonNegative
from sfkd_jax.tubes._one_step import Cells, OneStep
from sfkd_jax.types import Key

STARTS = 256
"""Points from which the sampled error is driven uphill."""
CLIMB = 150
"""Steps uphill."""
ROOM = 1.0 + 1e-9
"""For the rounding of the ends of cells, between which slivers of 1e-16 may be left."""


@dataclass(frozen=True, kw_only=True)
class WorstCase:
    """The tube of one output, for every sequence.

    Attributes:
        one_step: d_0, in |·|_P. It is proved by the cover.
        radius: R, in |·|_P.
        bound: of |y - ŷ|, in the unit of the output.
        sampled: the largest |d|_P that a search found. It is reached, so that no proof
            is below it.
        leaves: of the cover.
        leaves_sha256: hash of the codes of the cover.
        seconds: that the proof took [s].
    """

    one_step: NonNegative
    radius: NonNegative
    bound: NonNegative
    sampled: NonNegative
    leaves: AtLeastOne
    leaves_sha256: str
    seconds: NonNegative


class WorstCaseRefused(Exception):
    """No bound is proved; the message gives the reason."""


def sampled_worst(
    error: OneStep, claim: OutputMetric, key: Key, *, samples: AtLeastOne = 100_000
) -> tuple[float, Float[np.ndarray, " variable"], int]:
    """Return a large |d|_P with its variables and its cell, by ascent from samples.

    Args:
        error: the one-step error.
        claim: metric of an output.
        key: of the samples; consumed.
        samples: number of points that are tried first.
    """
    root = jnp.asarray(np.linalg.cholesky(np.asarray(claim.metric)).T, jnp.float32)
    tables = [jnp.asarray(part, jnp.float32) for part in error.cells]
    count = len(error.cells.middle)

    def size(at: Array, cell: Array) -> Array:
        here = Cells(*(part[cell] for part in tables))
        return jnp.linalg.norm(root @ error.difference(at, here))

    def uphill(at: Array, cells: Array) -> Array:
        def moved(at: Array, step: Array) -> tuple[Array, None]:
            slopes = jnp.nan_to_num(jax.vmap(jax.grad(size))(at, cells))
            at = at + 0.3 / (1.0 + 0.1 * step) * jnp.sign(slopes)
            return jnp.clip(at, -1.0, 1.0), None

        return jax.lax.scan(moved, at, jnp.arange(float(CLIMB)))[0]

    place_key, cell_key = jax.random.split(key)
    # Half of the entries are at an end of their range, where errors are largest.
    places = jax.random.uniform(
        place_key, (samples, error.variables), minval=-2.0, maxval=2.0
    )
    places = jnp.clip(places, -1.0, 1.0)
    cells = jax.random.randint(cell_key, (samples,), 0, count)
    sizes = jax.jit(jax.vmap(size))(places, cells)
    best = jnp.argsort(-sizes)[:STARTS]
    reached = jax.jit(uphill)(places[best], cells[best])
    sizes = jax.vmap(size)(reached, cells[best])
    largest = int(jnp.argmax(sizes))
    return (
        float(sizes[largest]),
        np.asarray(reached[largest]),
        int(cells[best][largest]),
    )


def prove_worst_case(
    error: OneStep,
    claim: OutputMetric,
    sampled: float,
    *,
    factor: float = 2.0,
    seconds: float = np.inf,
    first: Sequence[int] = (),
    told: Callable[[str], None] | None = None,
) -> tuple[WorstCase, UInt8[np.ndarray, " node"]]:
    """Return the tube of an output, and the codes of the cover that proves it.

    Args:
        error: the one-step error.
        claim: metric of the output, with its proved α and L.
        sampled: of `sampled_worst`.
        factor: bound that is looked for, relative to `sampled`.
        seconds: after which the search ends [s].
        first: variables along which every cell is halved first.
        told: is given a line of progress at each level.

    Raises:
        WorstCaseRefused: the search ended before all boxes were closed.
    """
    # The law is linear in the noise but for its limits, so that it is never halved.
    along = range(error.variables - len(error.noise))
    found = search_cover(
        error.error_in(np.asarray(claim.metric)),
        factor * sampled,
        along=along,
        first=first,
        seconds=seconds,
        told=told,
    )
    if found.open.count:
        raise WorstCaseRefused(
            f"after {found.seconds:.0f} s {found.open.count} boxes have a bound above "
            f"{factor:g} times the largest sampled error; the largest bound is "
            f"{found.largest:.4g}"
        )
    largest = found.largest * ROOM
    radius = largest / (1.0 - claim.alpha)
    tube = WorstCase(
        one_step=largest,
        radius=radius,
        bound=claim.lipschitz * radius,
        sampled=sampled,
        leaves=found.leaves,
        leaves_sha256=hash_of(found.codes),
        seconds=found.seconds,
    )
    return tube, found.codes


def check_worst_case(
    error: OneStep,
    claim: OutputMetric,
    tube: WorstCase,
    codes: UInt8[np.ndarray, " node"],
    *,
    share: Fraction = 1.0,
) -> None:
    """Check a tube, or a sample of its leaves.

    Args:
        error: the one-step error.
        claim: metric of the output, with its proved α and L.
        tube: from an untrusted source.
        codes: of its cover, from an untrusted source.
        share: of the leaves that are evaluated; 1 checks the proof.

    Raises:
        WorstCaseRefused: the tube is not the one of this cover.
        CoverRefused: the cover does not prove d_0.
    """
    radius = tube.one_step / (1.0 - claim.alpha)
    if hash_of(codes) != tube.leaves_sha256:
        raise WorstCaseRefused("the leaves are not those of the tube")
    if not (claim.alpha < 1.0 and radius <= tube.radius * ROOM):
        raise WorstCaseRefused("the radius does not follow from one_step and alpha")
    if not claim.lipschitz * tube.radius <= tube.bound * ROOM:
        raise WorstCaseRefused("the bound does not follow from the radius")
    question = error.error_in(np.asarray(claim.metric))
    leaves = check_cover(question, codes, tube.one_step / ROOM, share=share)
    if leaves != tube.leaves:
        raise WorstCaseRefused("the number of leaves is another")


def hash_of(codes: UInt8[np.ndarray, " node"]) -> str:
    """Return the hash of the codes of a cover."""
    return hashlib.sha256(np.ascontiguousarray(codes, np.uint8).tobytes()).hexdigest()
