"""A nominal copy of the car: the model beside it, driven with its inputs, not corrected."""

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
from sfkd_jax.core.folding import fold
from sfkd_jax.core.path_frame import LATERAL, is_valid, path_state
from sfkd_jax.types import (
    BODY,
    Control,
    Environment,
    Key,
    Latent,
    Model,
    Params,
    Reference,
    State,
)

Limits: TypeAlias = tuple[float, ...]
Box: TypeAlias = tuple[Float[Array, " entry"], Float[Array, " entry"]]


class CopyState(NamedTuple):
    """The copy between two control steps.

    Attributes:
        latent: in the fibre of `env`; 0 before the start.
        started: whether the copy runs.
        env: the last finite environment, within its box; NaN before the first one.
        ahead: κ [1/m] and v_ref [m/s] over the next steps as of the last finite
            reference; NaN before the first one.
    """

    latent: Latent
    started: Bool[Array, ""]
    env: Environment
    ahead: Float[Array, "preview 2"]

    def stepped(self, latent: Latent) -> CopyState:
        """With the latent one step later; a copy that is not finite has to start anew."""
        running = self.started & all_finite(latent)
        return self._replace(
            latent=_where(running, latent, self.latent), started=running
        )


class Validity(NamedTuple):
    """Where a certificate speaks: boxes as (low, high), and the largest |e_y − ê_y| [m].

    Attributes:
        env, state, preview: boxes of e, ξ and (κ, v_ref).
        distance: between car and copy.
        reanchor: whether a copy beyond it is put at the measurement.
    """

    env: Box
    state: Box
    preview: Box
    distance: float
    reanchor: bool


class Located(NamedTuple):
    """Car and copy at one control step.

    Attributes:
        state: the copy, in the fibre of the environment now, anchored if need be.
        fiber: of that environment.
        lawful: what the law asks for, at the measurement or, without one, at the copy.
        applicable: whether that is finite and the copy runs.
        void: whether the copy runs and the certificate says nothing here.
    """

    state: CopyState
    fiber: Any
    lawful: Control
    applicable: Bool[Array, ""]
    void: Bool[Array, ""]


def locate(
    model: Model,
    law: PathLaw,
    valid: Validity,
    params: Params,
    before: CopyState,
    seen: tuple[State, Environment, Reference],
) -> tuple[Located, dict[str, Array]]:
    """Where car and copy are, what the law asks for, and what speaks against a certificate.

    Args:
        model: of the closed loop, `along_path`.
        law: around which it was learned.
        valid: where its certificate speaks.
        params: folded or not.
        before: the copy, as `CopyState.stepped` left it.
        seen: observation and reference in the world, and e; each may be not finite.

    Returns:
        `Located`, and entries for a controller's `info`, see `shielded`.
    """
    observation, env, reference = seen
    told = jnp.where(all_finite(env), env, before.env)
    inside = jnp.clip(told, *valid.env)
    readable = all_finite(reference)
    ahead = jnp.where(
        readable, _preview(reference, before.ahead.shape[0]), _later(before.ahead)
    )
    folded = fold(model, params)
    fiber = model.fiber(folded, inside)

    def switched() -> Latent:
        return model.transport(model.fiber(folded, before.env), fiber, before.latent)

    latent = jax.lax.cond(
        jnp.all(inside == before.env), lambda: before.latent, switched
    )
    measured = path_coordinates(observation, reference[0], ahead[0, 0])
    anchor = model.encode(fiber, path_state(measured))
    clean = readable & all_finite((observation, measured, anchor))
    distance = jnp.abs(measured - model.decode(fiber, latent)[BODY])[LATERAL]
    compared = clean & before.started
    broken = compared & ~(distance <= valid.distance)
    started = before.started | clean
    latent = _where(
        clean & (~before.started | (broken & valid.reanchor)), anchor, latent
    )

    copy = model.decode(fiber, latent)[BODY]
    xi = jnp.where(clean, measured, copy)
    lawful = law(xi, ahead[0, 0], ahead[0, 1], inside)
    applicable = started & all_finite(lawful)
    covered = applicable & jnp.all(inside == told) & is_valid(xi[LATERAL], ahead[0, 0])
    covered &= _within(xi, valid.state) & _within(ahead[0], valid.preview)
    void = started & ~covered
    flags = {
        "copy": jnp.where(started, copy, jnp.nan),
        "copy_distance": jnp.where(compared, distance, jnp.nan),
        "broken": broken,
        "void": void,
        "dead_reckoning": started & ~clean,
        "env_inside": jnp.all(inside == env),
    }
    return Located(
        CopyState(latent, started, inside, ahead), fiber, lawful, applicable, void
    ), flags


def blank_copy(
    model: Model, environments: int, coordinates: int, horizon: int
) -> Callable[[], CopyState]:
    """() -> a copy that has not started; of the model only shapes are evaluated, once."""

    def encoded(key: Key) -> Latent:
        fiber = model.fiber(fold(model, model.init(key)), jnp.zeros(environments))
        return model.encode(fiber, path_state(jnp.zeros(coordinates)))

    shapes = jax.eval_shape(encoded, jax.random.key(0))

    def blank() -> CopyState:
        return CopyState(
            latent=jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes),
            started=jnp.asarray(False),
            env=jnp.full(environments, jnp.nan, dtype=float),
            ahead=jnp.full((horizon, 2), jnp.nan, dtype=float),
        )

    return blank


def as_box(name: str, low: Limits | None, high: Limits | None, size: int) -> Box:
    """Limits as arrays, infinite where None.

    Raises:
        ValueError: of another size, or reversed.
    """
    bottom = (-math.inf,) * size if low is None else low
    top = (math.inf,) * size if high is None else high
    sized = len(bottom) == len(top) == size
    if not sized or not all(a <= b for a, b in zip(bottom, top, strict=True)):
        raise ValueError(
            f"{name}_low must lie below {name}_high, {size} entries each, got {low} and {high}"
        )
    return jnp.asarray(bottom, dtype=float), jnp.asarray(top, dtype=float)


def _within(point: Float[Array, " entry"], box: Box) -> Bool[Array, ""]:
    """Whether a point is in a box; False for NaN."""
    return jnp.all((box[0] <= point) & (point <= box[1]))


def _preview(reference: Reference, horizon: int) -> Float[Array, "preview 2"]:
    """κ and v_ref of the next steps; the last ones are held."""
    known = jnp.stack([curvature_ahead(reference), reference[:, 3]], axis=1)
    return known[jnp.minimum(jnp.arange(horizon), known.shape[0] - 1)]


def _later(ahead: Float[Array, "preview 2"]) -> Float[Array, "preview 2"]:
    """The same preview one step later."""
    return jnp.concatenate([ahead[1:], ahead[-1:]])


def _where(chosen: Bool[Array, ""], left: Latent, right: Latent) -> Latent:
    """`jnp.where` for latents."""
    return jax.tree.map(lambda a, b: jnp.where(chosen, a, b), left, right)
