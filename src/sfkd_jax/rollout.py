"""Predictions of any `Model`: rollouts, one-step errors, folded and shifted models."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sfkd_jax.geometry import rotate, wrap_angle
from sfkd_jax.types import (
    Control,
    Environment,
    Fiber,
    Frame,
    Key,
    Latent,
    Model,
    Params,
    State,
    Structure,
    Trajectory,
)


class Folded(NamedTuple):
    """Parameters with the part of every fiber that does not depend on e.

    `Model.fiber` takes that part from here and does not compute it again.
    """

    weights: Params  # the parameters as they were learned and stored
    shared: Any  # `Model.shared` of these parameters


def on_host(function: Callable[[Params], Any], params: Params) -> Any:
    """Evaluate a function of the parameters on the host, as one program.

    Accelerators multiply float32 matrices with factors rounded to ten bits. Weights
    computed with them would not satisfy the witnesses that another machine found.
    Where JAX has no host device, the products are computed in full float32 precision.
    """
    try:
        host = jax.local_devices(backend="cpu")[0]
    except RuntimeError:  # JAX_PLATFORMS may name accelerators only.
        host = None
    with jax.default_device(host), jax.default_matmul_precision("float32"):
        evaluated = jax.jit(function)(jax.device_get(params))
    return jax.device_put(jax.device_get(evaluated))


def fold(model: Model, params: Params, evaluate: Any = None) -> Params:
    """Evaluate once what every control step would otherwise evaluate again.

    Parameters that are folded already, and those of a model without a shared part, are
    returned as they are.

    Args:
        model: that the parameters belong to.
        params: of the model.
        evaluate: (function, params) -> value, how `Model.shared` is evaluated. Outside
            of a compiled program, pass `on_host`, as `policy.load` does: all who fold
            parameters of this model then share one program. None calls it directly.
    """
    # Folding twice would wrap the weights twice, and `unfold` removes one layer.
    if model.shared is None or isinstance(params, Folded):
        return params
    if evaluate is None:
        return Folded(params, model.shared(params))
    return Folded(params, evaluate(model.shared, params))


def unfold(params: Params) -> Params:
    """Return the parameters as they were learned, folded or not."""
    return params.weights if isinstance(params, Folded) else params


class Offset(NamedTuple):
    """Parameters of a model together with a shift of its steps.

    `Model.fiber` of these parameters is an `Offset` too, with the same fields for a
    fiber.

    Attributes:
        params: parameters of the model, folded or not; in a fiber, the model's fiber.
        inputs: δ, added to every control, as a bias of B(e) u and of the residual.
        shift: (x, Δx), where every step adds Δx, lifted to the latent at x; in a fiber,
            that lifted shift b, a latent. None stands for no shift.
    """

    params: Any
    inputs: Control
    shift: Any


def with_offset(model: Model) -> Model:
    """Return the model z⁺ = F(z, u + δ; e) + b with parameters `Offset`(params, δ, b).

    Neither δ nor b depends on z, so that the difference of two predictions evolves as
    in the model without them. A certificate therefore stays valid: the weights that it
    is about, its rate and its witness are the same. δ and b are data, so that changing
    them compiles nothing anew.
    """

    def step(fiber: Offset, latent: Latent, control: Control) -> Latent:
        after = model.step(fiber.params, latent, control + fiber.inputs)
        # None instead of zeros: a model without a shift pays nothing for it.
        if fiber.shift is None:
            return after
        return jax.tree.map(jnp.add, after, fiber.shift)

    def init(key: Key) -> Offset:
        # A scalar 0 broadcasts over any control, whose size is not known here.
        return Offset(model.init(key), jnp.zeros(()), None)

    def fiber(params: Offset, env: Environment) -> Offset:
        model_fiber = model.fiber(params.params, env)
        if params.shift is None:
            return Offset(model_fiber, params.inputs, None)
        # The shift is given in states, since the model of a shield and the one of its
        # planner have different latents. Each model lifts it by its own encoder.
        state, state_shift = params.shift
        encode = partial(model.encode, model_fiber)
        _, latent_shift = jax.jvp(encode, (state,), (state_shift,))
        return Offset(model_fiber, params.inputs, latent_shift)

    def transport(before: Offset, after: Offset, latent: Latent) -> Latent:
        return model.transport(before.params, after.params, latent)

    def on_reference(fiber: Offset, inputs: Control) -> Offset:
        assert model.on_reference is not None
        return fiber._replace(params=model.on_reference(fiber.params, inputs))

    def unwrapped(function: Callable[..., Any] | None) -> Any:
        """Call a function of the model with what the `Offset` wraps."""
        if function is None:
            return None

        def inner(offset: Offset, *arguments: Any) -> Any:
            return function(offset.params, *arguments)

        return inner

    structure = model.structure
    return model._replace(
        init=init,
        fiber=fiber,
        encode=unwrapped(model.encode),
        step=step,
        decode=unwrapped(model.decode),
        transport=transport,
        observe=unwrapped(model.observe),
        # The parameters inside of an `Offset` are folded, not the `Offset`.
        shared=None,
        fitting=model.fitting._replace(step_fiber=None),
        on_reference=None if model.on_reference is None else on_reference,
        structure=Structure(
            explicit=unwrapped(structure.explicit), rate=unwrapped(structure.rate)
        ),
    )


def runge_kutta(derivative: Callable[[State], State], state: State, dt: float) -> State:
    """Return the state after dt by one classical Runge-Kutta step, error O(dt⁴)."""
    k1 = derivative(state)
    k2 = derivative(state + 0.5 * dt * k1)
    k3 = derivative(state + 0.5 * dt * k2)
    k4 = derivative(state + dt * k3)
    return state + dt / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)


def fibers_along(
    model: Model, params: Params, trajectory: Trajectory
) -> tuple[Fiber, Fiber]:
    """Return the fibers of e_0 … e_{T-1} and of e_1 … e_{T-1}, e_{T-1}."""
    step_fiber = model.fitting.step_fiber
    # All fibers are computed at once, as one matrix product, and not in a loop.
    if step_fiber is None:
        fibers = jax.vmap(partial(model.fiber, params))(trajectory.envs)
    else:
        step_fibers = jax.vmap(partial(step_fiber, params))
        fibers = step_fibers(trajectory.envs, trajectory.controls)
    # After the last step no further e is known: it is taken to stay as it is.
    later = jax.tree.map(lambda leaf: jnp.concatenate([leaf[1:], leaf[-1:]]), fibers)
    return fibers, later


class Predictions(NamedTuple):
    """Predictions of x_1 … x_T of one trajectory.

    Attributes:
        free: predicted from x_0 alone.
        single: each predicted from the true state before it.
        defects: d_k, the errors of single steps in latent coordinates.
        fibers: of e_0 … e_{T-1}.
    """

    free: Float[Array, "time state"]
    single: Float[Array, "time state"]
    defects: Float[Array, "time rank"]
    fibers: Fiber


def rollout(model: Model, params: Params, trajectory: Trajectory) -> Predictions:
    """Predict a trajectory freely from its start, and each step from its true state.

    The disturbances of the single steps are

        d_k = z_{k+1} − T(e_k → e_{k+1}) F(z_k, u_k, e_k),   z_k = Φ(x_k, e_k),

    where F is the latent step and T the transport. In a compiled program, results that
    are not used cost nothing.
    """
    fibers, later = fibers_along(model, params, trajectory)
    # The latents of all times are observed in the frame of the first one. In frames of
    # their own they could not be compared.
    first = jax.tree.map(lambda leaf: leaf[0], fibers)
    origin = model.encode(first, trajectory.states[0])
    observe = jax.vmap(model.observe, in_axes=(0, None, 0))
    now = observe(fibers, origin, trajectory.states[:-1])

    def step(latent: Latent, inputs: Any) -> tuple[Latent, Latent]:
        fiber, fiber_next, control = inputs
        # The step happens under e. Then z is transported to e', the next fiber.
        latent = model.transport(fiber, fiber_next, model.step(fiber, latent, control))
        return latent, latent

    inputs = fibers, later, trajectory.controls
    expected, _ = jax.vmap(step)(now, inputs)
    _, latents = jax.lax.scan(step, origin, inputs)
    # Transport has carried the predictions to the later fibers. The true states are
    # observed there too.
    after = observe(later, origin, trajectory.states[1:])
    return Predictions(
        free=jax.vmap(model.decode)(later, latents),
        single=jax.vmap(model.decode)(later, expected),
        defects=jax.vmap(model.vector)(after) - jax.vmap(model.vector)(expected),
        fibers=fibers,
    )


def windows(
    trajectories: Trajectory,
    rows: Int[Array, " batch"],
    starts: Int[Array, " batch"],
    *,
    length: int,
) -> Trajectory:
    """Cut one window of `length` steps per row, from its start."""
    steps = trajectories.controls.shape[1]
    # `dynamic_slice` would shift a slice that is out of range, and not refuse it.
    if length > steps:
        raise ValueError(
            f"windows of {length} steps do not fit trajectories of {steps} steps"
        )
    sizes = Trajectory(length + 1, length, length)  # pyright: ignore

    def cut(row: Int[Array, ""], start: Int[Array, ""]) -> Trajectory:
        return jax.tree.map(
            lambda leaf, size: jax.lax.dynamic_slice_in_dim(leaf[row], start, size),
            trajectories,
            sizes,
        )

    return jax.vmap(cut)(rows, starts)


def adjacent_windows(trajectories: Trajectory, *, length: int) -> Trajectory:
    """Cut a batch, states (batch, T + 1, state), into windows without overlap."""
    count, steps = trajectories.controls.shape[:2]
    starts = jnp.arange(0, steps - length + 1, length)
    rows = jnp.repeat(jnp.arange(count), starts.size)
    return windows(trajectories, rows, jnp.tile(starts, count), length=length)


def state_errors(
    frame: Frame,
    predicted: Float[Array, "time state"],
    true: Float[Array, "time state"],
) -> Float[Array, "time state"]:
    """Return predicted minus true states, with angles wrapped.

    The columns are the position error along and across the true yaw [m], the yaw error
    [rad] and the error of the body state.

    Args:
        frame: that says which entries are angles.
        predicted: states.
        true: states.
    """
    errors = predicted - true
    position = jax.vmap(rotate)(-true[:, 2], errors[:, :2])
    errors = jnp.concatenate([position, errors[:, 2:]], axis=1)
    is_angle = np.isin(np.arange(errors.shape[1]), frame.angles)
    return jnp.where(is_angle, wrap_angle(errors), errors)


def in_batches(function: Callable[[Any], Any], items: Any, *, size: int) -> Any:
    """Map a function of a batch over the leading axis, `size` items at a time.

    The last batch is padded, because `jax.lax.map` would compile a second program for a
    smaller one. The items of a batch are spread over the whole axis: where the axis is
    divided among devices, every device takes part in every batch.
    """
    count = jax.tree.leaves(items)[0].shape[0]
    if count <= size:
        return function(items)

    def batched(leaf: Array) -> Array:
        # Padding repeats the first items: real data, so that no NaN appears in it.
        padded = jnp.concatenate([leaf, leaf[: -count % size]])
        return padded.reshape(size, -1, *leaf.shape[1:]).swapaxes(0, 1)

    results = jax.lax.map(function, jax.tree.map(batched, items))

    def joined(leaf: Array) -> Array:
        return leaf.swapaxes(0, 1).reshape(-1, *leaf.shape[2:])[:count]

    return jax.tree.map(joined, results)
