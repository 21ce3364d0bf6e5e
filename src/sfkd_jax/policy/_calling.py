"""What stands before a controller: a check of its arguments, and its numerics."""

from __future__ import annotations

from functools import wraps
from typing import Any

import jax
import jax.numpy as jnp

from sfkd_jax.driving.lanes import padded
from sfkd_jax.geometry import relative, shifted
from sfkd_jax.policy._trained import TrainedModel, in_policy_numerics
from sfkd_jax.types import Controller, Key, Params


def with_capacity(controller: Controller, capacity: tuple[int, int]) -> Controller:
    """Return a controller in a lane that is compiled once for all numbers of obstacles.

    Args:
        controller: in a lane.
        capacity: number of obstacles, and of predicted positions of each.
    """
    if len(capacity) != 2 or min(capacity) < 1:
        raise ValueError(
            "capacity must be (obstacles, predicted positions), both 1 or more, "
            f"got {capacity}"
        )
    compiled = jax.jit(controller.act)

    @wraps(controller.act)
    def act(params: Params, state: Any, observation: Any, env: Any, scene: Any) -> Any:
        lane, obstacles = scene
        rows = padded(obstacles, *capacity)
        return compiled(params, state, observation, env, (lane, rows))

    return Controller(jax.jit(controller.init), act)


def entrance(controller: Controller, trained: TrainedModel) -> Controller:
    """Return the same controller, with `policy_numerics` and a check of its arguments.

    Positions in double precision are made relative before anything is float32.
    """
    names = trained.vehicle.state_names
    shape = (len(names),)
    env_shape = (len(trained.settings["space"]["env_mean"]),)
    # One program, where every array of the state would otherwise be one.
    compiled = jax.jit(controller.init)

    @wraps(controller.init)
    def init(key: Key) -> Any:
        if not trained.model.frame.has_pose and jax.debug_nans.value:
            raise ValueError(
                "jax_debug_nans: controllers along a path keep NaN for what is not "
                "known yet; switch it off"
            )
        return compiled(key)

    @wraps(controller.act)
    def act(
        params: Params, state: Any, observation: Any, env: Any, reference: Any
    ) -> Any:
        # Broadcasting would accept some, and others fail far from here.
        if jnp.shape(observation) != shape:
            raise ValueError(
                f"observation must have shape {shape}: {', '.join(names)}; "
                f"got {jnp.shape(observation)}"
            )
        if jnp.shape(env) != env_shape:
            raise ValueError(f"env must have shape {env_shape}, got {jnp.shape(env)}")
        near, ahead, origin = relative(observation, reference)
        moved = near is not observation
        control, state, info = controller.act(
            params, state, jnp.asarray(near), env, jnp.asarray(ahead)
        )
        if moved:
            # What is reported is in the world again, on the host in float64.
            states = shifted(info.plan.states, origin)
            info = info._replace(plan=info.plan._replace(states=states))
        return control, state, info

    return in_policy_numerics(Controller(init, act))
