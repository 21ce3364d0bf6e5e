"""The closed loop of a shipped policy and its plant while faults come between them, as
pure functions.
"""

from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import sfkd_jax
from benchmarks.robustness import faults
from sfkd_jax import build, control, scenarios

SHIPPED = Path(sfkd_jax.__file__).with_name("pretrained")
HORIZON, ROAD, SAMPLES = 20, 1000, 64
"""Steps of the plan, steps of a road, rollouts per control step."""
LOST = 20.0
"""Distance from the path at which the car is put back onto it [m]."""


class Road(NamedTuple):
    """What happens in `ROAD` steps, whoever drives."""

    scenario: scenarios.Scenario
    faults: faults.Faults
    noise: jax.Array


class World(NamedTuple):
    """The truth, and what could be read of it.

    Attributes:
        step: of the road.
        state, progress: of the car.
        sent: controls on their way, oldest first.
        read: by channel, readings without a fault of the last steps, newest first.
    """

    step: jax.Array
    state: jax.Array
    progress: jax.Array
    sent: jax.Array
    read: tuple[jax.Array, ...]


class Told(NamedTuple):
    """What `act` is given, and what the clock says."""

    observation: jax.Array
    env: jax.Array
    reference: jax.Array
    elapsed: jax.Array


class Track(NamedTuple):
    """The closed loop around a controller, as pure functions.

    Attributes:
        params: of the model.
        init, act: of the controller; act takes `Told`.
        road: (key, random) -> `Road`.
        enter: road -> `World`.
        sense: (road, world) -> (world, told).
        advance: (road, world, control) -> (world, distance from the path, whether it
            was lost).
        low, high: of the controls.
    """

    params: object
    init: object
    act: object
    road: object
    enter: object
    sense: object
    advance: object
    low: np.ndarray
    high: np.ndarray


def with_elapsed(state, elapsed):
    """The state of a controller whose planner, under its wrappers, is told the time
    since the last call.
    """
    if hasattr(state, "inner"):
        return state._replace(inner=with_elapsed(state.inner, elapsed))
    return state._replace(tuning=state.tuning._replace(elapsed=elapsed))


def not_finite(state):
    """Entries of a controller's state that are not finite."""
    leaves = [
        leaf
        for leaf in jax.tree.leaves(state)
        if jnp.issubdtype(leaf.dtype, jnp.floating)
    ]
    return sum(jnp.sum(~jnp.isfinite(leaf)) for leaf in leaves)


def controlled(plant, env_source, delay, samples, adaptive):
    """The shipped policy as a user has it: (vehicle, params, controller, sensor noise)."""
    directory = SHIPPED / (f"{plant}_path" if adaptive else plant)
    settings = sfkd_jax.load(directory).settings
    chosen = settings["controller"] | {"adaptive": adaptive}
    chosen["mppi"] = chosen["mppi"] | {"num_samples": samples}
    policy = sfkd_jax.load(directory, controller=chosen, env_source=env_source)
    controller = policy.controller
    if delay:
        controller = control.delay_compensated(controller, policy.model, delay=delay)
    certificate = policy.certificate
    where = certificate["corridor"]["class"] if adaptive else certificate["monitor"]
    noise = where["sensor_noise"]
    return (
        build.build_vehicle(settings["vehicle"]),
        policy.params,
        controller,
        noise,
    )


def track(
    plant,
    *,
    env_source="measured",
    delay=0,
    samples=SAMPLES,
    faulty=True,
    adaptive=False,
    steps=ROAD,
):
    """The closed loop over roads of `steps` steps."""
    car, params, controller, noise = controlled(
        plant, env_source, delay, samples, adaptive
    )
    size = len(car.state_names)
    spread = jnp.asarray(noise[:size])
    family = scenarios.scenario(
        name="s3", duration=steps * car.dt, state_size=size, dt=car.dt
    )
    deepest = faults.DURATION[1] + 1

    def road(key, random):
        road_key, noise_key = jax.random.split(key)
        drawn = faults.draw(random if faulty else None, steps, (size, 2, 4))
        noise = spread * jax.random.normal(noise_key, (steps, size))
        return Road(family(road_key), jax.tree.map(jnp.asarray, drawn), noise)

    def readings(road, world):
        ahead = world.progress + delay * car.dt * road.scenario.speed
        window = scenarios.reference_window(
            road.scenario.path, ahead, road.scenario.speed, dt=car.dt, horizon=HORIZON
        )
        return (
            world.state + road.noise[world.step],
            road.scenario.envs[world.step],
            window,
        )

    def enter(road):
        sent = jnp.zeros((delay, len(car.control_low)))
        world = World(
            jnp.zeros((), jnp.int32),
            road.scenario.initial_state,
            jnp.zeros(()),
            sent,
            (),
        )
        return world._replace(
            read=tuple(jnp.stack([value] * deepest) for value in readings(road, world))
        )

    def sense(road, world):
        now = zip(readings(road, world), world.read, strict=True)
        read = tuple(jnp.concatenate([value[None], past[:-1]]) for value, past in now)
        fault = jax.tree.map(lambda leaf: leaf[world.step], road.faults)
        observed = [past[fault.lag[k]] + fault.offset[k] for k, past in enumerate(read)]
        return world._replace(read=read), Told(*observed, fault.elapsed)

    def advance(road, world, control):
        sent = jnp.concatenate([world.sent, control[None]])
        state = car.step(world.state, sent[0], road.scenario.envs[world.step])
        guess = world.progress + road.scenario.speed * car.dt
        progress, lateral = scenarios.project(road.scenario.path, state[:2], guess)
        lost = ~(jnp.abs(lateral) < LOST)
        point = scenarios.point_at(road.scenario.path, guess)
        back = road.scenario.initial_state.at[:3].set(point[:3])
        state, progress = jnp.where(lost, back, state), jnp.where(lost, guess, progress)
        return (
            World(world.step + 1, state, progress, sent[1:], world.read),
            lateral,
            lost,
        )

    def act(params, state, observed):
        state = with_elapsed(state, observed.elapsed)
        return controller.act(
            params, state, observed.observation, observed.env, observed.reference
        )

    limits = [np.float32(side) for side in (car.control_low, car.control_high)]
    return Track(params, controller.init, act, road, enter, sense, advance, *limits)
