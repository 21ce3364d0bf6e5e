"""SFKD learns brax's inverted pendulum, where gravity is the environment e.

The program collects runs, trains, certifies, and follows a moving target while gravity
switches every 3 s. A contracting latent cannot hold a pendulum that falls. So what is
learned and planned for is the plant under a fixed gain: u = clip(v - K s), with K from
a Riccati recursion at the upright state, and v what the planner chooses. One line is
printed for each of five controllers; the last one plans u itself, with the true
dynamics and without the gain. It needs the package `brax`.

    python examples/brax_pendulum.py [--help for the sizes]
"""

import argparse
import tempfile
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
from brax import envs

from sfkd_jax import adapters, certification, control, models
from sfkd_jax.data import Dataset, measure_space, random_windows, split, spread_windows
from sfkd_jax.rollout import fold
from sfkd_jax.training import fit, multi_step_loss
from sfkd_jax.types import BODY, Controller, Params, Trajectory

ENV_LOW = (0.6,)  # e: gravity, as a share of the Earth's
ENV_HIGH = (1.4,)
LEVELS = (1.0, 0.6, 1.4)  # of e while driving, one after the other
HOLD = 3.0  # how long each of them lasts [s]
AMPLITUDE = 0.35
PERIOD = 5.0
"""The target swings between 0 and twice the amplitude [m], [s]; the rail has 1 m."""
FALLEN = 0.2
"""Angle [rad] at which the environment ends an episode."""
CART = 3
ANGLE = 4
"""Columns of the state: position of the cart [m], angle of the pole [rad]."""
STATES = 7
CONTROLS = 1
LOGGED_STEPS = 75
EXCITATION = 0.22
MEMORY = 0.97  # of the excitation, from step to step
WINDOW = 16  # steps that the loss predicts


class Driver(NamedTuple):
    """A controller and what it drives.

    Attributes:
        controller: of v.
        params: of its model.
        gain: K of the plant that it drives; 0 for the environment as it is.
    """

    controller: Controller
    params: Params
    gain: jax.Array


def upright_gain(plant):
    """Return K of the linear quadratic regulator of the upright pole at e = 1."""
    jacobians = jax.jit(jax.jacfwd(plant.step, argnums=(0, 1)))
    by_state, by_control = jacobians(
        jnp.zeros(STATES), jnp.zeros(CONTROLS), jnp.ones(1)
    )
    A = by_state[BODY, BODY]
    B = by_control[BODY]
    Q = jnp.diag(jnp.asarray([20.0, 20.0, 10.0, 1.0]))
    R = jnp.eye(1)

    def best(value):
        return jnp.linalg.solve(R + B.T @ value @ B, B.T @ value @ A)

    def earlier(_, value):
        return Q + A.T @ value @ (A - B @ best(value))

    return best(jax.lax.fori_loop(0, 500, earlier, Q))


def under_gain(plant):
    """Return the step (K, x, v, e) -> x under u = clip(v - K s)."""

    def step(gain, state, v, env):
        force = jnp.clip(
            v - gain @ state[BODY], plant.control_low[0], plant.control_high[0]
        )
        return plant.step(state, force, env)

    return step


def collect(plant, step, gain, runs: int) -> Dataset:
    """Return runs under random v, each with its own gravity."""
    low = jnp.asarray(plant.control_low)
    high = jnp.asarray(plant.control_high)
    env_low = jnp.asarray(ENV_LOW)
    env_high = jnp.asarray(ENV_HIGH)

    def collect_run(key):
        start_key, env_key, noise_key = jax.random.split(key, 3)
        env = jax.random.uniform(env_key, (1,), float, env_low, env_high)
        shape = (LOGGED_STEPS, low.shape[0])
        white = EXCITATION * jax.random.normal(noise_key, shape)

        def advance(carry, white):
            state, noise = carry
            wanted = 0.5 * (low + high) + 0.5 * (high - low) * noise
            control = jnp.clip(wanted, low, high)
            after = step(gain, state, control, env)
            # White noise through a low pass: motors are pushed for longer than a step.
            noise = MEMORY * noise + jnp.sqrt(1.0 - MEMORY**2) * white
            return (after, noise), (after, control)

        start = plant.start(start_key)
        _, (states, controls) = jax.lax.scan(
            advance, (start, white[0]), jnp.roll(white, -1, axis=0)
        )
        states = jnp.concatenate([start[None], states])
        return Trajectory(states, controls, jnp.tile(env, (LOGGED_STEPS, 1)))

    collected = jax.jit(jax.vmap(collect_run))(
        jax.random.split(jax.random.key(0), runs)
    )
    return split(
        collected,
        jax.random.key(1),
        shares=(0.6, 0.1, 0.2, 0.1),
        env_low=env_low,
        env_high=env_high,
    )


