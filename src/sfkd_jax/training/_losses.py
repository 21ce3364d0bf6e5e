"""The training loss: multi-step prediction in physical units and latent consistency."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.ranges import Numbers, Positive
from sfkd_jax.rollout import Folded, fold, rollout, state_errors
from sfkd_jax.types import BODY, Environment, Model, Params, Scalar, Space, Trajectory

Parts: TypeAlias = dict[str, Scalar]
Evaluated: TypeAlias = tuple[Scalar, Parts, Float[Array, " window"]]


class Loss(NamedTuple):
    """A training loss: called with parameters and windows, it returns loss and parts.

    Attributes:
        evaluate: (params, windows) -> loss, its parts, and the prediction error of each
            window. That error has the default weights, whatever weights are trained
            with.
        validate: the same, compiled, so that all callers share a program.
    """

    evaluate: Callable[[Params, Trajectory], Evaluated]
    validate: Callable[[Params, Trajectory], Evaluated]

    def __call__(self, params: Params, batch: Trajectory) -> tuple[Scalar, Parts]:
        """Return the loss and its parts, for the gradient."""
        return self.evaluate(params, batch)[:2]


GROWTH = 0.5
"""Default growth of the errors with the steps, see `multi_step_loss`."""


def power_mean(values: Float[Array, "*shape"], power: int = 8) -> Scalar:
    """Return (mean |x|^p)^(1/p), a smooth maximum that does not overflow in float32."""
    # The powers are those of ratios that are at most 1. The largest value is a constant
    # for the gradient.
    largest = jax.lax.stop_gradient(jnp.max(values))
    return largest * jnp.mean((values / largest) ** power) ** (1.0 / power)


def error_units(
    model: Model, space: Space, size: float = 1.0
) -> Float[Array, " state"]:
    """Return factors that convert each of `state_errors` to metres.

    See `Frame.lengths` and `Frame.length`, which are for a system of size 1. The
    entries in `Frame.distances` count relative to the size of the system, and other
    errors as they are.

    Args:
        model: in whose frame the errors are.
        space: scales of the model.
        size: of the system.

    Raises:
        ValueError: the frame states lengths of more entries than a state has.
    """
    frame = model.frame
    scales = [
        1.0 / size if entry in frame.distances else 1.0
        for entry in range(len(frame.lengths))
    ]
    first = jnp.asarray(frame.lengths) * jnp.asarray(scales)
    units = frame.length / jnp.asarray(space.body_scale)
    entries = BODY.start + len(units)
    if len(first) > entries:
        raise ValueError(
            f"the frame {frame.name!r} states lengths of {len(first)} entries, and a "
            f"state has {entries}"
        )
    return jnp.concatenate([first, units[len(first) - BODY.start :]])


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
    size: Positive = 1.0,
    tube: Numbers = (),
) -> Loss:
    """Return the mean prediction error over windows and steps, plus four regularisers.

        λ_p |x_k − x̂_k|²_W / (1 + γ (k − 1))² + λ_1 |x_k − x̂_{k|k−1}|²_{W}·10²
            + λ_c |d_k|² + λ_r |s − C Φ(x)|² + λ_t |Φ(x, e') − T(e → e') Φ(x, e)|²
            + Σ_i λ_i (|c_i| q(|d|) / (1 − α))²_W

    W measures position in units of 0.01 m at the first step. Errors grow about linearly
    with k. Divided by this growth, the near steps, on which a planner depends most,
    weigh as much as the far ones. The one-step term, in units of 0.001 m, includes what
    the sums over a window hide, such as a sideslip of a millimetre per step. The
    last sum is about the infinite-horizon tube of a certificate. c_i is row i of the
    read-out, and q is the 8th power mean over the batch, in place of the quantile of a
    calibration.

    Args:
        model: to be trained.
        space: scales of the model.
        prediction: λ_p, of free-running predictions; 0 leaves the one-step loss alone.
        one_step: λ_1, of predictions from the true state one step before.
        consistency: λ_c, of the one-step latent defect d. A larger weight gives a
            tighter tube and a less accurate model, see `docs/certificate.md`.
        reconstruction: λ_r.
        transport: λ_t, with e' the environment of another window.
        growth: γ.
        size: of the system, see `error_units`.
        tube: λ_i of the first entries of the body state; () for none. It needs a model
            with a contraction rate by construction.

    Returns:
        The loss. With `tube` one of its parts is the first radius.
    """
    structure: Any = model.structure
    # The infinite-horizon radius divides by 1 − α, so α must be known in training.
    if tube and None in (structure.rate, structure.explicit):
        raise ValueError(
            "training.loss.tube needs model=sfkd…, which contracts by construction"
        )
    if len(tube) > space.body_mean.shape[0]:
        raise ValueError(
            f"training.loss.tube has {len(tube)} weights, "
            f"the body state {space.body_mean.shape[0]} entries"
        )
    units = error_units(model, space, size)
    weights = {
        "prediction": prediction,
        "one_step": one_step,
        "consistency": consistency,
        "reconstruction": reconstruction,
        "transport": transport,
    }

    def evaluate(params: Params, batch: Trajectory) -> Evaluated:
        # The e of another window, so that transport is trained between environments
        # that differ.
        others = jnp.roll(batch.envs[:, -1], 1, axis=0)
        # The bounds of the weights are enforced once, for all uses of the weights.
        params = fold(model, params)
        window = partial(_window_parts, model, space, units, growth, params)
        parts, scores, defects = jax.vmap(window)(batch, others)
        parts = {name: jnp.mean(part) for name, part in parts.items()}
        total = jnp.zeros(())
        radii = None
        if tube:
            # |c_i| q(|d|) / (1 − α) of the first entries, in their units. A tube
            # belongs to the batch and not to one of its windows.
            rows = structure.explicit(params).readout[: len(tube)]
            size = jnp.linalg.norm(rows, axis=1) * power_mean(defects)
            radii = size / (1.0 - structure.rate(params))
            scaled = radii * units[BODY][: len(tube)] / 0.01
            total = jnp.sum(jnp.asarray(tube) * scaled**2)
        for name, part in parts.items():
            # The penalty of a model has its own weight, and none here.
            total = total + weights.get(name, 1.0) * part
        if radii is not None:
            parts["tube"] = radii[0]
        return total, parts, scores

    return Loss(evaluate, jax.jit(evaluate))


def one_step_loss(model: Model) -> Loss:
    """Return the mean square error of single steps, relative to their "scale".

    The scale is an entry of the parameters: the standard deviations of the residuals of
    least squares, see `models.one_step`.
    """

    def error(params: Params, data: Trajectory) -> Scalar:
        after = rollout(model, params, data).single
        # Errors and scale are in the frame of the body.
        errors = state_errors(model.frame, after, data.states[1:])
        return jnp.mean((errors / jax.lax.stop_gradient(params["scale"])) ** 2)

    return _mean_of(error)


def planning_loss(
    model: Model, params: Params, space: Space, size: float = 1.0
) -> Loss:
    """Return the mean square error of single steps of `model.planning` [mm²].

    The parameters of the loss are the weights of the residual alone. A rollout of
    states is right where its steps are.

    Args:
        model: with a residual for planners.
        params: of the model; its certified weights are not changed.
        space: scales of the model.
        size: of the system, see `error_units`.
    """
    units = error_units(model, space, size) / 0.001
    # The certified weights are frozen, so they are folded once.
    frozen = fold(model, params)
    planning = model if model.planning is None else model.planning

    def error(weights: Params, data: Trajectory) -> Scalar:
        folded = Folded({**params, "planning": weights}, frozen.shared)
        after = rollout(planning, folded, data).single
        errors = state_errors(model.frame, after, data.states[1:])
        return jnp.mean((errors * units) ** 2)

    return _mean_of(error)


def _mean_of(error: Callable[[Params, Trajectory], Scalar]) -> Loss:
    """Return the loss that is the mean of an error over the windows of a batch."""

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
) -> tuple[Parts, Scalar, Float[Array, " time"]]:
    """Evaluate the loss of one window.

    Args:
        model: to be trained.
        space: scales of the model.
        units: of `state_errors`, see `error_units`.
        growth: γ.
        size: of the system, see `error_units`.
        params: of the model.
        data: the window.
        other: environment of another window.

    Returns:
        The parts of the loss, the prediction error with the default weights, and |d|.
    """
    predicted = rollout(model, params, data)
    errors = state_errors(model.frame, predicted.free, data.states[1:])

    def prediction(growth: float) -> Scalar:
        # Errors grow about linearly. Without this factor the far steps would decide.
        steps = 1.0 + growth * jnp.arange(errors.shape[0])
        weighted = (errors * units / 0.01 / steps[:, None]) ** 2
        return jnp.mean(jnp.sum(weighted, axis=1))

    # In millimetres: a slip of one millimetre a step hides in the sums over a window.
    single = state_errors(model.frame, predicted.single, data.states[1:])
    single = single * units / 0.001
    # The regularisers are about the first state, and the fiber is that of its step.
    fiber = jax.tree.map(lambda leaf: leaf[0], predicted.fibers)
    other_fiber = model.fiber(params, other)
    latent = model.encode(fiber, data.states[0])
    transported = model.vector(model.transport(fiber, other_fiber, latent))
    encoded = model.vector(model.encode(other_fiber, data.states[0]))
    rebuilt = model.decode(fiber, latent)
    body_error = (rebuilt - data.states[0])[BODY] / space.body_scale
    parts = {
        "prediction": prediction(growth),
        "one_step": jnp.mean(jnp.sum(single**2, axis=1)),
        "consistency": jnp.mean(jnp.sum(predicted.defects**2, axis=1)) / 1e-4,
        "reconstruction": jnp.sum(body_error**2) / 1e-4,
        "transport": jnp.sum((transported - encoded) ** 2) / 1e-4,
    }
    if model.fitting.penalty is not None:
        parts["penalty"] = model.fitting.penalty(fiber, latent, data.controls[0])
    score = prediction(GROWTH) + parts["one_step"] + parts.get("penalty", 0.0)
    # The small number keeps the gradient of the root finite at 0.
    sizes = jnp.sqrt(jnp.sum(predicted.defects**2, axis=1) + 1e-16)
    return parts, score, sizes
