"""Tubes of a closed loop, calibrated on whole runs and tested on fresh ones."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sfkd_jax.certificate import OutputMetric
from sfkd_jax.certification import (
    conformal_bounds,
    conformal_quantile,
    coverage,
    radii,
    residuals,
    rows,
)
from sfkd_jax.progress import Progress
from sfkd_jax.ranges import AtLeastOne, Fraction, Positive, Span
from sfkd_jax.rollout import in_batches, rollout
from sfkd_jax.systems import (
    ClosedLoop,
    LoopConditions,
    LoopTubes,
    OutputBounds,
    random_runs,
)
from sfkd_jax.types import BODY, Environment, Key, Model, Params, State, Trajectory

RUNS_AT_ONCE = 50
"""Runs that the nominal model predicts at once."""
PARTS = 3
"""Parts of the runs: for units, bounds and coverage."""
FORM = "vehicle_to_nominal"
"""The bound from the sequence of all disturbances of a run, see `radii`."""


def measure_tubes(
    loop: ClosedLoop,
    model: Model,
    params: Params,
    claims: Mapping[str, OutputMetric],
    key: Key,
    *,
    spread: Float[Array, " state"],
    runs: AtLeastOne = 300,
    duration: Positive = 30.0,
    dwell: Span = (1.0, 4.0),
    level: Fraction = 0.95,
) -> LoopTubes:
    """Return bounds of all outputs, measured on simulated runs of the closed loop.

    The law reads its sensors, and the nominal model starts at what they show. As many
    runs fix the units, calibrate and test.

    Args:
        loop: the closed loop.
        model: that is certified.
        params: its weights, folded.
        claims: proved metrics by output.
        key: of all runs; consumed.
        spread: standard deviations of ξ at the start of a run, at most.
        runs: number of runs of each part.
        duration: of a run [s].
        dwell: range of times between two switches of e [s].
        level: 1 − δ.
    """
    began = time.perf_counter()
    steps = round(duration / loop.tracked.system.dt)
    nominal = jax.jit(partial(_nominal, loop, model, params))

    def part(index: int) -> tuple[np.ndarray, np.ndarray]:
        run_key, sensor_key = jax.random.split(jax.random.fold_in(key, index))
        trajectories = random_runs(
            loop,
            run_key,
            count=runs,
            steps=steps,
            dwell=dwell,
            spread=spread,
            noisy=True,
        )
        return _scores(loop, model, params, claims, nominal, trajectories, sensor_key)

    measured = []
    with Progress("runs", PARTS * runs) as progress:
        for index in range(PARTS):
            measured.append(part(index))
            progress.advance(runs)
    (units, _), (scores, own), (unseen, _) = measured
    bounds = conformal_bounds(units, scores, level=level)
    tubes, nominals = np.split(bounds, 2)
    outputs = {
        name: OutputBounds(
            tube=float(tube),
            nominal=float(of_nominal),
            total=float(tube) + float(of_nominal),
            system=conformal_quantile(largest, level),
        )
        for name, tube, of_nominal, largest in zip(
            claims, tubes, nominals, own.T, strict=True
        )
    }
    return LoopTubes(
        conditions=_conditions(loop, duration, dwell),
        level=level,
        runs=runs,
        outputs=outputs,
        coverage=coverage(bounds, unseen),
        seconds=time.perf_counter() - began,
    )


def _conditions(loop: ClosedLoop, duration: float, dwell: Span) -> LoopConditions:
    """Return the conditions that runs of a loop meet."""
    system = loop.tracked.system
    frame = loop.tracked.frame
    return LoopConditions(
        input_box=frame.input_box,
        reference_dwell_s=frame.dwell,
        env_box=system.env_box,
        env_dwell_s=dwell,
        duration_s=duration,
        sensor_noise=system.sensor_noise,
        perturbation=rows(np.asarray(loop.law.perturbation)),
    )


def _nominal(
    loop: ClosedLoop, model: Model, params: Params, runs: Trajectory, keys: Array
) -> tuple[Array, Array]:
    """Return ξ̂ of nominal models that start at measurements, and z_0 − ẑ_0."""
    noise = jnp.asarray(loop.tracked.system.sensor_noise)

    def latent_of(state: State, env: Environment) -> Array:
        return model.vector(model.encode(model.fiber(params, env), state))

    def of_run(run: Trajectory, key: Key) -> tuple[Array, Array]:
        start = run.states[0]
        off = noise * jax.random.normal(key, noise.shape)
        measured = start.at[BODY].add(off)
        states = run.states.at[0].set(measured)
        free = rollout(model, params, run._replace(states=states)).free
        gap = latent_of(start, run.envs[0]) - latent_of(measured, run.envs[0])
        return free[:, BODY], gap

    return in_batches(
        lambda batch: jax.vmap(of_run)(*batch), (runs, keys), size=RUNS_AT_ONCE
    )


def _scores(
    loop: ClosedLoop,
    model: Model,
    params: Params,
    claims: Mapping[str, OutputMetric],
    nominal: Callable[[Trajectory, Key], tuple[Array, Array]],
    runs: Trajectory,
    key: Key,
) -> tuple[Float[np.ndarray, "run bound"], Float[np.ndarray, "run output"]]:
    """Return the smallest bounds that hold on each run, and the largest |y|.

    The bounds are the tubes of all outputs, then those of the nominal model.
    """
    keys = jax.random.split(key, len(runs.states))
    predicted, gaps = (np.asarray(part, np.float64) for part in nominal(runs, keys))
    errors = residuals(model, params, runs)
    tubes = [radii(errors, name, claim, gaps)[FORM] for name, claim in claims.items()]
    true = np.asarray(runs.states, np.float64)[:, 1:, BODY]
    nominals = []
    own = []
    for name in claims:
        entries = list(loop.tracked.rows[name])
        nominals.append(np.linalg.norm(predicted[..., entries], axis=-1).max(axis=1))
        own.append(np.linalg.norm(true[..., entries], axis=-1).max(axis=1))
    return np.column_stack([*tubes, *nominals]), np.column_stack(own)
