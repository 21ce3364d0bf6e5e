"""SFKD on brax's inverted pendulum with gravity as e: collect, train, certify, control.

A contracting latent cannot hold a pendulum that falls, so what is learned and planned
for is the plant under a fixed gain: u = clip(v - K s), K from a Riccati recursion at
the upright state, v what the planner chooses. The last row plans u itself, with the
true dynamics and without the gain. `--help` lists the sizes.
"""

import argparse
import tempfile
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
from brax import envs

from sfkd_jax import adapters, certification, control, models
from sfkd_jax.data import (
    Dataset,
    measure_space,
    random_windows,
    split,
    spread_windows,
)
from sfkd_jax.rollout import fold
from sfkd_jax.training import fit, multi_step_loss
from sfkd_jax.types import BODY, Controller, Trajectory

LOW, HIGH = (0.6,), (1.4,)  # e: gravity, as a share of the Earth's
LEVELS, HOLD = (1.0, 0.6, 1.4), 3.0  # e while driving, switched every 3 s
AMPLITUDE, PERIOD = 0.35, 5.0
"""The target swings between 0 and twice the amplitude [m], [s]; the rail has 1 m."""
FALLEN = 0.2
"""Angle [rad] at which the environment ends an episode."""


def upright_gain(plant):
    """K of the linear quadratic regulator for the plant as it is (e = 1), linearised
    where the pole stands upright.
    """
    A, B = jax.jit(jax.jacfwd(plant.step, argnums=(0, 1)))(
        jnp.zeros(7), jnp.zeros(1), jnp.ones(1)
    )
    A, B = A[BODY, BODY], B[BODY]
    Q, R = jnp.diag(jnp.asarray([20.0, 20.0, 10.0, 1.0])), jnp.eye(1)

    def best(value):
        return jnp.linalg.solve(R + B.T @ value @ B, B.T @ value @ A)

    return best(
        jax.lax.fori_loop(
            0, 500, lambda _, value: Q + A.T @ value @ (A - B @ best(value)), Q
        )
    )


def under_gain(plant):
    """(K, x, v, e) -> x one step later under u = clip(v - K s); K = 0 is the
    environment as it is.
    """

    def step(gain, state, v, env):
        force = jnp.clip(
            v - gain @ state[BODY], plant.control_low[0], plant.control_high[0]
        )
        return plant.step(state, force, env)

    return step


def collect(plant, step, gain, runs: int) -> Dataset:
    """Runs under random v, each with its own gravity."""
    steps, excitation, memory = 75, 0.22, 0.97
    low, high = jnp.asarray(plant.control_low), jnp.asarray(plant.control_high)
    corners = {"env_low": jnp.asarray(LOW), "env_high": jnp.asarray(HIGH)}

    def one(key):
        start_key, env_key, noise_key = jax.random.split(key, 3)
        env = jax.random.uniform(env_key, (1,), float, *corners.values())
        white = excitation * jax.random.normal(noise_key, (steps, low.shape[0]))

        def advance(carry, white):
            state, noise = carry
            wanted = 0.5 * (low + high) + 0.5 * (high - low) * noise
            control = jnp.clip(wanted, low, high)
            after = step(gain, state, control, env)
            # White noise through a low pass: motors are pushed for longer than a step.
            noise = memory * noise + jnp.sqrt(1.0 - memory**2) * white
            return (after, noise), (after, control)

        start = plant.start(start_key)
        carry, inputs = (start, white[0]), jnp.roll(white, -1, axis=0)
        _, (states, controls) = jax.lax.scan(advance, carry, inputs)
        states = jnp.concatenate([start[None], states])
        return Trajectory(states, controls, jnp.tile(env, (steps, 1)))

    collected = jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(0), runs))
    return split(collected, jax.random.key(1), shares=(0.6, 0.1, 0.2, 0.1), **corners)


def learn(data: Dataset, steps: int, horizon: int):
    """The model, its weights, and its certificate, checked again from its witnesses."""
    # No pose moves: none is to be learned.
    space = measure_space(data)._replace(increment_scale=jnp.full(3, 1e-6))
    model = models.sfkd(
        space, rank=8, vertices=4, residual_hidden=(16,), decoder_hidden=(4,)
    )
    loss = multi_step_loss(model, space, consistency=1.0)
    draw = partial(random_windows, batch=64, length=16)
    held_out, key = spread_windows(data.validation, length=16), jax.random.key(2)
    with tempfile.TemporaryDirectory() as run:
        params, _ = fit(
            model,
            loss,
            draw,
            data.train,
            held_out,
            key,
            Path(run),
            steps=steps,
            learning_rate=0.01,
        )
    splits = {
        "validation": data.validation,
        "calibration": data.calibration,
        "held_out": {"test": data.test},
    }
    options = {"boxes": {"env": (LOW, HIGH)}, "horizon": horizon, "level": 0.9}
    proof = certification.issue(model, params, **splits, **options, attack_starts=0)
    certification.verify(
        certification.Certificate.from_document(proof), params, model=model
    )
    return model, params, proof