def learn(data: Dataset, steps: int, horizon: int):
    """Return the model, its weights, what is proved of it, and what is measured."""
    # No pose moves: none is to be learned.
    space = measure_space(data)._replace(increment_scale=jnp.full(3, 1e-6))
    model = models.sfkd(
        space, rank=8, vertices=4, residual_hidden=(16,), decoder_hidden=(4,)
    )
    with tempfile.TemporaryDirectory() as directory:
        params, _ = fit(
            model,
            multi_step_loss(model, space, consistency=1.0),
            partial(random_windows, batch=64, length=WINDOW),
            data.train,
            spread_windows(data.validation, length=WINDOW),
            jax.random.key(2),
            Path(directory),
            steps=steps,
            learning_rate=0.01,
        )
    boxes = certification.boxes_of(data)
    proof = certification.prove(
        model, params, boxes.env, validation=data.validation, attack_starts=0
    )
    # Checked again, from its witnesses.
    certification.verify_proof(proof, model, params)
    measured = certification.measure(
        model,
        params,
        proof,
        validation=data.validation,
        calibration=data.calibration,
        held_out={"test": data.test},
        boxes=boxes,
        horizon=horizon,
        level=0.9,
    )
    return model, params, proof, measured


def stage(weights, state, v, v_before, target):
    """Cost of a step: distance of the cart, changes of v, an angle near its limit."""
    beyond = jnp.maximum(jnp.abs(state[ANGLE]) - 0.75 * FALLEN, 0.0)
    smooth = (v[0] - v_before[0]) ** 2
    return 100.0 * (state[CART] - target) ** 2 + 1e4 * beyond**2 + smooth


def learned_task(model, plant) -> control.Task:
    """Return the task that rolls out the latent of the model from what is observed.

    Everything that depends on e is computed once a control step.
    """
    low = jnp.asarray(plant.control_low)
    high = jnp.asarray(plant.control_high)

    def prepare(params, observation, env, reference, applied):
        fiber = model.fiber(params, env)
        latent = model.encode(fiber, observation)
        first = control.Sample(latent, observation, applied.control)
        return control.RolloutSetup(fiber, first, reference)

    def step(weights, fiber, before, wanted, target, at):
        v = jnp.clip(wanted, low, high)
        latent = model.step(fiber, before.latent, v)
        state = model.decode(fiber, latent)
        return control.StepResult(control.Sample(latent, state, v), v, v, state)

    def cost(weights, before, after, target, at):
        return stage(weights, after.state, after.control, before.control, target)

    return control.Task(low, high, (), prepare, step, lambda *_: None, cost)


def gain_alone(dt: float) -> Controller:
    """Return v = K s_ref, with position and speed of the target: u = -K (s - s_ref)."""

    def act(gain, memory, state, env, targets):
        wanted = jnp.stack([targets[0], 0.0, (targets[1] - targets[0]) / dt, 0.0])
        return gain @ wanted, memory, {}

    return Controller(lambda key: (), act)


