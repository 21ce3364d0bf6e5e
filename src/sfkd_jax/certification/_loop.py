"""The closed loop that a corridor is about, and the sensors of its law."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from sfkd_jax.control import PathLaw
from sfkd_jax.geometry import PERTURBATION
from sfkd_jax.plants import Vehicle, along_path
from sfkd_jax.rollout import fold
from sfkd_jax.types import BODY, Control, Environment, Key, Model, Params, State


class Loop(NamedTuple):
    """The closed loop of plant and law, and the model of the policy.

    Attributes:
        plant: the true plant with the law around it.
        law: of the policy, as are model and (folded) params.
        noise: standard deviations of the sensors.
    """

    plant: Vehicle
    law: PathLaw
    model: Model
    params: Params
    noise: tuple[float, ...]


def closed_loop(
    plant: Vehicle,
    model: Model,
    params: Params,
    law: PathLaw | None,
    noise: Sequence[float],
) -> Loop:
    """Return the closed loop of a plant and a policy's parts, with folded weights.

    Raises:
        ValueError: the policy has no law, so that there is no closed loop.
    """
    if law is None:
        raise ValueError(
            "a corridor needs a policy in path coordinates, with its law: "
            "model.frame=path"
        )
    folded = jax.jit(partial(fold, model))(params)
    closed = along_path(plant, law, perturbation=law.perturbation)
    return Loop(closed, law, model, folded, tuple(noise))


def sensor_effect(
    loop: Loop, key: Key, state: State, inputs: Control, env: Environment
) -> Array:
    """Return the change of ν because the law reads ξ through the sensors."""
    coordinates, road = state[BODY], inputs[PERTURBATION.stop :]
    spread = spread_of(loop.noise, state.shape[-1])[BODY]
    measured = coordinates + spread * jax.random.normal(key, coordinates.shape)
    # A law is a known function: reading ξ + n acts like a perturbation of ν.
    return loop.law(measured, road[0], road[1], env) - loop.law(
        coordinates, road[0], road[1], env
    )


def spread_of(noise: tuple[float, ...], size: int) -> Array:
    """Standard deviations of a path state from those of the sensors.

    e_y takes that of a position, e_ψ that of yaw, the other coordinates their own.
    """
    known = noise[1 : size - 2]
    return jnp.zeros(size).at[3 : 3 + len(known)].set(jnp.asarray(known))
