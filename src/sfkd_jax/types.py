"""The hallway: what vehicle (truth), models (belief) and control (decision) meet in.

Symbols, used in every room: state x = (pose g in SE(2), body state s), control u,
environment e, latent z. Every function named here works on one sample; callers vmap.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

import jax
from jaxtyping import Array, Float, PRNGKeyArray

Key: TypeAlias = PRNGKeyArray
State: TypeAlias = Float[Array, " state"]
Control: TypeAlias = Float[Array, " control"]
Environment: TypeAlias = Float[Array, " environment"]
Pose: TypeAlias = Float[Array, " 3"]
Reference: TypeAlias = Float[Array, "horizon 4"]
Scalar: TypeAlias = Float[Array, ""]
Params: TypeAlias = Any
Fiber: TypeAlias = Any
Latent: TypeAlias = Any
Step: TypeAlias = Callable[[State, Control, Environment], State]

POSE = slice(0, 3)
"""Where the pose (p_x [m], p_y [m], yaw [rad]) stands in a state."""
BODY = slice(3, None)
"""Where the body state stands in a state: v [m/s], then (v_y [m/s], yaw rate [rad/s],
steering [rad]).
"""


class Space(NamedTuple):
    """Measured scales of a data set: they fix a model's dimensions and its units.

    Attributes:
        body_mean, body_scale: centre and half width of the body state s, shape (nb,).
        control_mean, control_scale: the same for u, shape (nu,).
        env_mean, env_scale: centre and half width of the environment box E, shape
            (ne,).
        increment_mean, increment_scale: of the body-frame pose increment over one step,
            shape (3,).
    """

    body_mean: Float[Array, " body"]
    body_scale: Float[Array, " body"]
    control_mean: Float[Array, " control"]
    control_scale: Float[Array, " control"]
    env_mean: Float[Array, " environment"]
    env_scale: Float[Array, " environment"]
    increment_mean: Float[Array, " 3"]
    increment_scale: Float[Array, " 3"]


class Polytope(NamedTuple):
    """A(e) is a convex combination of the vertices (vertex, rank, rank) for every e."""

    vertices: Float[Array, "vertex rank rank"]


class Hypernetwork(NamedTuple):
    """A(e) is what a tanh network of e emits: vec A(e) = V_L tanh(… tanh(V_1 e + c_1) …) + c_L, row by row.

    Attributes:
        weights: V_1 … V_L, each (out, in).
        biases: c_1 … c_L.
    """

    weights: tuple[Float[Array, "_ _"], ...]
    biases: tuple[Float[Array, " _"], ...]


class Samples(NamedTuple):
    """A(e) at some environments, (sample, rank, rank), and nothing about those between: evidence, never a proof."""

    operators: Float[Array, "sample rank rank"]


@jax.tree_util.register_static
@dataclass(frozen=True)
class Declared:
    """What a model states about itself in words, for a certificate to accept or refuse.

    Attributes:
        activation: σ of the residual and the decoder.
        transport: "identity" or "rotation" (of planes, an isometry).
        controls: how many there are.
    """

    activation: str
    transport: str
    controls: int


class Explicit(NamedTuple):
    """What a certificate speaks about: the weights a model multiplies by, and nothing hidden.

    z⁺ = A(e) z + B(e) u + W_L σ(… σ(W_1 z + b_1(u, e)) …) + b_L(u, e), σ with slopes in
    [0, 1].

    Attributes:
        operators: what is known of A(e) for all e.
        residual: W_1 … W_L of the residual, each (out, in); empty for a model without
            one.
        residual_multipliers: λ_1 … λ_{L-1}, diagonal multipliers proposed as a
            Lipschitz witness; () if none.
        decoder: W_1 … W_L of the pose-increment decoder, in physical units over z.
        decoder_multipliers: as for the residual.
        readout: C of the body state, s = C z + c, in physical units, (body, rank).
        declared: the activation and the kind of transport.
    """

    operators: Polytope | Hypernetwork | Samples
    residual: tuple[Float[Array, "_ _"], ...]
    residual_multipliers: tuple[Float[Array, " _"], ...]
    decoder: tuple[Float[Array, "_ _"], ...]
    decoder_multipliers: tuple[Float[Array, " _"], ...]
    readout: Float[Array, "body rank"]
    declared: Declared


class Incremental(NamedTuple):
    """A state equation in continuous time, and what is to prove that it contracts.

    ds/dt = A_0 s + A σ(W s + c) + g(u, e) in scaled units of s, per second; σ entry by
    entry with slopes in [0, 1].

    Attributes:
        linear: A_0.
        outer: A = [A_1 … A_M].
        inner: W = [W_1; …; W_M].
        metric: P, symmetric, proposed.
        multipliers: λ of the diagonal Λ, proposed.
        declared: the activation and the kind of transport.
    """

    linear: Float[Array, "body body"]
    outer: Float[Array, "body hidden"]
    inner: Float[Array, "hidden body"]
    metric: Float[Array, "body body"]
    multipliers: Float[Array, " hidden"]
    declared: Declared


class LinearPredictor(NamedTuple):
    """z⁺ = A z + B u + d κ + c, x = C z + o, z = lift(x): linear in a lift of the state along a path, for one e.

    x is a `State` whose pose is (progress [m], distance left of the path [m], yaw
    against it [rad]); κ is the path's curvature [1/m].
    """

    lift: Callable[[State], Float[Array, " rank"]]
    A: Float[Array, "rank rank"]
    B: Float[Array, "rank control"]
    d: Float[Array, " rank"]
    c: Float[Array, " rank"]
    C: Float[Array, "state rank"]
    o: State


class Model(NamedTuple):
    """A rollout model as pure functions over pytrees.

    Attributes:
        init: key -> params.
        fiber: (params, env) -> all that depends on e alone; once per control step,
            outside every scan.
        encode: (fiber, state) -> latent.
        step: (fiber, latent, control) -> latent one sampling period later.
        decode: (fiber, latent) -> state.
        transport: (fiber, fiber_next, latent) -> latent, on a switch e -> e'.
        observe: (fiber, latent, state) -> the latent a perfect model would hold at
            `state`, in `latent`'s frame.
        vector: latent -> z, the coordinates a contraction claim is about, shape
            (rank,).
        explicit: params -> `Explicit`, or `Incremental` for a model in continuous time
            about whose rate alone something can be proved, or None for a model about
            which nothing can be certified.
        penalty: (fiber, latent, control) -> an extra term of the training loss, or
            None.
        identify: (training, validation trajectories, key) -> params, by regression at
            once, or None.
        start: (params, training trajectories, key) -> params to train from, linear part
            by regression, or None.
        linear: fiber -> `LinearPredictor`, or None for a model that is not linear in a
            lift.
        fold: params -> params that `fiber` takes as well, with all that depends on no
            environment evaluated. To drive with: what it saves is what a control step
            would do anew each time.
        rate: params -> α that `step` contracts with by construction, or None.
        along_path: whether states and controls are those of `path_frame`, which have no
            pose to predict.
    """

    init: Callable[[Key], Params]
    fiber: Callable[[Params, Environment], Fiber]
    encode: Callable[[Fiber, State], Latent]
    step: Callable[[Fiber, Latent, Control], Latent]
    decode: Callable[[Fiber, Latent], State]
    transport: Callable[[Fiber, Fiber, Latent], Latent]
    observe: Callable[[Fiber, Latent, State], Latent]
    vector: Callable[[Latent], Float[Array, " rank"]]
    explicit: Callable[[Params], Explicit | Incremental] | None = None
    penalty: Callable[[Fiber, Latent, Control], Scalar] | None = None
    identify: Callable[[Trajectory, Trajectory, Key], Params] | None = None
    start: Callable[[Params, Trajectory, Key], Params] | None = None
    linear: Callable[[Fiber], LinearPredictor] | None = None
    fold: Callable[[Params], Params] = lambda params: params
    rate: Callable[[Params], Scalar] | None = None
    along_path: bool = False


class Controller(NamedTuple):
    """A decision rule as two pure functions.

    Attributes:
        init: key -> controller state.
        act: (params, controller_state, observation, env, reference) -> (control,
            controller_state, info).
    """

    init: Callable[[Key], Any]
    act: Callable[
        [Params, Any, State, Environment, Reference],
        tuple[Control, Any, dict[str, Array]],
    ]


class Trajectory(NamedTuple):
    """What was driven.

    Attributes:
        states: x_0 … x_T, shape (*batch, time + 1, state).
        controls: u_0 … u_{T-1}, shape (*batch, time, control).
        envs: e_0 … e_{T-1}, shape (*batch, time, environment).
    """

    states: Float[Array, "*batch time_plus_1 state"]
    controls: Float[Array, "*batch time control"]
    envs: Float[Array, "*batch time environment"]
