"""A model whose inputs and latent steps are shifted by data, not by other weights."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from sfkd_jax.types import (
    Control,
    Environment,
    Explicit,
    Fiber,
    Incremental,
    Key,
    Latent,
    Model,
    Params,
    State,
    Structure,
)


class Offset(NamedTuple):
    """Parameters of a model together with a shift of its steps.

    Attributes:
        params: of the model, folded or not.
        inputs: added to every control, as a bias of B(e) u and of the residual.
        latent: added to every latent step, a pytree like the latent; None for nothing.
    """

    params: Params
    inputs: Control
    latent: Latent | None


class OffsetFiber(NamedTuple):
    """The fiber of the model and the shift."""

    fiber: Fiber
    inputs: Control
    latent: Latent | None


def with_offset(model: Model) -> Model:
    """Return the model z⁺ = F(z, u + δ; e) + b with parameters `Offset`(params, δ, b).

    Neither δ nor b depends on z, so two predictions differ as those of the model do:
    the weights that a certificate is about, its rate and its witness are the same. δ
    and b are data, so changing them compiles nothing.

    Args:
        model: any model; its own parameters stay as they are.
    """

    def init(key: Key) -> Offset:
        return Offset(model.init(key), jnp.zeros(()), None)

    def fiber(params: Offset, env: Environment) -> OffsetFiber:
        return OffsetFiber(model.fiber(params.params, env), *params[1:])

    def step(fiber: OffsetFiber, latent: Latent, control: Control) -> Latent:
        after = model.step(fiber.fiber, latent, control + fiber.inputs)
        if fiber.latent is None:
            return after
        return jax.tree.map(jnp.add, after, fiber.latent)

    def encode(fiber: OffsetFiber, state: State) -> Latent:
        return model.encode(fiber.fiber, state)

    def decode(fiber: OffsetFiber, latent: Latent) -> State:
        return model.decode(fiber.fiber, latent)

    def transport(before: OffsetFiber, after: OffsetFiber, latent: Latent) -> Latent:
        return model.transport(before.fiber, after.fiber, latent)

    def observe(fiber: OffsetFiber, latent: Latent, state: State) -> Latent:
        return model.observe(fiber.fiber, latent, state)

    return model._replace(
        init=init,
        fiber=fiber,
        encode=encode,
        step=step,
        decode=decode,
        transport=transport,
        observe=observe,
        shared=None,
        structure=_structure(model.structure),
    )


def _structure(structure: Structure) -> Structure:
    """What is known of the weights, which an offset does not change."""
    explicit, rate = structure.explicit, structure.rate

    def explicit_of(params: Offset) -> Explicit | Incremental:
        assert explicit is not None
        return explicit(params.params)

    return Structure(
        explicit=explicit and explicit_of,
        rate=rate and (lambda params: rate(params.params)),
    )
