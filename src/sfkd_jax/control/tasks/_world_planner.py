"""Planners that see poses in the world, behind a shield that works along a path."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from sfkd_jax.control._finite import all_finite
from sfkd_jax.control.tasks._along_path import Preview
from sfkd_jax.geometry import HEADING, LATERAL, PATH_SPEED, PathState, compose
from sfkd_jax.info import ControllerInfo, PlanInfo, reported
from sfkd_jax.rollout import Offset
from sfkd_jax.types import (
    POSE,
    Control,
    Controller,
    Key,
    Params,
    Reference,
    State,
)


class Request(NamedTuple):
    """State of a planner in the world, with the observation and reference it sees."""

    inner: Any
    observation: State
    reference: Reference


def requesting(planner: Controller, horizon: int, coordinates: int) -> Controller:
    """Return a planner in the world as one along a path, see `behind`.

    Where all of ξ is measured, the planner observes what the caller does, bit for bit.
    Elsewhere it observes the state that a gate believes.

    Args:
        planner: any controller in the world.
        horizon: number of steps of the reference.
        coordinates: size of ξ.
    """

    def init(key: Key) -> Request:
        return Request(
            planner.init(key), jnp.zeros(coordinates + 1), jnp.zeros((horizon, 4))
        )

    def act(
        params: Params, state: Request, xi: PathState, env: Any, preview: Preview
    ) -> tuple[Control, Request, ControllerInfo]:
        # What an adaptation adds to the model is not that of another planner.
        if isinstance(params, Offset):
            params = params.params
        believed = _in_the_world(xi, preview, state.reference)
        seen = jnp.where(jnp.all(preview.measured), state.observation, believed)
        planned, memory, planner_info = planner.act(
            params, state.inner, seen, env, state.reference
        )
        planned = jnp.asarray(planned, dtype=float)
        if planned.shape != (2,):
            raise ValueError(f"a planner's control has shape (2,), got {planned.shape}")
        working = all_finite(planned) & reported(planner_info).healthy
        info = ControllerInfo(plan=PlanInfo(healthy=working), planner=planner_info)
        return planned, state._replace(inner=memory), info

    return Controller(init, act)


def behind(shielded: Controller) -> Controller:
    """Return a shielded controller in the world whose planner is `requesting`.

    The planner may lie at any depth. The projection onto the path loses observation and
    reference, so they travel in the state of the planner, past all wrappers. The
    planner's own `info` is the part `planner` of the result.
    """

    def act(
        params: Params, state: Any, observation: Any, env: Any, reference: Any
    ) -> tuple[Control, Any, ControllerInfo]:
        def shown(node: Any) -> Any:
            if not _is_request(node):
                return node
            return node._replace(observation=observation, reference=reference)

        state = jax.tree.map(shown, state, is_leaf=_is_request)
        control, after, info = shielded.act(params, state, observation, env, reference)
        # What the planner planned, in the world; whether it works is known already.
        plan = reported(info.planner).plan._replace(healthy=info.plan.healthy)
        return control, after, info._replace(plan=plan)

    return Controller(shielded.init, act)


def _is_request(node: Any) -> bool:
    return isinstance(node, Request)


def _in_the_world(xi: PathState, preview: Preview, reference: Reference) -> State:
    """Return the state of a vehicle at ξ beside a reference."""
    curvature = preview.road[0, 0]
    along = preview.along
    left = xi[LATERAL] + 0.5 * curvature * along**2
    motion = jnp.stack([along, left, xi[HEADING] + curvature * along])
    pose = compose(reference[0, POSE], motion)
    return jnp.concatenate([pose, xi[PATH_SPEED:]])
