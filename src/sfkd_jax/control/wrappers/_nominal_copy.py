"""A nominal copy of the vehicle: the model driven with the vehicle's own inputs."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sfkd_jax.control.laws._path_law import PathLaw
from sfkd_jax.control.planners._plans import all_finite
from sfkd_jax.control.tasks._along_path import curvature_ahead, path_coordinates
from sfkd_jax.geometry import LATERAL, PathState, is_valid, path_state
from sfkd_jax.rollout import fold
from sfkd_jax.types import (
    BODY,
    Control,
    Environment,
    Key,
    Latent,
    Model,
    Params,
    Reference,
    Scalar,
    State,
)

Limits: TypeAlias = tuple[float, ...]
Box: TypeAlias = tuple[Float[Array, " entry"], Float[Array, " entry"]]


class CopyState(NamedTuple):
    """The nominal copy between two control steps.

    Attributes:
        latent: in the fibre of `env`; 0 before the start.
        started: whether the copy is running.
        env: the last finite environment, clipped to its box; NaN before the first one.
        preview: κ [1/m] and v_ref [m/s] over the next steps of the last finite
            reference; NaN before the first one.
    """

    latent: Latent
    started: Bool[Array, ""]
    env: Environment
    preview: Float[Array, "preview 2"]

    def advanced(self, latent: Latent) -> CopyState:
        """Return the copy one step later; it stops if its latent is not finite."""
        running = self.started & all_finite(latent)
        return self._replace(
            latent=_where(running, latent, self.latent), started=running
        )


class Validity(NamedTuple):
    """Where a certificate applies; boxes are pairs (low, high).

    Attributes:
        env: box of e.
        state: box of ξ.
        preview: box of (κ, v_ref).
        distance: largest |e_y − ê_y| between vehicle and copy [m].
        reanchor: whether a copy beyond that distance is moved to the measurement.
    """

    env: Box
    state: Box
    preview: Box
    distance: float
    reanchor: bool


class CopyUpdate(NamedTuple):
    """Vehicle and copy at one control step.

    Attributes:
        state: the copy, in the fibre of the current environment, moved to the
            measurement if necessary.
        fiber: of that environment.
        law_control: control of the law at the measurement or, without one, at the copy.
        applicable: whether that control is finite and the copy is running.
        void: whether the copy is running and the certificate does not apply here.
        copy: ξ of the copy; NaN before the start.
        copy_distance: |e_y − ê_y| [m]; NaN without comparison.
        broken: whether that distance exceeds its bound.
        dead_reckoning: whether the copy is running without a measurement.
        env_inside: whether e is in its box.
    """

    state: CopyState
    fiber: Any
    law_control: Control
    applicable: Bool[Array, ""]
    void: Bool[Array, ""]
    copy: PathState
    copy_distance: Scalar
    broken: Bool[Array, ""]
    dead_reckoning: Bool[Array, ""]
    env_inside: Bool[Array, ""]


def update_copy(
    model: Model,
    law: PathLaw,
    valid: Validity,
    params: Params,
    before: CopyState,
    measured: tuple[State, Environment, Reference],
) -> CopyUpdate:
    """Compare the copy with a measurement, and evaluate the law and the certificate.

    Args:
        model: of the closed loop, with `along_path`.
        law: around which it was learned.
        valid: where its certificate applies.
        params: folded or not.
        before: the copy, as `CopyState.advanced` returned it.
        measured: observation, e and reference in the world; each may be not finite.
    """
    observation, env, reference = measured
    last_env = jnp.where(all_finite(env), env, before.env)
    inside = jnp.clip(last_env, *valid.env)
    readable = all_finite(reference)
    preview = jnp.where(
        readable,
        _preview(reference, before.preview.shape[0]),
        _next_preview(before.preview),
    )
    folded = fold(model, params)
    fiber = model.fiber(folded, inside)

    def switched() -> Latent:
        return model.transport(model.fiber(folded, before.env), fiber, before.latent)

    latent = jax.lax.cond(
        jnp.all(inside == before.env), lambda: before.latent, switched
    )
    vehicle = path_coordinates(observation, reference[0], preview[0, 0])
    anchor = model.encode(fiber, path_state(vehicle))
    clean = readable & all_finite((observation, vehicle, anchor))
    distance = jnp.abs(vehicle - model.decode(fiber, latent)[BODY])[LATERAL]
    compared = clean & before.started
    broken = compared & ~(distance <= valid.distance)
    started = before.started | clean
    latent = _where(
        clean & (~before.started | (broken & valid.reanchor)), anchor, latent
    )

    copy = model.decode(fiber, latent)[BODY]
    xi = jnp.where(clean, vehicle, copy)
    law_control = law(xi, preview[0, 0], preview[0, 1], inside)
    applicable = started & all_finite(law_control)
    covered = applicable & jnp.all(inside == last_env)
    covered &= is_valid(xi[LATERAL], preview[0, 0])
    covered &= _within(xi, valid.state) & _within(preview[0], valid.preview)
    void = started & ~covered
    return CopyUpdate(
        state=CopyState(latent, started, inside, preview),
        fiber=fiber,
        law_control=law_control,
        applicable=applicable,
        void=void,
        copy=jnp.where(started, copy, jnp.nan),
        copy_distance=jnp.where(compared, distance, jnp.nan),
        broken=broken,
        dead_reckoning=started & ~clean,
        env_inside=jnp.all(inside == env),
    )


def initial_copy(
    model: Model, environments: int, coordinates: int, horizon: int
) -> Callable[[], CopyState]:
    """Return the function that makes a copy that has not started.

    Args:
        model: of the closed loop; only shapes are evaluated, and only once.
        environments: size of e.
        coordinates: size of ξ.
        horizon: number of previewed steps.
    """

    def encode(key: Key) -> Latent:
        fiber = model.fiber(fold(model, model.init(key)), jnp.zeros(environments))
        return model.encode(fiber, path_state(jnp.zeros(coordinates)))

    shapes = jax.eval_shape(encode, jax.random.key(0))

    def initial() -> CopyState:
        return CopyState(
            latent=jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes),
            started=jnp.asarray(False),
            env=jnp.full(environments, jnp.nan, dtype=float),
            preview=jnp.full((horizon, 2), jnp.nan, dtype=float),
        )

    return initial


def as_box(name: str, low: Limits | None, high: Limits | None, size: int) -> Box:
    """Return limits as arrays, infinite where None.

    Args:
        name: of the limits, for messages.
        low: lower limits.
        high: upper limits.
        size: number of entries.

    Raises:
        ValueError: the size is wrong, or a lower limit exceeds the upper one.
    """
    bottom = (-math.inf,) * size if low is None else low
    top = (math.inf,) * size if high is None else high
    sized = len(bottom) == len(top) == size
    if not sized or not all(a <= b for a, b in zip(bottom, top, strict=True)):
        raise ValueError(
            f"{name}_low must lie below {name}_high, {size} entries each, "
            f"got {low} and {high}"
        )
    return jnp.asarray(bottom, dtype=float), jnp.asarray(top, dtype=float)


def _within(point: Float[Array, " entry"], box: Box) -> Bool[Array, ""]:
    """Whether a point is in a box; False for NaN."""
    return jnp.all((box[0] <= point) & (point <= box[1]))


def _preview(reference: Reference, horizon: int) -> Float[Array, "preview 2"]:
    """κ and v_ref of the next steps; beyond the reference, its last ones."""
    known = jnp.stack([curvature_ahead(reference), reference[:, 3]], axis=1)
    return known[jnp.minimum(jnp.arange(horizon), known.shape[0] - 1)]


def _next_preview(preview: Float[Array, "preview 2"]) -> Float[Array, "preview 2"]:
    """The same preview one step later."""
    return jnp.concatenate([preview[1:], preview[-1:]])


def _where(condition: Bool[Array, ""], left: Latent, right: Latent) -> Latent:
    """`jnp.where` for latents."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), left, right)
