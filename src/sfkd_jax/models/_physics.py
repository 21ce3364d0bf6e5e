"""Known dynamics as a rollout model: the nominal bicycle, the true plant (oracle), and a plant with a biased e."""

from __future__ import annotations

from collections.abc import Callable

from sfkd_jax.types import BODY, Environment, Model, Step


def physics(
    step: Step,
    *,
    distort: Callable[[Environment], Environment] = lambda env: env,
    along_path: bool = False,
) -> Model:
    """A one-step function as a `Model`: the latent is the state itself.

    Args:
        step: (x, u, e) -> x one sampling period later, passed in by the caller (models
            never import the vehicle).
        distort: what the model believes e to be; a deliberately biased oracle has one.
        along_path: whether x and u are path states and w, see `path_frame`.
    """
    return Model(
        init=lambda key: {},
        fiber=lambda params, env: distort(env),
        encode=lambda fiber, state: state,
        step=lambda fiber, latent, control: step(latent, control, fiber),
        decode=lambda fiber, latent: latent,
        transport=lambda fiber, fiber_next, latent: latent,
        observe=lambda fiber, latent, state: state,
        vector=lambda latent: latent[BODY],
        along_path=along_path,
    )