def build_drivers(plant, step, model, params, gain, *, samples: int, horizon: int):
    """Return the controllers that are compared, by name."""
    build = partial(
        control.mppi,
        horizon=horizon,
        num_samples=samples,
        effective_samples=10.0,
        noise_std=(0.4,),
    )
    true_task = control.free_task(
        step,
        stage,
        dt=plant.dt,
        control_low=plant.control_low,
        control_high=plant.control_high,
    )
    sfkd = jitted(build(learned_task(model, plant)))
    true = jitted(build(true_task))

    def unaware(params, memory, x, e, targets):
        return sfkd.act(params, memory, x, jnp.ones(1), targets)

    def init_calm(key):
        # Without the gain the pole forgives little; the noise is data, nothing is
        # compiled again.
        memory = true.init(key)
        tuning = memory.tuning._replace(noise_std=jnp.asarray([0.06]))
        return memory._replace(tuning=tuning)

    no_gain = 0.0 * gain
    return {
        "SFKD": Driver(sfkd, params, gain),
        "SFKD, given e = 1": Driver(sfkd._replace(act=unaware), params, gain),
        "true dynamics": Driver(true, gain, gain),
        "gain alone": Driver(jitted(gain_alone(plant.dt)), gain, gain),
        "true dynamics, no gain": Driver(
            true._replace(init=init_calm), no_gain, no_gain
        ),
    }


def jitted(controller: Controller) -> Controller:
    """Return the controller with a compiled control step."""
    return controller._replace(act=jax.jit(controller.act))


def follow(driver, physics, state, *, dt: float, horizon: int, seconds: float):
    """Follow the target in the environment's physics while gravity switches.

    Returns the RMS distance of the cart from the target [m], the largest angle [rad],
    and whether the pole fell.
    """
    memory = driver.controller.init(jax.random.key(4))
    errors = []
    angles = []
    for k in range(round(seconds / dt)):
        env = jnp.asarray([LEVELS[int((k + 0.5) * dt / HOLD) % len(LEVELS)]])
        phase = 2.0 * jnp.pi / PERIOD * dt * (k + 1 + jnp.arange(horizon))
        targets = AMPLITUDE * (1.0 - jnp.cos(phase))
        v, memory, _ = driver.controller.act(driver.params, memory, state, env, targets)
        state = physics(driver.gain, state, v, env)
        errors.append(float(state[CART] - targets[0]))
        angles.append(abs(float(state[ANGLE])))
    return {
        "rms_m": (sum(error**2 for error in errors) / len(errors)) ** 0.5,
        "angle_rad": max(angles),
        "fallen": not all(angle <= FALLEN for angle in angles),
    }


def print_certificate(proof, measured, horizon: int) -> None:
    """Print the certified rate and how far the body state may stray."""
    tube = measured.tube.physical["body"]
    print(
        f"certified: alpha {proof.alpha:.4f}; "
        f"an attack reaches {proof.attacks['step_slopes']:.4f}"
    )
    print(
        f"tube of the body state: {tube[0]:.3f} after one step, "
        f"{tube[-1]:.3f} after {horizon}"
    )


def main(
    *,
    runs: int = 600,
    steps: int = 1500,
    samples: int = 256,
    horizon: int = 25,
    seconds: float = 12.0,
):
    """Train, certify and drive; return what is proved and measured, and the rows."""
    environment = envs.get_environment("inverted_pendulum", backend="generalized")
    plant = adapters.brax_plant(environment)
    gain = upright_gain(plant)
    step = under_gain(plant)
    data = collect(plant, step, gain, runs)
    model, params, proof, measured = learn(data, steps, horizon)
    print_certificate(proof, measured, horizon)

    # What depends on the weights alone is computed once, not at every step.
    params = jax.jit(partial(fold, model))(params)
    drivers = build_drivers(
        plant, step, model, params, gain, samples=samples, horizon=horizon
    )
    physics = jax.jit(step)
    start = jax.jit(plant.start)(jax.random.key(3))
    rows = {}
    for name, driver in drivers.items():
        row = follow(
            driver, physics, start, dt=plant.dt, horizon=horizon, seconds=seconds
        )
        end = "fallen" if row["fallen"] else "upright"
        angle = f"angle up to {row['angle_rad']:.3f} rad, {end}"
        print(f"{name:24} RMS cart error {row['rms_m']:.3f} m, {angle}", flush=True)
        rows[name] = row
    return {"proof": proof, "measured": measured, "rows": rows}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=int, default=600, help="to learn from")
    parser.add_argument("--steps", type=int, default=1500, help="of the training")
    parser.add_argument("--samples", type=int, default=256, help="of a plan")
    parser.add_argument("--horizon", type=int, default=25, help="steps of a plan")
    parser.add_argument("--seconds", type=float, default=12.0, help="that are driven")
    main(**vars(parser.parse_args()))
