"""Our vehicles as a brax environment, and brax systems as plants."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from operator import attrgetter
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from brax.envs.base import Env, PipelineEnv
from brax.envs.base import State as BraxState
from brax.generalized import pipeline

from sfkd_jax.adapters._task import MEASURES, DrivingTask
from sfkd_jax.geometry import without_pose
from sfkd_jax.systems import System, split_label
from sfkd_jax.types import BODY, Control, Environment, Key, Reference, State, Step

SCALED = {
    "gravity": ("gravity", "opt.gravity"),
    "damping": ("dof.damping",),
    "motor": ("actuator.gear",),
}
"""Parameters that entries of e may scale -> their fields in a system. Damping is the
viscous friction of all joints.
"""


class BraxVehicle(Env):
    """Path following as `brax.envs.Env`, with the settings of `DrivingTask`.

    Observation, action and reward are those of `DrivingTask`, which is in `task`. Every
    `reset` draws a new road and puts it into `info["road"]`; the automatic reset of
    brax, which restores the first state of an episode, therefore repeats the road.
    `done` is 1 if the car left the lane or the road ended; `info["time_out"]` is 1 in
    the second case only, as PPO's `bootstrap_on_timeout` expects.
    """

    def __init__(self, **settings: Any) -> None:
        self.task = DrivingTask(**settings)

    def reset(self, rng: jax.Array) -> BraxState:
        """Start an episode on a new road; `rng` is a typed key or two integers."""
        # brax still passes keys as integers.
        is_typed = jnp.issubdtype(rng.dtype, jax.dtypes.prng_key)
        key = rng if is_typed else jax.random.wrap_key_data(rng)
        road, moment = self.task.reset(key)
        zero = jnp.zeros(())
        metrics = dict.fromkeys(MEASURES, zero)
        info = {"road": road, "time_out": zero}
        observation = self.task.observe(road, moment)
        return BraxState(moment, observation, zero, zero, metrics, info)  # pyright: ignore

    def step(self, state: BraxState, action: jax.Array) -> BraxState:
        """Simulate one sampling period; keep other entries of `metrics` and `info`."""
        road = state.info["road"]
        moment, outcome = self.task.step(road, state.pipeline_state, action)  # pyright: ignore
        ended = outcome.left | outcome.over
        return state.replace(  # pyright: ignore[reportAttributeAccessIssue]
            pipeline_state=moment,
            obs=self.task.observe(road, moment),
            reward=outcome.reward,
            done=ended.astype(float),
            metrics={**state.metrics, **outcome.measures},
            info={**state.info, "time_out": outcome.over.astype(float)},
        )

    def situation(self, state: BraxState) -> tuple[State, Environment, Reference]:
        """Return state, environment and reference, as `Controller.act` takes them."""
        return self.task.situation(state.info["road"], state.pipeline_state)  # pyright: ignore

    def action(self, control: Control) -> Control:
        """Return the action of a control in physical units."""
        return self.task.action(control)

    @property
    def dt(self) -> float:
        """Sampling period [s]."""
        return self.task.plant.dt

    @property
    def observation_size(self) -> int:
        """Length of the observation."""
        return self.task.observation_size

    @property
    def action_size(self) -> int:
        """Length of the action."""
        return self.task.action_size

    @property
    def backend(self) -> str:
        """Name of the physics, which is not brax's."""
        return "sfkd_jax"


class BraxPlant(NamedTuple):
    """A brax system with physical parameters scaled by e; x = (0, 0, 0, q, q̇).

    The system has no pose in the plane: the first three entries of its state are 0.

    Attributes:
        dt: sampling period [s].
        state_names: names of the entries of x.
        control_low: lower limits of the controls.
        control_high: upper limits of the controls.
        parameters: the parameters that the entries of e scale; 1 leaves the system
            unchanged.
        step: (x, u, e) -> x one sampling period later, u in the units of the motors.
        start: key -> x at the start of an episode of the environment.
    """

    dt: float
    state_names: tuple[str, ...]
    control_low: tuple[float, ...]
    control_high: tuple[float, ...]
    parameters: tuple[str, ...]
    step: Step
    start: Callable[[Key], State]


