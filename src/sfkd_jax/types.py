"""Shared types: what systems, models, controllers and certificates exchange.

Symbols, used in every package: state x = (pose g in SE(2), body state s), control u,
environment e, latent z. Every function named here works on one sample; callers vmap.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from sfkd_jax.info import ControllerInfo

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

GRAVITY = 9.81
"""Acceleration of gravity [m/s²]."""
POSE = slice(0, 3)
"""Entries of the pose (p_x [m], p_y [m], yaw [rad]) in a state."""
BODY = slice(3, None)
"""Entries of the body state in a state."""


def _at_zero(inputs: Control, size: int) -> Float[Array, " body"]:
    """Return a body state of zeros."""
    return jnp.zeros(size)


# Identity decides equality, so that a frame can be a static argument of a program.
@dataclass(frozen=True, eq=False)
class Frame:
    """The coordinates in which a model is learned, and its errors are bounded.

    A frame has a pose in the plane, which steps move, or it has none. Without a pose
    the first three entries of a state are 0, and the body state is all that a model
    knows, for instance the deviation from a reference. A control may then contain
    inputs ρ, which a step needs from that reference.

    Attributes:
        name: of the frame.
        has_pose: whether states have a pose.
        inputs: number of entries of ρ, the last entries of a control.
        following: (ρ, size of the body state) -> body state of a system that follows
            its reference exactly; a planner's model is linearised there.
        outputs: entries of a state, for each output that a certificate bounds, by any
            names. The error of an output is the 2-norm of the errors of its entries.
            The output "body" is what is left of a state, in mixed units; there may be
            none.
        units: unit of each output, "" for none.
        angles: entries of a state that are angles [rad].
        lengths: what an error of 1 in each of the first entries of a state counts in a
            training loss [m]; of three entries or more.
        length: what half the width of any other entry counts there [m].
        distances: those of the entries with `lengths` that are distances. They count
            relative to the size of the system.

    Raises:
        ValueError: these do not fit together; names the frame and the attribute.
    """

    name: str
    has_pose: bool
    outputs: Mapping[str, slice | tuple[int, ...]]
    units: Mapping[str, str]
    angles: tuple[int, ...]
    lengths: tuple[float, ...]
    length: float
    distances: tuple[int, ...]
    inputs: int = 0
    following: Callable[[Control, int], Float[Array, " body"]] = _at_zero

    def __post_init__(self) -> None:
        """Refuse attributes that do not fit together."""
        where = f"frame {self.name!r}:"
        if self.units.keys() != self.outputs.keys():
            raise ValueError(
                f"{where} units are of {[*self.units]}, outputs {[*self.outputs]}"
            )
        if len({*self.labels.values()}) < len(self.outputs):
            raise ValueError(
                f"{where} outputs with their units must differ, got "
                f"{[*self.labels.values()]}"
            )
        if len(self.lengths) < BODY.start:
            raise ValueError(
                f"{where} lengths must be of at least {BODY.start} entries, got "
                f"{len(self.lengths)}"
            )
        # An entry that counts by its half width is relative to the size already.
        if not {*self.distances} <= {*range(len(self.lengths))}:
            raise ValueError(
                f"{where} distances must be among the {len(self.lengths)} entries with "
                f"lengths, got {self.distances}"
            )

    @property
    def labels(self) -> dict[str, str]:
        """The name of each output with its unit, such as "position_m"."""
        return {
            name: f"{name}_{unit}" if unit else name
            for name, unit in self.units.items()
        }

    def entries(self, output: str) -> slice | Int[Array, " entry"]:
        """Return the index of the entries of an output, along an axis of states."""
        entries = self.outputs[output]
        # A tuple would be an index of several axes.
        return entries if isinstance(entries, slice) else jnp.asarray(entries, int)


BODY_FRAME = Frame(
    name="body",
    has_pose=True,
    outputs={"position": slice(0, 2), "yaw": slice(2, 3), "body": BODY},
    units={"position": "m", "yaw": "rad", "body": ""},
    angles=(2,),
    # A radian counts the way of half a second at 10 m/s.
    lengths=(1.0, 1.0, 5.0),
    length=0.2,
    distances=(0, 1),
)
"""The frame of the body: a step moves the pose by an increment that does not depend on
the pose, and nothing refers to a reference.
"""


class Space(NamedTuple):
    """Measured scales of a data set; they fix the sizes and the units of a model.

    Attributes:
        body_mean: centre of the body state s, shape (nb,).
        body_scale: half width of s, shape (nb,).
        control_mean: centre of the control u, shape (nu,).
        control_scale: half width of u, shape (nu,).
        env_mean: centre of the environment box E, shape (ne,).
        env_scale: half width of E, shape (ne,).
        increment_mean: centre of the body-frame pose increment of a step, shape (3,).
        increment_scale: half width of that increment, shape (3,).
    """

    body_mean: Float[Array, " body"]
    body_scale: Float[Array, " body"]
    control_mean: Float[Array, " control"]
    control_scale: Float[Array, " control"]
    env_mean: Float[Array, " environment"]
    env_scale: Float[Array, " environment"]
    increment_mean: Float[Array, " 3"]
    increment_scale: Float[Array, " 3"]

    def scaled_body(self, state: State) -> Float[Array, " body"]:
        """Return the body state in scaled units.

        Raises:
            ValueError: the state has the wrong length.
        """
        size = 3 + self.body_mean.shape[0]
        # Broadcasting would accept a state of another plant silently.
        if state.shape != (size,):
            raise ValueError(f"state must have shape ({size},), got {state.shape}")
        return (state[BODY] - self.body_mean) / self.body_scale

    def scaled_control(self, control: Control) -> Control:
        """Return the control in scaled units."""
        return (control - self.control_mean) / self.control_scale

    def scaled_env(self, env: Environment, used: bool = True) -> Environment:
        """Return (e − centre) / half width: in the box E every entry is in [-1, 1].

        Args:
            env: e.
            used: False for a model that ignores e; zeros then.
        """
        scaled = (env - self.env_mean) / self.env_scale
        # Zeros, not nothing: the blind ablation has networks of the same size.
        return scaled if used else jnp.zeros_like(scaled)


class Polytope(NamedTuple):
    """A(e) is a convex combination of the vertices (vertex, rank, rank) for every e."""

    vertices: Float[Array, "vertex rank rank"]


class Samples(NamedTuple):
    """A(e) at sampled environments only, (sample, rank, rank): evidence, no proof."""

    operators: Float[Array, "sample rank rank"]


# Static: strings are no arrays, and a new value must compile a new program.
@jax.tree_util.register_static
@dataclass(frozen=True)
class Declared:
    """Properties that a model declares and a certificate accepts or refuses.

    Attributes:
        activation: σ of the residual and the decoder.
        transport: "identity" or "rotation" (of planes, an isometry).
        controls: number of controls.
    """

    activation: str
    transport: str
    controls: int


class Explicit(NamedTuple):
    """The plain weights of a discrete-time model; a certificate is about these.

    z⁺ = A(e) z + B(e) u + W_L σ(… σ(W_1 z + b_1(u, e)) …) + b_L(u, e), 0 ≤ σ' ≤ 1.

    Attributes:
        operators: what is known of A(e) for all e.
        residual: W_1 … W_L of the residual, each (out, in); () without a residual.
        residual_multipliers: λ_1 … λ_{L-1}, a proposed Lipschitz witness, or ().
        decoder: W_1 … W_L of the pose-increment decoder, in physical units over z.
        decoder_multipliers: as for the residual.
        readout: C of the body state, s = C z + c, in physical units, (body, rank).
        declared: the activation and the kind of transport.
    """

    operators: Polytope | Samples
    residual: tuple[Float[Array, "_ _"], ...]
    residual_multipliers: tuple[Float[Array, " _"], ...]
    decoder: tuple[Float[Array, "_ _"], ...]
    decoder_multipliers: tuple[Float[Array, " _"], ...]
    readout: Float[Array, "body rank"]
    declared: Declared


class Fitting(NamedTuple):
    """How the parameters of a model are fitted, besides gradient descent from `init`.

    Attributes:
        identify: (training, validation data, key) -> params by regression, or None.
        penalty: (fiber, latent, control) -> extra term of the training loss, or None.
        step_fiber: (params, env, control) -> the fiber of one step, with all that does
            not depend on the latent; None for `Model.fiber`.
    """

    identify: Callable[[Trajectory, Trajectory, Key], Params] | None = None
    penalty: Callable[[Fiber, Latent, Control], Scalar] | None = None
    step_fiber: Callable[[Params, Environment, Control], Fiber] | None = None


class Structure(NamedTuple):
    """What is known of a model by construction; None where nothing is.

    Attributes:
        explicit: params -> `Explicit`, or None.
        rate: params -> α, the contraction rate of `step`, or None if there is none.
        linear: fiber -> a predictor that is linear in a lift of the state, or None.
    """

    explicit: Callable[[Params], Explicit] | None = None
    rate: Callable[[Params], Scalar] | None = None
    linear: Callable[[Fiber], Any] | None = None


class Model(NamedTuple):
    """A rollout model as pure functions over pytrees.

    A model whose latent is the physical state needs `init`, `fiber` and `step` only:
    `models.state_model` fills in the rest.

    Attributes:
        init: key -> params.
        fiber: (params, env) -> all that depends on e, evaluated once per control step;
            params may be `rollout.Folded`.
        encode: (fiber, state) -> latent.
        step: (fiber, latent, control) -> latent one sampling period later.
        decode: (fiber, latent) -> state.
        transport: (fiber, fiber_next, latent) -> latent, when e switches to e'.
        observe: (fiber, latent, state) -> latent of `state`, in the frame of `latent`.
        vector: latent -> z, the coordinates in which contraction is claimed, (rank,).
        shared: params -> the part of every fiber that does not depend on e, computed
            once before driving; None if there is no such part.
        on_reference: (fiber, ρ) -> the fiber of steps with these inputs from the
            reference, which all samples of a planner share; None if it is the same.
        fitting: how the parameters are fitted.
        structure: what is known by construction.
        frame: the coordinates of states, and the inputs of controls.
        planning: the model that planners roll out in place of this one, with the same
            params; None for this one. Nothing is certified of it.
    """

    init: Callable[[Key], Params]
    fiber: Callable[[Params, Environment], Fiber]
    encode: Callable[[Fiber, State], Latent]
    step: Callable[[Fiber, Latent, Control], Latent]
    decode: Callable[[Fiber, Latent], State]
    transport: Callable[[Fiber, Fiber, Latent], Latent]
    observe: Callable[[Fiber, Latent, State], Latent]
    vector: Callable[[Latent], Float[Array, " rank"]]
    shared: Callable[[Params], Any] | None = None
    on_reference: Callable[[Fiber, Control], Fiber] | None = None
    fitting: Fitting = Fitting()
    structure: Structure = Structure()
    frame: Frame = BODY_FRAME
    planning: Model | None = None

    @property
    def predicting(self) -> Model:
        """The model that predicts best: `planning` where there is one."""
        return self.planning or self


class Controller(NamedTuple):
    """A control law as two pure functions.

    Attributes:
        init: key -> controller state.
        act: (params, controller_state, observation, env, reference) -> (control,
            controller_state, info); what stands for observation and reference is up to
            the task, see `control.free_task` and `path_following.along_reference`.
    """

    init: Callable[[Key], Any]
    act: Callable[
        [Params, Any, State, Environment, Any],
        tuple[Control, Any, ControllerInfo],
    ]


class Trajectory(NamedTuple):
    """States, controls and environments of a run.

    Attributes:
        states: x_0 … x_T, shape (*batch, time + 1, state).
        controls: u_0 … u_{T-1}, shape (*batch, time, control).
        envs: e_0 … e_{T-1}, shape (*batch, time, environment).
    """

    states: Float[Array, "*batch time_plus_1 state"]
    controls: Float[Array, "*batch time control"]
    envs: Float[Array, "*batch time environment"]
