"""Planners that see poses in the world, behind a shield that works along a path."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp

from sfkd_jax.control import all_finite
from sfkd_jax.driving.path_coordinates import PathState
from sfkd_jax.driving.path_following.tasks._preview import Preview, state_beside
from sfkd_jax.info import ControllerInfo, reported
from sfkd_jax.rollout import Offset
from sfkd_jax.types import Control, Controller, Params


def in_the_world(planner: Controller) -> Controller:
    """Return a planner in the world as a controller along a path.

    Where all of ξ is measured, the planner observes what the caller does, bit for bit.
    Elsewhere it observes the state that a gate believes. The planner's own `info` is
    the part `planner` of the result.

    Args:
        planner: any controller in the world.
    """

    def act(
        params: Params, memory: Any, xi: PathState, env: Any, preview: Preview
    ) -> tuple[Control, Any, ControllerInfo]:
        # What an adaptation adds to the model is not that of another planner.
        if isinstance(params, Offset):
            params = params.params
        believed = state_beside(xi, preview)
        seen = jnp.where(jnp.all(preview.measured), preview.observation, believed)
        planned, memory, told = planner.act(
            params, memory, seen, env, preview.reference
        )
        planned = jnp.asarray(planned, dtype=float)
        if planned.shape != (2,):
            raise ValueError(f"a planner's control has shape (2,), got {planned.shape}")
        info = reported(told)
        working = all_finite(planned) & info.healthy
        # Its predicted states are in the world, and those along a path are ξ.
        plan = info.plan._replace(healthy=working, states=None)
        return planned, memory, ControllerInfo(plan=plan, planner=told)

    return Controller(planner.init, act)