def brax_plant(env: Env, *, parameters: tuple[str, ...] = ("gravity",)) -> BraxPlant:
    """Return x⁺ = (0, q⁺, q̇⁺) with (q⁺, q̇⁺) from brax's own physics scaled by e.

    Args:
        env: from `brax.envs.get_environment(name, backend="generalized")`; wrappers are
            removed.
        parameters: the parameters that the entries of e scale: some of "gravity",
            "damping" and "motor".

    Raises:
        ValueError: the environment has no such system, or a parameter is unknown or
            named twice.
    """
    inner = env.unwrapped
    if not isinstance(inner, PipelineEnv):
        raise ValueError(f"{type(inner).__name__} has no brax system to step")
    if inner.backend != "generalized":
        raise ValueError(
            'backend must be "generalized", where (q, q̇) is the whole state, '
            f"got {inner.backend!r}"
        )
    unknown = [name for name in parameters if name not in SCALED]
    if unknown or len(set(parameters)) != len(parameters):
        raise ValueError(
            f"parameters must be different ones of {', '.join(SCALED)}, "
            f"got {parameters}"
        )
    system = inner.sys
    coordinates = system.q_size()
    # The environment acts once per several steps of the physics.
    frames = round(float(inner.dt) / float(system.opt.timestep))

    def step(state: State, control: Control, env: Environment) -> State:
        # The same system with scaled fields; nothing is compiled anew for another e.
        changed: Any = system.tree_replace(
            {
                field: factor * attrgetter(field)(system)
                for name, factor in zip(parameters, env, strict=True)
                for field in SCALED[name]
            }
        )
        q, qd = jnp.split(state[BODY], [coordinates])

        def frame(moment: Any, _: None) -> tuple[Any, None]:
            return pipeline.step(changed, moment, control), None

        moment = pipeline.init(changed, q, qd)
        moment, _ = jax.lax.scan(frame, moment, length=frames)
        return _state(moment)

    def start(key: Key) -> State:
        return _state(inner.reset(key).pipeline_state)

    low, high = system.actuator.ctrl_range.T.tolist()
    # The pose stays first, where every model expects it.
    positions = [f"q_{k}" for k in range(coordinates)]
    velocities = [f"qd_{k}" for k in range(system.qd_size())]
    return BraxPlant(
        dt=float(inner.dt),
        state_names=("p_x", "p_y", "yaw", *positions, *velocities),
        control_low=tuple(low),
        control_high=tuple(high),
        parameters=parameters,
        step=step,
        start=start,
    )


def brax_system(
    env: Env,
    *,
    states: Mapping[str, float],
    controls: Sequence[str],
    environment: Mapping[str, tuple[float, float]],
) -> System:
    """Return a brax system for `certify_system`; its states are q and q̇.

    Args:
        env: see `brax_plant`.
        states: names of all entries of q and then of q̇ -> deviations of their sensors.
        controls: names of the motors, whose limits are those of the brax system.
        environment: the parameters that e scales, see `brax_plant` -> lower and upper
            end of the factor.

    Raises:
        ValueError: the names do not fit, or `brax_plant` refuses.
    """
    parameters = tuple(split_label(label)[0] for label in environment)
    plant = brax_plant(env, parameters=parameters)
    for what, names, size in (
        ("states", states, len(plant.state_names) - 3),
        ("controls", controls, len(plant.control_low)),
    ):
        if len(names) != size:
            raise ValueError(f"{what}: {size} names, got {len(names)}")

    def step(state: State, control: Control, env: Environment) -> State:
        return plant.step(without_pose(state), control, env)[BODY]

    limits = zip(plant.control_low, plant.control_high, strict=True)
    return System(
        step,
        dt=plant.dt,
        states=states,
        controls=dict(zip(controls, limits, strict=True)),
        environment=environment,
        name=type(env.unwrapped).__name__.lower(),
    )


def _state(moment: Any) -> State:
    """Return (0, 0, 0, q, q̇) of a state of brax."""
    return jnp.concatenate([jnp.zeros(3), moment.q, moment.qd])
