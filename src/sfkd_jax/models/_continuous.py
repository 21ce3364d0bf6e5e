"""Models whose latent is the state: known dynamics, and rates (neural ODE, ICODE)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple, cast

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax import traverse_util
from jaxtyping import Array, Float

from sfkd_jax.geometry import between, compose, rotate
from sfkd_jax.models._networks import FRAMES
from sfkd_jax.ranges import check_choice
from sfkd_jax.rollout import runge_kutta
from sfkd_jax.types import (
    BODY,
    POSE,
    Control,
    Environment,
    Fiber,
    Fitting,
    Key,
    Model,
    Params,
    Space,
    State,
    Step,
    Trajectory,
)

flat = partial(traverse_util.flatten_dict, sep="/")
"""Nested dictionaries -> path, as in "network/layers_0/bias" -> array."""
nested = partial(traverse_util.unflatten_dict, sep="/")
"""The inverse of `flat`."""
AFFINE_IN = ("both", "env", "control")


def state_model(
    init: Callable[[Key], Params],
    fiber: Callable[[Params, Environment], Fiber],
    step: Callable[[Fiber, State, Control], State],
    *,
    vector: Callable[[State], Float[Array, " body"]] = lambda state: state[BODY],
    state_size: int | None = None,
    along_path: bool = False,
) -> Model:
    """Return a model that steps the state itself, so that nothing is encoded.

    Args:
        init: key -> params.
        fiber: (params, env) -> all that depends on e alone.
        step: (fiber, state, control) -> state one sampling period later.
        vector: state -> the coordinates that prediction residuals are measured in;
            those of the body without it.
        state_size: number of entries of a state, checked when one is encoded; None
            accepts any.
        along_path: whether states and controls are those of `geometry`.
    """

    def encode(fiber: Fiber, state: State) -> State:
        # Broadcasting would accept a state of another plant silently.
        if state_size is not None and state.shape != (state_size,):
            raise ValueError(
                f"state must have shape ({state_size},), got {state.shape}"
            )
        return state

    return Model(
        init=init,
        fiber=fiber,
        encode=encode,
        step=step,
        decode=lambda fiber, state: state,
        # The state means the same in every environment, so nothing is to be carried.
        transport=lambda fiber, fiber_next, state: state,
        observe=lambda fiber, latent, state: encode(fiber, state),
        vector=vector,
        along_path=along_path,
    )


def physics(step: Step, *, along_path: bool = False) -> Model:
    """Return (x, u, e) -> x one sampling period later as a `Model` without parameters.

    Args:
        step: passed in by the caller (models never import the vehicle).
        along_path: whether x and u are those of `geometry`.
    """
    return state_model(
        # Nothing to learn; an empty tree passes through stores and optimisers.
        init=lambda key: {},
        fiber=lambda params, env: env,
        step=lambda env, state, control: step(state, control, env),
        along_path=along_path,
    )


class Conditioned(NamedTuple):
    """The fiber of a model that reads the scaled e as one more input."""

    params: Params
    env: Environment


class Rates(NamedTuple):
    """Learned rates.

    Attributes:
        init: key -> params.
        at: (fiber, scaled s, scaled u) -> (r_g, r_s), shape (3 + body,); r_s per
            second.
        fiber: (params, scaled e) -> all that depends on e alone.
    """

    init: Callable[[Key], Params]
    at: Callable[[Fiber, Float[Array, " body"], Control], Float[Array, " rates"]]
    fiber: Callable[[Params, Environment], Fiber] = Conditioned


def continuous(
    space: Space,
    rates: Rates,
    *,
    dt: float,
    environment: bool = True,
    solve: Callable[[Callable[[State], State], State, float], State] = runge_kutta,
    known: Callable[[Fiber, State, Control], State] | None = None,
    frame: str = "body",
) -> Model:
    """Return a model with learned rates and one solver step per sampling period.

        ġ = R(yaw) (m_g + S_g r_g(s, u; e)) / dt,   ṡ = S_s r_s(s, u; e)

    The latent is the state itself. s and u are scaled; m_g and S_g are centre and scale
    of the pose increment over dt, S_s is the scale of s; u and e are held over dt. R
    turns the velocity along and across the car into the world frame, so the model is
    equivariant under SE(2).

    Args:
        space: measured scales; fixes all sizes.
        rates: learned.
        dt: sampling period [s], the solver's step in training and in use.
        environment: whether e is used; if not, the fiber is that of zeros.
        solve: (x -> dx/dt, x, dt) -> x after dt, in training and in use.
        known: (fiber, state, control) -> known dx/dt in the world frame and physical
            units, equivariant under SE(2). The rates are added to it, and m_g is
            omitted.
        frame: "body", or "path" for path coordinates, which have no pose: r_g is
            ignored.
    """
    check_choice("model.frame", frame, FRAMES)
    pose = frame == "body"
    # Known dynamics bring their own mean motion; learned rates start from the data's.
    drift = jnp.asarray(space.increment_mean) if known is None else jnp.zeros(3)

    def derivative(at: Fiber, state: State, control: Control) -> State:
        rate = rates.at(at, space.scaled_body(state), space.scaled_control(control))
        # The first three entries of a path state are no pose: they stay 0.
        if not pose:
            return jnp.concatenate([jnp.zeros(3), space.body_scale * rate[3:]])
        # Increments over dt are the units in which the data are of size 1.
        twist = (drift + space.increment_scale * rate[:3]) / dt
        # Rates in the body frame, turned at every stage: equivariant to all orders.
        change = jnp.concatenate(
            [rotate(state[2], twist[:2]), twist[2:], space.body_scale * rate[3:]]
        )
        return change if known is None else change + known(at, state, control)

    def step(at: Fiber, state: State, control: Control) -> State:
        return solve(lambda x: derivative(at, x, control), state, dt)

    return state_model(
        rates.init,
        lambda params, env: rates.fiber(params, space.scaled_env(env, environment)),
        step,
        vector=space.scaled_body,
        state_size=3 + space.body_mean.shape[0],
        along_path=not pose,
    )


def one_step(space: Space, *, hidden: tuple[int, ...] = (64, 64)) -> Model:
    """Return a regression of one step: linear by least squares, a network for the rest.

        (Δ, s⁺ − s) = Wᵀ [1; s; u; e] + σ tanh network(s, u, e),   Δ in the body frame

    `fitting.identify` finds W and σ, the spread of what W leaves, and starts the
    network, whose weights are the only ones that a gradient reaches.

    Args:
        space: measured scales; fixes all sizes.
        hidden: widths.
    """
    outputs = 3 + space.body_mean.shape[0]
    network = mlp(hidden, outputs, (nn.tanh,) * len(hidden), last=0.1)

    def inputs(state: State, control: Control, env: Environment) -> Array:
        parts = space.scaled_body(state), space.scaled_control(control)
        return jnp.concatenate([*parts, space.scaled_env(env)])

    def identify(train: Trajectory, held_out: Trajectory, key: Key) -> Params:
        before = train.states[:, :-1]
        after = train.states[:, 1:]
        read = jax.vmap(jax.vmap(inputs))(before, train.controls, train.envs)
        read = read.reshape(-1, read.shape[-1])
        moved = jax.vmap(jax.vmap(_increment))(before, after).reshape(-1, outputs)
        columns = jnp.column_stack([jnp.ones(read.shape[0]), read])
        # Scaled inputs: the normal equations are well conditioned, also in float32.
        gram = columns.T @ columns + 1e-3 * jnp.eye(columns.shape[1])
        linear = jnp.linalg.solve(gram, columns.T @ moved)
        scale = jnp.std(moved - columns @ linear, axis=0)
        return {
            "linear": linear,
            "scale": jnp.where(scale > 1e-6, scale, 1e-6),
            "network": network.init(key, read[0])["params"],
        }

    def step(fiber: Conditioned, state: State, control: Control) -> State:
        read = inputs(state, control, fiber.env)
        fixed = jax.lax.stop_gradient(fiber.params)
        rest = network.apply({"params": fiber.params["network"]}, read)
        linear = fixed["linear"][0] + read @ fixed["linear"][1:]
        change = linear + fixed["scale"] * cast(jax.Array, rest)
        pose = compose(state[POSE], change[POSE])
        return jnp.concatenate([pose, state[BODY] + change[BODY]])

    model = state_model(lambda key: {}, Conditioned, step, vector=space.scaled_body)
    return model._replace(fitting=Fitting(identify=identify))


def step_of(model: Model, params: Params) -> Step:
    """Return the step of a model whose latent is the state."""
    return lambda state, control, env: model.step(
        model.fiber(params, env), state, control
    )


def _increment(before: State, after: State) -> State:
    """The motion in the frame of the car, and the change of the body state."""
    pose = between(before[POSE], after[POSE])
    return jnp.concatenate([pose, after[BODY] - before[BODY]])


def mlp(
    hidden: Sequence[int],
    outputs: int,
    activations: Sequence[Callable[[Array], Array]],
    *,
    last: float,
) -> nn.Sequential:
    """Return the network W_L σ_{L-1}(… σ_1(W_1 x + b_1) …) + b_L.

    `last` is the factor of the initial W_L; near 0, the initial rates vanish.
    """
    layers = [
        part
        for width, σ in zip(hidden, activations, strict=True)
        for part in (nn.Dense(width), σ)
    ]
    # Near 0 at the start: an untrained model stands still instead of diverging.
    small = nn.initializers.variance_scaling(last**2, "fan_in", "truncated_normal")
    return nn.Sequential([*layers, nn.Dense(outputs, kernel_init=small)])


def neural_ode(
    space: Space,
    *,
    dt: float = 0.1,
    hidden: tuple[int, ...] = (96, 96),
    environment: bool = True,
    frame: str = "body",
) -> Model:
    """Rates of the body state and the pose from one tanh network, solved by RK4 at dt.

        (ġ, ṡ) = W_L tanh(… tanh(W_1 [s; u; e] + b_1) …) + b_L,   ġ in the body frame

    The original has no inputs; here u and e are held over dt and are inputs like s.

    Args:
        hidden: widths.
        frame: "body", or "path" for path coordinates.

    Source: Chen et al., NeurIPS 2018, arXiv 1806.07366.
    """
    body = space.body_mean.shape[0]
    inputs = body + space.control_mean.shape[0] + space.env_mean.shape[0]
    # W_L starts at a tenth of its usual size: the first rollouts stay near the data.
    network = mlp(hidden, 3 + body, (nn.tanh,) * len(hidden), last=0.1)

    def init(key: Key) -> Params:
        return network.init(key, jnp.zeros(inputs))["params"]

    def rates(
        fiber: Conditioned, body: Float[Array, " body"], control: Control
    ) -> Float[Array, " rates"]:
        # e is an input like any other: nothing of the network is fixed by it.
        read = jnp.concatenate([body, control, fiber.env])
        return cast(jax.Array, network.apply({"params": fiber.params}, read))

    learned = Rates(init, rates)
    return continuous(space, learned, dt=dt, environment=environment, frame=frame)


def affine_rates(
    space: Space,
    hidden: Sequence[int],
    activations: Sequence[Callable[[Array], Array]],
    *,
    last: float,
    affine_in: str = "both",
) -> Rates:
    """Return rates that are affine in their inputs, of two networks as `mlp` has them.

    "both":     f(s) + G(s) [u; e]
    "env":      f(s, u) + G(s, u) e
    "control":  f(s, e) + G(s, e) u
    """
    check_choice("model.affine_in", affine_in, AFFINE_IN)
    sizes = {
        "body": space.body_mean.shape[0],
        "control": space.control_mean.shape[0],
        "env": space.env_mean.shape[0],
    }
    # Only what enters affinely is multiplied by G; the rest is read by both networks.
    driving = ("control", "env") if affine_in == "both" else (affine_in,)
    reading = tuple(name for name in sizes if name not in driving)

    def joined(names: tuple[str, ...], parts: dict[str, Array]) -> Array:
        return jnp.concatenate([parts[name] for name in names])

    start = jnp.zeros(sum(sizes[name] for name in reading))
    inputs = sum(sizes[name] for name in driving)
    outputs = 3 + sizes["body"]
    # Two networks, as published, rather than one with two heads.
    f = mlp(hidden, outputs, activations, last=last)
    G = mlp(hidden, outputs * inputs, activations, last=last)

    def init(key: Key) -> Params:
        # A key each: with one, the weights of f and G would start correlated.
        f_key, G_key = jax.random.split(key)
        networks = {"f": f.init(f_key, start), "G": G.init(G_key, start)}
        return {name: each["params"] for name, each in networks.items()}

    def rates(
        fiber: Conditioned, body: Float[Array, " body"], control: Control
    ) -> Float[Array, " rates"]:
        parts = {"body": body, "control": control, "env": fiber.env}
        read = joined(reading, parts)
        free: Any = f.apply({"params": fiber.params["f"]}, read)
        gain: Any = G.apply({"params": fiber.params["G"]}, read)
        # Driving inputs enter here alone, hence affinely by construction.
        return free + gain.reshape(outputs, inputs) @ joined(driving, parts)

    return Rates(init, rates)


def icode(
    space: Space,
    *,
    dt: float = 0.1,
    width: int = 60,
    layers: int = 3,
    environment: bool = True,
    affine_in: str = "both",
    frame: str = "body",
) -> Model:
    """Input concomitant neural ODE: rates affine in control and environment.

        (ġ, ṡ) = f(s) + G(s) [u; e],   ġ in the body frame

    f and G have a tanh layer, then softplus layers. Tyre forces at their limit are not
    affine in e: that is a limit of the published structure, kept here. The original
    solves by Euler on the grid of the data; since the pose's rates are learned in the
    body frame, an Euler step composes learned increments and loses nothing.

    Args:
        width: of the hidden layers of f and of G.
        layers: number of hidden layers of f and of G.
        affine_in: "both" as above; "env" for f(s, u) + G(s, u) e, where e is what the
            paper calls an extrinsic input; "control" for f(s, e) + G(s, e) u.
        frame: "body", or "path" for path coordinates.

    Source: Li et al., arXiv 2411.13914.
    """
    # A tanh first, as published: it bounds what the unbounded softplus layers read.
    activations = (nn.tanh, *(nn.softplus,) * (layers - 1))
    rates = affine_rates(
        space, (width,) * layers, activations, last=0.1, affine_in=affine_in
    )

    def euler(rate: Callable[[State], State], state: State, dt: float) -> State:
        return state + dt * rate(state)

    return continuous(
        space, rates, dt=dt, environment=environment, solve=euler, frame=frame
    )


def icode_mppi(
    space: Space,
    *,
    nominal: Step,
    dt: float = 0.1,
    hidden: tuple[int, ...] = (64, 64),
    environment: bool = True,
    affine_in: str = "both",
) -> Model:
    """Known dynamics plus a residual f(s) + G(s) [u; e], the sum solved by RK4 at dt.

        ẋ = f_nom(x, u) + f(s) + G(s) [u; e]

    The pose part of the residual is in the body frame. f and G are softplus networks
    that start near 0, so that training starts from the known dynamics. The residual of
    the original is f(x) + G(x) u; here e joins u.

    Args:
        nominal: (x, u, e) -> dx/dt of the known dynamics in physical units, passed in
            by the caller (models never import the vehicle). A model that ignores e
            gives it the centre of the environment box.
        hidden: widths of f and of G.
        affine_in: as for `icode`; with "control" the gain of the steering may depend on
            friction.

    Source: Song et al., arXiv 2605.03260, eqs. 10 and 11.
    """
    # 1e-3, not 0.1: the known dynamics are good already, and noise would spoil them.
    rates = affine_rates(
        space, hidden, (nn.softplus,) * len(hidden), last=1e-3, affine_in=affine_in
    )

    def known(fiber: Conditioned, state: State, control: Control) -> State:
        # Back in physical units: the known dynamics know no scales.
        return nominal(state, control, space.env_mean + space.env_scale * fiber.env)

    return continuous(space, rates, dt=dt, environment=environment, known=known)
