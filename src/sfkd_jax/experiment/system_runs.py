"""Runs of a certified system beside its law, an oracle and a nominal model."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from sfkd_jax.control import size_of
from sfkd_jax.info import ControllerInfo
from sfkd_jax.models import physics
from sfkd_jax.policy import SystemPolicy, planner_of
from sfkd_jax.progress import Progress
from sfkd_jax.ranges import AtLeastOne, Positive
from sfkd_jax.schedules import random_switching
from sfkd_jax.systems import ClosedLoop, Following, System, Tracked, random_reference
from sfkd_jax.types import Control, Controller, Environment, Key, Params, State

POLICY = "policy"
"""Name of a policy beside its rivals."""


class Scene(NamedTuple):
    """What a run is driven through.

    Attributes:
        reference: states of the reference, horizon steps longer than the run.
        envs: e of every step.
        noise: of the sensors, at every step.
        start: state at the beginning.
    """

    reference: Float[Array, "point reference"]
    envs: Float[Array, "time environment"]
    noise: Float[Array, "time state"]
    start: State


class SystemRuns(NamedTuple):
    """Simulated runs of a controller.

    Attributes:
        errors: |y| of each output, (run, time, output).
        bounds: what was claimed of it; NaN without a claim.
        states: of the system, in which the controls were applied.
    """

    errors: Float[Array, "run time output"]
    bounds: Float[Array, "run time output"]
    states: Float[Array, "run time state"]

    @property
    def claimed(self) -> Bool[np.ndarray, "run time"]:
        """Whether something was claimed."""
        return np.asarray(jnp.isfinite(self.bounds).all(axis=-1))

    @property
    def beyond(self) -> int:
        """Number of steps in which an output was beyond what was claimed."""
        exceeded = np.asarray(self.errors > self.bounds)
        return int(np.sum(exceeded.any(axis=-1) & self.claimed))

    def rmse(self, output: int = 0) -> float:
        """Return the root of the mean square of an output, in its unit."""
        errors = np.asarray(self.errors, np.float64)[..., output]
        return float(np.sqrt(np.mean(errors**2)))


def random_scenes(
    policy: SystemPolicy, key: Key, *, runs: AtLeastOne, duration: Positive
) -> Scene:
    """Draw scenes of the class that a certificate is about, from their steady states.

    Args:
        policy: whose certificate states the class.
        key: consumed.
        runs: number of scenes.
        duration: of each [s].
    """
    tracked = policy.loop.tracked
    system = tracked.system
    steps = round(duration / system.dt)
    low, high = system.env_box
    dwell = policy.certificate.tubes.conditions.env_dwell_s

    def scene(key: Key) -> Scene:
        reference_key, env_key, noise_key = jax.random.split(key, 3)
        reference = random_reference(
            tracked, reference_key, steps=steps + policy.horizon
        )
        envs = random_switching(
            env_key, steps=steps, dt=system.dt, low=low, high=high, dwell=dwell
        )
        inputs = tracked.inputs(reference.points[0], reference.rates[0])
        steady = policy.loop.law.at(inputs, envs[0]).state
        noise = jax.random.normal(noise_key, (steps, len(tracked.names)))
        return Scene(
            reference=reference.points,
            envs=envs,
            noise=jnp.asarray(system.sensor_noise) * noise,
            start=tracked.state(steady, reference.points[0]),
        )

    return jax.jit(jax.vmap(scene))(jax.random.split(key, runs))


def run_controller(
    policy: SystemPolicy,
    step: Any,
    controller: Controller,
    params: Params,
    scenes: Scene,
    key: Key,
) -> SystemRuns:
    """Simulate a controller in the scenes.

    Args:
        policy: whose frame, law and outputs are used.
        step: of the system, in its own states.
        controller: see `SystemPolicy.controller`.
        params: of the controller.
        scenes: of `random_scenes`.
        key: of the controllers; consumed.
    """
    tracked = policy.loop.tracked
    rows = list(tracked.rows.values())

    def run(params: Params, scene: Scene, key: Key) -> SystemRuns:
        def advance(carry: Any, at: Any) -> tuple[Any, tuple[Array, ...]]:
            state, inner = carry
            index, env, noise = at
            window = jax.lax.dynamic_slice_in_dim(
                scene.reference, index, policy.horizon + 1
            )
            control, inner, info = controller.act(
                params, inner, state + noise, env, window
            )
            error = tracked.coordinates(state, window[0])
            errors = jnp.stack([size_of(error, entries) for entries in rows])
            bounds = jnp.broadcast_to(jnp.asarray(info.claim.bound), errors.shape)
            return (step(state, control, env), inner), (errors, bounds, state)

        steps = jnp.arange(len(scene.envs))
        carry = (scene.start, controller.init(key))
        _, recorded = jax.lax.scan(advance, carry, (steps, scene.envs, scene.noise))
        return SystemRuns(*recorded)

    keys = jax.random.split(key, len(scenes.envs))
    simulate = jax.jit(jax.vmap(run, in_axes=(None, 0, 0)))
    return jax.block_until_ready(simulate(params, scenes, keys))


def drive_beside_rivals(
    policy: SystemPolicy,
    system: System,
    *,
    runs: AtLeastOne = 16,
    duration: Positive = 30.0,
    seed: int = 1,
) -> dict[str, SystemRuns]:
    """Return runs of a policy and of its `rivals` in the same scenes, by name.

    Args:
        policy: of the system.
        system: with its step.
        runs: number of scenes.
        duration: of each [s].
        seed: of the scenes.
    """
    scene_key, drive_key = jax.random.split(jax.random.key(seed))
    scenes = random_scenes(policy, scene_key, runs=runs, duration=duration)
    drive = partial(run_controller, policy, system.step, scenes=scenes, key=drive_key)
    others = rivals(policy, system)
    with Progress("controllers", 1 + len(others)) as progress:
        driven = {POLICY: drive(controller=policy.controller, params=policy.params)}
        progress.advance()
        for name, controller in others.items():
            driven[name] = drive(controller=controller, params={})
            progress.advance()
    return driven


def compared(driven: dict[str, SystemRuns]) -> dict[str, Any]:
    """Return the RMSE of every controller, and how the claims of the policy held.

    Args:
        driven: of `drive_beside_rivals`.
    """
    own = driven[POLICY]
    result: dict[str, Any] = {
        "rmse": own.rmse(),
        "beyond": own.beyond,
        "claimed": float(own.claimed.mean()),
    }
    for name, runs in driven.items():
        if name != POLICY:
            result[f"rmse_{name}"] = runs.rmse()
    return result


def first_run(policy: SystemPolicy, driven: dict[str, SystemRuns]) -> dict[str, Any]:
    """Return |y| at every step of the first run, by controller and output."""
    return {
        name: {
            output: [round(float(error), 7) for error in runs.errors[0, :, index]]
            for index, output in enumerate(policy.outputs)
        }
        for name, runs in driven.items()
    }


def rivals(policy: SystemPolicy, system: System) -> dict[str, Controller]:
    """Return controllers without a shield, to compare a policy with.

    "law" is the law of the policy alone. "oracle" is its planner with the true closed
    loop in place of the model. "nominal" is the same with e in the middle of its box,
    for law and model alike.

    Args:
        policy: of the system.
        system: with its step.
    """
    tracked = Tracked(system, policy.loop.tracked.frame)
    loop = ClosedLoop(tracked, policy.loop.law)
    true_loop = physics(loop.step, frame=policy.model.frame)
    planner = planner_of(policy, true_loop)
    oracle = Following(inner=planner, tracked=tracked).controller()
    return {
        "law": _law_alone(loop),
        "oracle": oracle,
        "nominal": _in_usual_env(oracle, system),
    }


def _law_alone(loop: ClosedLoop) -> Controller:
    """Return the law as a controller of the system."""

    def act(
        params: Params, state: Any, error: Array, env: Environment, inputs: Array
    ) -> tuple[Control, Any, ControllerInfo]:
        steady = loop.law.at(inputs[0], env)
        return loop.limited(steady.feedback(error)), state, ControllerInfo()

    inner = Controller(lambda key: (), act)
    return Following(inner=inner, tracked=loop.tracked).controller()


def _in_usual_env(controller: Controller, system: System) -> Controller:
    """Return a controller that is told the middle of the box in place of e."""
    middle = jnp.mean(jnp.asarray(system.env_box), axis=0)

    def act(
        params: Params, state: Any, observation: State, env: Environment, window: Array
    ) -> Any:
        return controller.act(params, state, observation, middle, window)

    return Controller(controller.init, act)
