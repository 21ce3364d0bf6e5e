"""Predictions of any `Model`: rollouts, one-step errors, folded and shifted models."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from sfkd_jax.geometry import rotate, wrap_angle
from sfkd_jax.types import (
    BODY,
    Control,
    Environment,
    Fiber,
    Latent,
    Model,
    Params,
    State,
    Structure,
    Trajectory,
)


class Folded(NamedTuple):
    """Parameters of a controller, which `Model.fiber` need not factorise again."""

    weights: Params  # the parameters as they were learned and stored
    shared: Any  # `Model.shared` of these parameters


def on_host(function: Callable[[Params], Any], params: Params) -> Any:
    """Evaluate on the host, or else in full precision, as one program.

    Accelerators round float32 factors to ten bits, which the witnesses of another
    machine do not survive.
    """
    try:
        host = jax.local_devices(backend="cpu")[0]
    except RuntimeError:  # JAX_PLATFORMS names accelerators only
        host = None
    with jax.default_device(host), jax.default_matmul_precision("float32"):
        evaluated = jax.jit(function)(jax.device_get(params))
    return jax.device_put(jax.device_get(evaluated))


def fold(model: Model, params: Params, evaluate: Any = None) -> Params:
    """Evaluate once what every control step would otherwise evaluate again.

    Outside of a program with `evaluate=on_host`, as `policy.load` does: one program
    then serves all who fold parameters of this model.
    """
    # Folding twice would wrap the weights twice, and `unfold` removes one layer.
    if model.shared is None or isinstance(params, Folded):
        return params
    shared = model.shared
    return Folded(params, evaluate(shared, params) if evaluate else shared(params))


def unfold(params: Params) -> Params:
    """Return the parameters as they were learned, folded or not."""
    return params.weights if isinstance(params, Folded) else params


class Offset(NamedTuple):
    """Parameters of a model together with a shift of its steps.

    `Model.fiber` of these parameters is an `Offset` as well, of the model's own fiber.
    """

    params: Any  # of the model, folded or not; in a fiber, the fiber of the model
    inputs: Control  # added to every control, as a bias of B(e) u and of the residual
    # (x, Δx): what every step adds is Δx, lifted at x; in a fiber, a latent. None: 0.
    shift: Any


def with_offset(model: Model) -> Model:
    """Return the model z⁺ = F(z, u + δ; e) + b with parameters `Offset`(params, δ, b).

    Neither δ nor b depends on z, so two predictions differ as those of the model do:
    the weights that a certificate is about, its rate and its witness are the same. δ
    and b are data, so changing them compiles nothing.
    """

    def step(fiber: Offset, latent: Latent, control: Control) -> Latent:
        after = model.step(fiber.params, latent, control + fiber.inputs)
        # None, not zeros: a model without a shift pays nothing for it.
        if fiber.shift is None:
            return after
        return jax.tree.map(jnp.add, after, fiber.shift)

    def fiber(params: Offset, env: Environment) -> Offset:
        own = model.fiber(params.params, env)
        shift = params.shift
        # By each model: what guards has another latent than what plans.
        if shift is not None:
            at, by = shift
            _, shift = jax.jvp(lambda state: model.encode(own, state), (at,), (by,))
        return Offset(own, params.inputs, shift)

    def inner(function: Callable[..., Any] | None) -> Any:
        # Everything else sees the model's own parameters or fiber.
        return function and (lambda offset, *rest: function(offset.params, *rest))

    structure = model.structure
    on_road = model.on_road
    return model._replace(
        # A scalar 0 broadcasts over any control, whose size is not known here.
        init=lambda key: Offset(model.init(key), jnp.zeros(()), None),
        fiber=fiber,
        encode=inner(model.encode),
        step=step,
        decode=inner(model.decode),
        transport=lambda before, after, latent: model.transport(
            before.params, after.params, latent
        ),
        observe=inner(model.observe),
        # Folding is for the parameters inside, see `Offset.params`.
        shared=None,
        fitting=model.fitting._replace(step_fiber=None),
        on_road=on_road
        and (lambda at, road: at._replace(params=on_road(at.params, road))),
        structure=Structure(inner(structure.explicit), inner(structure.rate)),
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
    own = model.fitting.step_fiber or (lambda params, env, _: model.fiber(params, env))
    # At once for all steps, where it is one product, and not in a loop over them.
    fibers = jax.vmap(partial(own, params))(trajectory.envs, trajectory.controls)
    # After the last step no further e is known: it is taken to stay.
    later = jax.tree.map(lambda leaf: jnp.concatenate([leaf[1:], leaf[-1:]]), fibers)
    return fibers, later


class Predictions(NamedTuple):
    """Of x_1 … x_T of one trajectory."""

    free: Float[Array, "time state"]  # from x_0
    single: Float[Array, "time state"]  # each from the true state before
    defects: Float[Array, "time rank"]
    fibers: Fiber  # of e_0 … e_{T-1}


def rollout(model: Model, params: Params, trajectory: Trajectory) -> Predictions:
    """Predict freely and step by step; return the disturbances d_k of the steps too.

        d_k = z_{k+1} − T(e_k → e_{k+1}) F(z_k, u_k, e_k),   z_k = Φ(x_k, e_k)

    F is the latent step. Compiled, what is not used costs nothing.
    """
    fibers, later = fibers_along(model, params, trajectory)
    # In the first environment; one frame for all times, or z could not be compared.
    first = jax.tree.map(lambda leaf: leaf[0], fibers)
    origin = model.encode(first, trajectory.states[0])
    observe = jax.vmap(model.observe, in_axes=(0, None, 0))
    now = observe(fibers, origin, trajectory.states[:-1])

    def step(latent: Latent, inputs: Any) -> tuple[Latent, Latent]:
        fiber, fiber_next, control = inputs
        # First the step under e, then transport to e': z belongs to the next fiber.
        latent = model.transport(fiber, fiber_next, model.step(fiber, latent, control))
        return latent, latent

    inputs = fibers, later, trajectory.controls
    expected, _ = jax.vmap(step)(now, inputs)
    _, latents = jax.lax.scan(step, origin, inputs)
    # In the later fibers, to which transport has carried the latents.
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
    if length > (steps := trajectories.controls.shape[1]):
        # A slice out of range would be shifted, not refused.
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
    predicted: Float[Array, "time state"], true: Float[Array, "time state"]
) -> Float[Array, "time state"]:
    """Return predicted minus true states.

    Position along and across the true heading [m], yaw wrapped [rad], body state.
    """
    position = jax.vmap(rotate)(-true[:, 2], predicted[:, :2] - true[:, :2])
    yaw = wrap_angle(predicted[:, 2:3] - true[:, 2:3])
    return jnp.concatenate([position, yaw, predicted[:, BODY] - true[:, BODY]], axis=1)


def in_batches(function: Callable[[Any], Any], items: Any, *, size: int) -> Any:
    """Map a function of a batch over the leading axis, `size` items at a time.

    The last batch is padded: `jax.lax.map` would compile a second program for it. Each
    batch takes items from all of the axis, of every device that it is spread over.
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
