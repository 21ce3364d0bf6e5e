"""The training loss: multi-step prediction in physical units and latent consistency."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.geometry import HEADING, LATERAL
from sfkd_jax.ranges import Numbers
from sfkd_jax.rollout import Folded, fold, rollout, state_errors
from sfkd_jax.types import BODY, Environment, Model, Params, Scalar, Space, Trajectory

Parts: TypeAlias = dict[str, Scalar]
Evaluated: TypeAlias = tuple[Scalar, Parts, Float[Array, " window"]]


class Loss(NamedTuple):
    """A training loss: called with parameters and windows, it returns loss and parts.

    Attributes:
        evaluate: (params, windows) -> loss, its parts, and the prediction error of each
            window with the default weights, whatever is trained with.
        validate: the same, compiled, so that all who validate share a program.
    """

    evaluate: Callable[[Params, Trajectory], Evaluated]
    validate: Callable[[Params, Trajectory], Evaluated]

    def __call__(self, params: Params, batch: Trajectory) -> tuple[Scalar, Parts]:
        """Return the loss and its parts, for the gradient."""
        return self.evaluate(params, batch)[:2]


GROWTH = 0.5
"""Of the weights of later steps, by default."""
YAW_LENGTH = 5.0
"""Weight of 1 rad of yaw in the loss [m]: the distance driven in half a second at the
benchmark's speed.
"""


def power_mean(values: Float[Array, "*shape"], power: int = 8) -> Scalar:
    """Return (mean |x|^p)^(1/p), a smooth maximum that does not overflow in float32."""
    # Powers of ratios at most 1; the largest value itself carries no gradient.
    largest = jax.lax.stop_gradient(jnp.max(values))
    return largest * jnp.mean((values / largest) ** power) ** (1.0 / power)


def error_units(model: Model, space: Space) -> Float[Array, " state"]:
    """Return factors that convert each of `state_errors` to metres.

    1 for the position, 5 m for a radian of yaw, 0.2 m for the half width of any other
    entry. Along a path, e_y and e_ψ are position and yaw; the other entries do not
    affect the position directly and count 0.05 m.
    """
    # Yaw rate, slip and steering move the car along a path only in later steps.
    others = (0.05 if model.along_path else 0.2) / jnp.asarray(space.body_scale)
    if model.along_path:
        others = others.at[LATERAL].set(1.0).at[HEADING].set(YAW_LENGTH)
    return jnp.concatenate([jnp.asarray([1.0, 1.0, YAW_LENGTH]), others])


def multi_step_loss(
    model: Model,
    space: Space,
    *,
    prediction: float = 1.0,
    one_step: float = 1.0,
    consistency: float = 0.001,
    reconstruction: float = 0.1,
    transport: float = 0.1,
    growth: float = GROWTH,
    tube: Numbers = (),
) -> Loss:
    """Return the mean prediction error over windows and steps, plus four regularisers.

        λ_p |x_k − x̂_k|²_W / (1 + γ (k − 1))² + λ_1 |x_k − x̂_{k|k−1}|²_{W}·10²
            + λ_c |d_k|² + λ_r |s − C Φ(x)|² + λ_t |Φ(x, e') − T(e → e') Φ(x, e)|²
            + Σ_i λ_i (|c_i| q(|d|) / (1 − α))²_W

    W measures position in units of 0.01 m at the first step. Errors grow about linearly
    with k: divided by this growth, the near steps, on which the planner depends most,
    weigh as much as the far ones. The one-step term, in units of 0.001 m, sees what the
    sums over a window hide: slip, a lateral millimetre per step. The last sum is the
    infinite-horizon tube of a certificate: c_i is row i of the read-out, q the 8th
    power mean over the batch instead of the quantile of calibration.

    Args:
        model: to be trained.
        space: its scales.
        prediction: λ_p, of free-running predictions; 0 leaves the one-step loss alone.
        one_step: λ_1, of predictions from the true state one step before.
        consistency: λ_c, of the one-step latent defect: larger gives a tighter tube and
            a less accurate model, see `docs/certificate.md`.
        reconstruction: λ_r.
        transport: λ_t, with e' the environment of another window.
        growth: γ.
        tube: λ_i of the first entries of the body state; () for none. For a model with
            a contraction rate by construction.

    Returns:
        The loss; with `tube` one of its parts is the first radius.
    """
    known: Any = model.structure
    # The infinite-horizon radius divides by 1 − α, so α must be known in training.
    if tube and None in (known.rate, known.explicit):
        raise ValueError(
            "training.loss.tube needs model=sfkd…, which contracts by construction"
        )
    if len(tube) > space.body_mean.shape[0]:
        raise ValueError(
            f"training.loss.tube has {len(tube)} weights, "
            f"the body state {space.body_mean.shape[0]} entries"
        )
    units = error_units(model, space)
    window = partial(_window_parts, model, space, units, growth)
    weights = {
        "prediction": prediction,
        "one_step": one_step,
        "consistency": consistency,
        "reconstruction": reconstruction,
        "transport": transport,
    }

    def evaluate(params: Params, batch: Trajectory) -> Evaluated:
        # The e of another window: transport is trained between unlike environments.
        others = jnp.roll(batch.envs[:, -1], 1, axis=0)
        # Its bounds are enforced once for all that reads the weights.
        params = fold(model, params)
        parts = jax.vmap(window, in_axes=(None, 0, 0))(params, batch, others)
        scores = parts.pop("score")
        gaps = parts.pop("gap")
        parts = {name: jnp.mean(part) for name, part in parts.items()}
        start = jnp.zeros(())
        # After the mean over windows: a tube belongs to the batch, not to one of them.
        if tube:
            # |c_i| q(|d|) / (1 − α) of the first entries, in their units.
            rows = known.explicit(params).readout[: len(tube)]
            size = jnp.linalg.norm(rows, axis=1) * power_mean(gaps)
            radii = size / (1.0 - known.rate(params))
            scaled = radii * units[BODY][: len(tube)] / 0.01
            start = jnp.sum(jnp.asarray(tube) * scaled**2)
        # A part without a weight here, the penalty, has brought its own.
        total = sum(
            (weights.get(name, 1.0) * part for name, part in parts.items()), start
        )
        return total, parts | {"tube": radii[0]} if tube else parts, scores

    return Loss(evaluate, jax.jit(evaluate))


def one_step_loss(model: Model) -> Loss:
    """Return the mean square error of single steps, relative to their "scale".

    That is an entry of the parameters, see `models.one_step`: what least squares left.
    """

    def error(params: Params, data: Trajectory) -> Scalar:
        after = rollout(model, params, data).single
        # In the frame of the car, as the scale is.
        gap = state_errors(after, data.states[1:])
        return jnp.mean((gap / jax.lax.stop_gradient(params["scale"])) ** 2)

    return _mean_of(error)


def planning_loss(model: Model, params: Params, space: Space) -> Loss:
    """Return the mean square error of single steps of `model.planning` [mm²].

    Its weights alone are varied. Along a path z is the state, so that a rollout is
    right where its steps are.
    """
    # Folded, since what is certified is frozen.
    units = error_units(model, space) / 0.001
    frozen = fold(model, params)
    planning = model.planning or model

    def error(weights: Params, data: Trajectory) -> Scalar:
        own = Folded({**params, "planning": weights}, frozen.shared)
        after = rollout(planning, own, data).single
        return jnp.mean((state_errors(after, data.states[1:]) * units) ** 2)

    return _mean_of(error)


def _mean_of(error: Callable[[Params, Trajectory], Scalar]) -> Loss:
    """The loss that is the mean of an error over the windows of a batch."""

    def evaluate(params: Params, batch: Trajectory) -> Evaluated:
        errors = jax.vmap(error, in_axes=(None, 0))(params, batch)
        return jnp.mean(errors), {}, errors

    return Loss(evaluate, jax.jit(evaluate))


def _window_parts(
    model: Model,
    space: Space,
    units: Float[Array, " state"],
    growth: float,
    params: Params,
    data: Trajectory,
    other: Environment,
) -> dict[str, Array]:
    """The parts of the loss of one window; `other` is another window's environment."""
    known = rollout(model, params, data)
    errors = state_errors(known.free, data.states[1:])

    def prediction(growth: float) -> Scalar:
        # Errors grow about linearly; without this the far steps would decide alone.
        steps = 1.0 + growth * jnp.arange(errors.shape[0])
        weighted = (errors * units / 0.01 / steps[:, None]) ** 2
        return jnp.mean(jnp.sum(weighted, axis=1))

    # In millimetres: a slip of one a step hides in the sums over a window.
    near = state_errors(known.single, data.states[1:]) * units / 0.001
    # That of the first step: the regularisers below are about the first state.
    fiber = jax.tree.map(lambda leaf: leaf[0], known.fibers)
    there = model.fiber(params, other)
    here = model.encode(fiber, data.states[0])
    moved = model.vector(model.transport(fiber, there, here)) - model.vector(
        model.encode(there, data.states[0])
    )
    rebuilt = (model.decode(fiber, here) - data.states[0])[BODY] / space.body_scale
    parts = {
        "prediction": prediction(growth),
        "one_step": jnp.mean(jnp.sum(near**2, axis=1)),
        "consistency": jnp.mean(jnp.sum(known.defects**2, axis=1)) / 1e-4,
        "reconstruction": jnp.sum(rebuilt**2) / 1e-4,
        "transport": jnp.sum(moved**2) / 1e-4,
    }
    if model.fitting.penalty is not None:
        parts["penalty"] = model.fitting.penalty(fiber, here, data.controls[0])
    # Of free-running and of single steps, and what the model itself adds.
    score = prediction(GROWTH) + parts["one_step"] + parts.get("penalty", 0.0)
    # Away from 0, where the root has no gradient.
    size = jnp.sqrt(jnp.sum(known.defects**2, axis=1) + 1e-16)
    return parts | {"score": score, "gap": size}