def stage(weights, state, v, v_before, target):
    """Cart error, and what keeps the controls smooth and the pole well inside its
    limit.
    """
    beyond = jnp.maximum(jnp.abs(state[4]) - 0.75 * FALLEN, 0.0)
    smooth = (v[0] - v_before[0]) ** 2
    return 100.0 * (state[3] - target) ** 2 + 1e4 * beyond**2 + smooth


def learned_task(model, plant) -> control.Task:
    """The model's latent along the horizon, from what is observed; everything that
    depends on e is computed once.
    """
    low, high = jnp.asarray(plant.control_low), jnp.asarray(plant.control_high)

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
    """v = K s_ref, s_ref the target's position and speed: u = -K (s - s_ref)."""

    def act(gain, memory, state, env, targets):
        wanted = jnp.stack([targets[0], 0.0, (targets[1] - targets[0]) / dt, 0.0])
        return gain @ wanted, memory, {}

    return Controller(lambda key: (), act)


def follow(
    controller, params, physics, state, *, dt: float, horizon: int, seconds: float
):
    """Follow the target in the environment's physics while gravity switches; did the
    pole fall?
    """
    memory, errors, angles = controller.init(jax.random.key(4)), [], []
    for k in range(round(seconds / dt)):
        env = jnp.asarray([LEVELS[int((k + 0.5) * dt / HOLD) % len(LEVELS)]])
        targets = AMPLITUDE * (
            1.0 - jnp.cos(2.0 * jnp.pi / PERIOD * dt * (k + 1 + jnp.arange(horizon)))
        )
        v, memory, _ = controller.act(params, memory, state, env, targets)
        state = physics(state, v, env)
        errors.append(float(state[3] - targets[0]))
        angles.append(abs(float(state[4])))
    rms = (sum(error**2 for error in errors) / len(errors)) ** 0.5
    return {
        "rms_m": rms,
        "angle_rad": max(angles),
        "fallen": not all(angle <= FALLEN for angle in angles),
    }


def main(
    *,
    runs: int = 600,
    steps: int = 1500,
    samples: int = 256,
    horizon: int = 25,
    seconds: float = 12.0,
):
    """Train, certify, control: the certificate, and one row for each controller."""
    plant = adapters.brax_plant(
        envs.get_environment("inverted_pendulum", backend="generalized")
    )
    gain, step = upright_gain(plant), under_gain(plant)
    model, params, proof = learn(collect(plant, step, gain, runs), steps, horizon)
    params = jax.jit(partial(fold, model))(params)  # once, not at every step
    tube = proof["tube"]["physical"]["body"]
    print(
        f"certified: alpha {proof['alpha']:.4f}; "
        f"an attack reaches {proof['attacks']['step_slopes']:.4f}"
    )
    print(
        f"tube of the body state: {tube[0]:.3f} after one step, "
        f"{tube[-1]:.3f} after {horizon}"
    )

    limits = {"control_low": plant.control_low, "control_high": plant.control_high}
    options = {
        "horizon": horizon,
        "num_samples": samples,
        "effective_samples": 10.0,
        "noise_std": (0.4,),
    }
    tasks = (
        learned_task(model, plant),
        control.free_task(step, stage, dt=plant.dt, **limits),
    )
    sfkd, true = (control.mppi(task, **options) for task in tasks)
    sfkd, true, alone = (
        each._replace(act=jax.jit(each.act))
        for each in (sfkd, true, gain_alone(plant.dt))
    )

    def calm(key):
        # Without the gain the pole forgives little; the noise is data, nothing is
        # compiled again.
        memory = true.init(key)
        tuning = memory.tuning._replace(noise_std=jnp.asarray([0.06]))
        return memory._replace(tuning=tuning)

    def unaware(params, memory, x, e, targets):
        return sfkd.act(params, memory, x, jnp.ones(1), targets)

    ways = {
        "SFKD": (sfkd, params, gain),
        "SFKD, given e = 1": (sfkd._replace(act=unaware), params, gain),
        "true dynamics": (true, gain, gain),
        "gain alone": (alone, gain, gain),
        "true dynamics, no gain": (true._replace(init=calm), 0.0 * gain, 0.0 * gain),
    }
    physics, start, rows = jax.jit(step), jax.jit(plant.start)(jax.random.key(3)), {}
    sizes = {"dt": plant.dt, "horizon": horizon, "seconds": seconds}
    for way, (controller, knows, under) in ways.items():
        row = rows[way] = follow(
            controller, knows, partial(physics, under), start, **sizes
        )
        end = "fallen" if row["fallen"] else "upright"
        fate = f"angle up to {row['angle_rad']:.3f} rad, {end}"
        print(f"{way:24} RMS cart error {row['rms_m']:.3f} m, {fate}", flush=True)
    return {"certificate": proof, "rows": rows}


if __name__ == "__main__":
    flags = argparse.ArgumentParser(description=__doc__)
    for flag, default in main.__kwdefaults__.items():
        flags.add_argument(f"--{flag}", type=type(default), default=default)
    main(**vars(flags.parse_args()))
