"""What the main job does, and about how long that takes on this machine."""

from __future__ import annotations

import time

import jax
import jax.numpy as jnp
from jaxtyping import Array

from sfkd_jax.driving.corridor import simulated_steps
from sfkd_jax.experiment.evaluating import available_cores
from sfkd_jax.experiment.run import Run

PROBE = 0.65
"""Time of `_probe` on the machine that the constants below are from: two cores of a
server, on which `python -m sfkd_jax.train +experiment=s3` took 5:16 [s].
"""
COMPILING = 220.0
"""Time in which all programs are compiled, on one core [s]."""
SHARED = 0.6
"""Share of that time that is left on two cores or more."""
TRAINING_STEP = 0.016
"""Of a step of the optimiser [s]."""
VEHICLE_STEP = 1.1e-5
"""Of a step of the vehicle in the runs of a corridor [s]."""
CONTROL_STEP = 1e-2
"""Of a control step with `SAMPLES` samples, on one core [s]."""
SAMPLES = 1500


def work_of(run: Run) -> str:
    """Return what a training with everything after it does, and how long that takes.

    A simulator on the host may be a thousand times slower than the vehicles of this
    package, so that nothing is said of its time.

    Args:
        run: whose settings are read; nothing is made.
    """
    settings = run.settings
    evaluation = settings.evaluation
    parts = ["data", f"{settings.training.steps:,} steps of training"]
    driven = _corridor_steps(run)
    on_runs = f" on {driven:,} steps of the vehicle" if driven else ""
    parts.append(f"a certificate{on_runs}")
    if run.plant.simulated:
        systems = len(evaluation.systems)
        length = f"{evaluation.episodes} episodes of {evaluation.episode_s:g} s"
        parts.append(f"{length} of {systems} system{'s' * (systems != 1)}")
    work = ", ".join(parts)
    if run.source.has_simulator or jax.default_backend() != "cpu":
        return work
    minutes = _seconds(run) * _probe() / PROBE / 60.0
    return f"{work}; about {max(round(minutes), 1)} min on this machine"


def _corridor_steps(run: Run) -> int:
    """Return the number of steps of the vehicle for the corridor; 0 without one."""
    # Logs have no plant to drive.
    if not run.source.along_path or run.source.logs is not None:
        return 0
    corridor = run.settings.certification.corridor
    return simulated_steps(
        run.plant.dt,
        corridor.runs,
        corridor.duration,
        corridor.attack_steps,
        corridor.later,
    )


def _seconds(run: Run) -> float:
    """Return how long the work of a run takes, on a machine as fast as `PROBE` [s]."""
    settings = run.settings
    evaluation = settings.evaluation
    cores = available_cores()
    seconds = COMPILING * (SHARED if cores > 1 else 1.0)
    seconds += TRAINING_STEP * settings.training.steps
    seconds += VEHICLE_STEP * _corridor_steps(run)
    if run.plant.simulated:
        samples = getattr(settings.controller.planner_settings, "num_samples", SAMPLES)
        of_step = CONTROL_STEP * max(samples / SAMPLES, 0.1)
        steps = evaluation.episodes * evaluation.episode_s / run.plant.dt
        together = min(cores, evaluation.episodes)
        seconds += of_step * steps * len(evaluation.systems) / together
    return seconds


def _probe() -> float:
    """Return how long a small program takes, to compile and to run [s]."""
    began = time.perf_counter()

    def step(values: Array, number: Array) -> tuple[Array, Array]:
        for layer in range(8):
            turned = jnp.tanh(values @ jnp.full((16, 16), 0.1 + 0.01 * layer))
            values = turned + jnp.sin(layer * values)
        return values, jnp.sum(values) + number

    run = jax.jit(lambda start: jax.lax.scan(step, start, jnp.arange(2000)))
    jax.block_until_ready(run(jnp.ones((16, 16))))
    return time.perf_counter() - began
