"""The corridor of a closed loop: calibrated on whole runs, tested and attacked.

The runs are those of the conditions that a certificate states: e switches in its box
with at least the dwell time, roads and perturbations ν are those of the data set, and
the law reads the state through the sensors. The bounds are measured on these runs; only
α, L and P behind them are proved.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sfkd_jax.certification._alarms import (
    Loop,
    calibrate_innovations,
    innovations,
    sensor_effect,
    simulate_nominal,
)
from sfkd_jax.certification._alarms import closed_loop as closed_loop
from sfkd_jax.certification._attack import CertificateContradicted
from sfkd_jax.certification._claims import OUTPUTS, OutputMetric
from sfkd_jax.certification._measured import check_count as check_count
from sfkd_jax.certification._measured import conformal_bounds, residuals
from sfkd_jax.certification._tubes import (
    ALONE,
    FORMS,
    JOINT,
    calibrate_corridor,
    corridor_coverage,
    radii,
)
from sfkd_jax.control import safety_filter
from sfkd_jax.data import drive_along_path, from_s3
from sfkd_jax.geometry import LATERAL, path_state
from sfkd_jax.ranges import Interval, Span
from sfkd_jax.scenarios import DRIVES, DriveClass, random_switching
from sfkd_jax.types import (
    BODY,
    Control,
    Environment,
    Key,
    Params,
    Trajectory,
)

ROAD_SETTINGS = DriveClass._fields
"""Settings of the data set that are the class of its drives."""
EXCITATION = ("steering_excitation", "speed_excitation")
STREAM, ALARMS = 4, 5
"""Streams folded into the data set's seed, of the corridor and of the test of
innovations; the data set uses streams 0 to 2.
"""
BLOCK = 5
"""Steps for which the attack holds ν."""
GENERATIONS = 10
AIMS = ("lateral", "distance", "within")
"""Far from the path; far from the nominal model; far from it while the tube's
hypothesis holds.
"""
LENGTH = 200
"""Steps of a run of the attack."""
KEEP = 20
"""Worst runs returned per aim."""
ELITE = 0.1
"""Part of a generation that the next one is drawn around."""


def _driver(
    loop: Loop,
    limits: DriveClass,
    excited: Mapping[str, Any],
    groups: Int[Array, " run"],
    conditions: Callable[[Key], Array],
) -> Callable[[Key], Trajectory]:
    """Return key -> runs of the groups, each under its own conditions; compiled."""
    drive = partial(
        drive_along_path,
        loop.plant,
        limits=limits,
        sensors=partial(sensor_effect, loop),
        offset=(0.0, 0.0, 0.0),
        burn_in=0,
        **excited,
    )

    def driven(key: Key) -> Trajectory:
        env_key, run_key = jax.random.split(key)
        envs = jax.vmap(conditions)(jax.random.split(env_key, len(groups)))
        return drive(envs, run_key, groups=groups)

    return jax.jit(driven)


def certify_corridor(
    loop: Loop,
    outputs: Mapping[str, Any],
    data: Mapping[str, Any],
    level: float,
    *,
    runs: int = 150,
    duration: Annotated[float, Interval("(2, inf)")] = 60.0,
    dwell: Span = (3.0, 6.0),
    horizon: int = 20,
    attack_steps: int = 200_000,
) -> dict[str, Any]:
    """Return the entry of the certificate about the corridor.

    Of each group of drives one part of `runs` fixes the units, one calibrates and one
    tests; the bounds are those of the worst group. The runs of S3, which does not meet
    the conditions, are tested too.

    Args:
        loop: of the policy.
        outputs: that part of the document, with a proved metric of each.
        data: of the data set: `ROAD_SETTINGS`, `EXCITATION`, env_low, env_high and
            seed.
        level: 1 − δ.
        runs: number of runs of each part.
        duration: of a run [s].
        dwell: range of times between switches [s].
        horizon: preview of the shield [steps].
        attack_steps: of the search for runs that leave the corridor.

    Raises:
        ValueError: too few runs for the level.
        CertificateContradicted: the attack contradicts a bound.
    """
    began = time.perf_counter()
    claims = {n: OutputMetric.from_document(part) for n, part in outputs.items()}
    low = data["env_low"]
    high = data["env_high"]
    limits = DriveClass(**drive_class(data))
    excited = {name: data[name] for name in EXCITATION}
    # Streams of their own: the data set's runs must not reappear in its certificate.
    stream = partial(jax.random.fold_in, jax.random.key(data["seed"]))
    *run_keys, sensor_key, attack_key = jax.random.split(stream(STREAM), 6)
    steps = round(duration / loop.plant.dt)
    dt = loop.plant.dt
    switching = partial(
        random_switching, steps=steps, dt=dt, low=low, high=high, dwell=dwell
    )
    # Jitted once each: the three parts under the conditions share one program.
    runs_of = partial(
        _driver, loop, limits, excited, jnp.repeat(jnp.arange(len(DRIVES)), runs)
    )
    kinds = [runs_of(switching)] * 3 + [runs_of(from_s3(steps, dt, low, high))]
    simulate = jax.jit(partial(simulate_nominal, loop))
    keys = zip(kinds, run_keys, jax.random.split(sensor_key, 4), strict=True)
    measured = [
        _measure(loop, claims, simulate, kind(run_key), key)
        for kind, run_key, key in keys
    ]
    units, calibration, test, s3 = (scores for *_, scores in measured)
    bounds, shares = _worst_group(units, calibration, test, level)
    failed = sum(int(np.isinf(scores[:, 0]).sum()) for *_, scores in measured)
    lateral, nominal, _ = measured[2]
    conditions = {
        "env_box": [low, high],
        "dwell_s": dwell,
        "duration_s": duration,
        "sensor_noise": loop.noise,
        "perturbation": loop.law.perturbation.tolist(),
        "law_model": data["law"]["model"],
    }
    # The shortest dwell: an attack switches as often as the conditions allow.
    held = max(1, round(dwell[0] / dt))
    bound = bounds["vehicle_to_nominal_position"]
    search = _Search(loop, claims["position"], bound, data, held, attack_steps)
    observe = jax.jit(partial(innovations, loop))
    seen, seen_s3 = (partial(_seen, kind, observe) for kind in kinds[2:])
    key = stream(ALARMS)
    alarms = calibrate_innovations(seen, seen_s3, key, duration=duration)
    return {
        "conditions": drive_class(data) | excited | conditions,
        "level": level,
        "runs": runs,
        "bounds": bounds,
        "corridor_m": bounds["nominal"] + bound,
        **shares,
        # S3 does not meet the conditions: reported beside the claim, never in it.
        "by_scenario": {"s3": corridor_coverage(bounds, s3)},
        "seen": {
            "distance_m": float(np.nanmax(np.abs(lateral - nominal))),
            "lateral_m": float(np.nanmax(np.abs(lateral))),
        },
        **({"failed_runs": failed} if failed else {}),
        "attack": _attack(search, attack_key, bounds["nominal"], horizon),
        "innovations": alarms,
        "shield_horizon": horizon,
        "seconds": time.perf_counter() - began,
    }


def scores_of_runs(
    loop: Loop, document: Mapping[str, Any], runs: Trajectory
) -> tuple[np.ndarray, np.ndarray]:
    """Scores of recorded runs and their e_y (run, time), as those of simulated ones.

    The state of a vehicle is what its sensors show, also to the nominal model.
    """
    outputs = document["outputs"]
    claims = {n: OutputMetric.from_document(part) for n, part in outputs.items()}
    simulate = jax.jit(partial(simulate_nominal, loop))
    lateral, _, scores = _measure(loop, claims, simulate, runs, jax.random.key(0))
    return scores, lateral


def calibrate_on_runs(
    document: Mapping[str, Any], scores: np.ndarray, level: float
) -> dict[str, Any]:
    """Return the part `recorded` of a certificate, from `scores_of_runs` at 1 − δ.

    Units are the bounds of the document, which these runs did not make. The filter
    keeps the width with which they were driven.
    """
    before = document["corridor"]["bounds"]
    units = np.asarray([[before[name] for name in JOINT]])
    found = conformal_bounds(units, scores[:, : len(JOINT)], level=level)
    bounds = dict(zip(JOINT, found.tolist(), strict=True))
    bounds["nominal"] = max(bounds["nominal"], before["nominal"])
    return {
        "bounds": bounds,
        "corridor_m": bounds["nominal"] + bounds["vehicle_to_nominal_position"],
        "level": level,
    }


def drive_class(data: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of a data set that say which drives a corridor is about."""
    return {name: data[name] for name in ROAD_SETTINGS}


def _worst_group(
    units: np.ndarray,
    calibration: np.ndarray,
    test: np.ndarray,
    level: float,
) -> tuple[dict[str, float], dict[str, Any]]:
    """The bounds of the worst group and their coverage; runs are group after group."""
    own = {}
    shares = {}
    parts = [np.split(part, len(DRIVES)) for part in (units, calibration, test)]
    for name, unit, calibrated, _ in zip(DRIVES, *parts, strict=True):
        unit = unit[np.isfinite(unit[:, 0])]
        own[name] = calibrate_corridor(unit, calibrated, level=level)
    bounds = {
        kind: max(each[kind] for each in own.values()) for kind in (*JOINT, *ALONE)
    }
    for name, part in zip(DRIVES, parts[2], strict=True):
        shares[name] = corridor_coverage(bounds, part)
    least = min(shares.values(), key=lambda share: share["coverage"])
    groups = {name: {"bounds": own[name]} | shares[name] for name in DRIVES}
    return bounds, least | {"by_group": groups}


def _measure(
    loop: Loop,
    claims: Mapping[str, OutputMetric],
    simulate: Callable[..., Any],
    runs: Trajectory,
    key: Key,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """e_y of the car and ê_y of the nominal model (run, time), and scores of the runs.

    Scores are the smallest bounds that would have held on a run, `JOINT` and `ALONE`.
    Where a simulator failed, none would have: the run counts as one outside.
    `simulate` is `simulate_nominal`, compiled once for all batches of one size.
    """
    nominal, start = (np.asarray(part, np.float64) for part in simulate(runs, key))
    errors = residuals(loop.model, loop.params, runs)
    bounds = [radii(errors, name, claims[name], start) for name in OUTPUTS]
    alone, together = ([each[form] for each in bounds] for form in FORMS)
    scores = [*together, np.max(np.abs(nominal), axis=1), *alone]
    lateral = np.asarray(runs.states, dtype=np.float64)[:, 1:, BODY][..., LATERAL]
    scores = np.column_stack(scores)
    scores[np.isnan(scores).any(axis=1)] = np.inf
    return lateral, nominal, scores


def _seen(runs_of: Callable[[Key], Trajectory], observe: Any, key: Key) -> Any:
    """Innovations of runs; one in which a simulator failed is another one's again."""
    runs = runs_of(key)
    kept = np.isfinite(np.asarray(runs.states)).all(axis=(1, 2))
    rows = np.resize(np.flatnonzero(kept), len(runs.states))
    rows = np.where(kept, np.arange(len(rows)), rows)
    return jax.tree.map(lambda leaf: leaf[rows], observe(runs, key))


Runs: TypeAlias = tuple[Array, Array]
"""Inputs w (time, 4) and environments (time, environment) of a run."""


class Outcome(NamedTuple):
    """Largest values over a run, (run,)."""

    lateral: Float[Array, " run"]  # |e_y| [m]
    # |e_y − ê_y| from the nominal model with the same inputs [m].
    distance: Float[Array, " run"]
    radius: Float[Array, " run"]  # of the tube, from the disturbances of this run [m]


@dataclass(frozen=True, eq=False)
class _Search:
    """Search for the worst runs by the cross-entropy method, a third of it per aim.

    ν is held for `BLOCK` steps within its limits, e for the dwell time anywhere in its
    box, the road is a sinusoid of any wavelength and phase within the conditions at a
    constant speed. The result is a lower bound of the worst case.
    """

    loop: Loop
    claim: OutputMetric  # proved metric of e_y
    bound: float  # of the radius of its tube, which is what is claimed [m]
    data: Mapping[str, Any]  # of the data set: `ROAD_SETTINGS`, env_low and env_high
    held: int  # steps between switches of e
    steps: int  # in all

    def __call__(self, params: Params, key: Key) -> tuple[Runs, Outcome]:
        """Return the worst runs of each aim, one aim after another."""
        keys = jax.random.split(key, len(AIMS))
        worst = [self._worst(params, *of) for of in zip(AIMS, keys, strict=True)]
        return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *worst)

    def _run(self, genes: Float[Array, " gene"]) -> Runs:
        """Inputs of one run from its genes."""
        data = self.data
        nu, env, road = jnp.split(genes, self._edges[:2])
        # Saturates: the worst ν are mostly at the limits.
        nu = jnp.repeat(jnp.tanh(2.0 * nu).reshape(-1, 2), BLOCK, axis=0)[:LENGTH]
        low = jnp.asarray(data["env_low"])
        high = jnp.asarray(data["env_high"])
        env = _unit(env).reshape(-1, len(low))
        env = jnp.repeat(env, self.held, axis=0)[:LENGTH]
        fast, wave, phase, tight = _unit(road)
        (slowest, fastest) = data["speed"]
        (shortest, longest) = data["wavelengths"]
        speed = slowest + (fastest - slowest) * fast
        wavelength = shortest + (longest - shortest) * wave
        # Fast roads are gentle, as in the conditions of the corridor.
        peak = jnp.minimum(
            data["peak_curvature"], data["lateral_acceleration"] / speed**2
        )
        along = jnp.arange(LENGTH) * speed * self.loop.plant.dt
        sine = jnp.sin(2 * jnp.pi * (along / wavelength + phase))
        # Clipped: a road that is tight throughout, not only at its peaks.
        bend = peak * jnp.clip((1.0 + tight) * sine, -1.0, 1.0)
        nu = nu * self.loop.law.perturbation
        inputs = jnp.column_stack([nu, bend, jnp.full(LENGTH, speed)])
        return inputs, low + (high - low) * env

    @property
    def _edges(self) -> list[int]:
        """Where the genes of ν, e and the road end."""
        switches = -(-LENGTH // self.held)
        sizes = 2 * -(-LENGTH // BLOCK), switches * len(self.data["env_low"]), 4
        return np.cumsum(sizes).tolist()

    def _worst(self, params: Params, aim: str, key: Key) -> tuple[Runs, Outcome]:
        """The worst runs of one aim over all generations."""
        # However few steps are given, as many runs as are asked for.
        population = max(KEEP, self.steps // (len(AIMS) * GENERATIONS * LENGTH))
        outcome = partial(outcome_of, self.loop, params, self.claim)

        def generation(carry: tuple[Array, Array], key: Key) -> tuple[Any, Any]:
            mean, spread = carry
            genes = mean + spread * jax.random.normal(key, (population, *mean.shape))
            runs = jax.vmap(self._run)(genes)
            found = runs, jax.vmap(outcome)(runs)
            best = jnp.argsort(-self._score(aim, found[1]))
            elite = genes[best[: max(2, int(ELITE * population))]]
            # A floor under the spread: a search that has converged stops finding.
            after = jnp.mean(elite, axis=0), jnp.std(elite, axis=0) + 0.1
            return after, jax.tree.map(lambda leaf: leaf[best[:KEEP]], found)

        start = jnp.zeros(self._edges[-1]), jnp.ones(self._edges[-1])
        # The worst of all generations: the last one need not have it.
        _, found = jax.lax.scan(generation, start, jax.random.split(key, GENERATIONS))
        found = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), found)
        worst = jnp.argsort(-self._score(aim, found[1]))[:KEEP]
        return jax.tree.map(lambda leaf: leaf[worst], found)

    def _score(self, aim: str, outcome: Outcome) -> Array:
        """What an aim maximises."""
        if aim == "within":
            # Outside the hypothesis nothing is claimed; nearer to it ranks higher.
            inside = outcome.radius <= self.bound
            return jnp.where(inside, outcome.distance, -outcome.radius)
        return getattr(outcome, aim)


def _unit(gene: Array) -> Array:
    """Map a gene to [0, 1]; both ends are reached."""
    return jnp.clip(0.5 + 0.5 * gene, 0.0, 1.0)


def outcome_of(
    loop: Loop,
    params: Params,
    claim: OutputMetric,
    run: Runs,
    nu_filter: Callable[..., Any] | None = None,
) -> Outcome:
    """Return the outcome of one run of plant and nominal model; callers vmap.

    Both start on the path. The tube of e_y is |e_y − ê_y| ≤ L α R + ε with
    R⁺ = α R + |d|_P. `nu_filter` maps (fiber, latent, ν, index) to ν; None for none.
    """
    model = loop.model
    plant = loop.plant
    (run_inputs, envs) = run
    factor = jnp.asarray(np.linalg.cholesky(claim.metric), dtype=float)
    rest = jnp.zeros(len(plant.state_names) - 3)
    start = path_state(rest.at[2].set(run_inputs[0, 3]))
    latent = model.encode(model.fiber(params, envs[0]), start)

    def step(carry: Any, given: tuple[Array, Environment, Array]) -> tuple[Any, Any]:
        state, latent, error = carry
        inputs, env, index = given
        fiber = model.fiber(params, env)
        # The filter sees the nominal model, as in the controller.
        if nu_filter is not None:
            inputs = inputs.at[:2].set(nu_filter(fiber, latent, inputs[:2], index))
        expected = model.step(fiber, model.encode(fiber, state), inputs)
        state = plant.step(state, inputs, env)
        latent = model.step(fiber, latent, inputs)
        decoded = model.decode(fiber, latent), model.decode(fiber, expected)
        true, nominal, predicted = (x[BODY][LATERAL] for x in (state, *decoded))
        # The tube holds before its radius grows by the disturbance of this step.
        radius = claim.lipschitz * claim.alpha * error + jnp.abs(true - predicted)
        gap = model.vector(model.encode(fiber, state)) - model.vector(expected)
        error = claim.alpha * error + jnp.linalg.norm(gap @ factor)
        values = Outcome(jnp.abs(true), jnp.abs(true - nominal), radius)
        return (state, latent, error), values

    given = (run_inputs, envs, jnp.arange(len(run_inputs)))
    _, outcomes = jax.lax.scan(step, (start, latent, jnp.zeros(())), given)
    return jax.tree.map(jnp.max, outcomes)


def _attack(search: _Search, key: Key, width: float, horizon: int) -> dict[str, Any]:
    """Search for the worst runs, and repeat them with the shield, `width` wide."""
    loop = search.loop
    bound = search.bound
    found, outcome = jax.jit(search)(loop.params, key)

    def shielded(params: Params, run: Runs) -> Outcome:
        # The last inputs repeated: a preview at the end of a run has nothing further.
        ahead = jnp.arange(LENGTH)[:, None] + jnp.arange(horizon)
        roads = run[0][jnp.minimum(ahead, LENGTH - 1), 2:]

        def admissible(fiber: Any, latent: Any, wanted: Control, at: Any) -> Control:
            limit = loop.law.perturbation
            return safety_filter(
                loop.model, fiber, latent, wanted, roads[at], limit, width=width
            ).nu

        return outcome_of(loop, params, search.claim, run, admissible)

    held = jax.jit(jax.vmap(shielded, in_axes=(None, 0)))(loop.params, found)
    # The corridor is claimed only while the disturbances keep their bound
    within = np.asarray(held.radius) <= bound
    lateral, distance = (
        float(np.max(np.asarray(kept), where=within, initial=0.0))
        for kept in (held.lateral, held.distance)
    )
    if not distance / bound <= 1.0:
        raise CertificateContradicted(
            f"INTERNAL ERROR: {distance:.4f} m from the nominal model, "
            f"and the tube is {bound:.4f} m"
        )
    return {
        "steps": search.steps,
        "lateral_m": float(np.nanmax(outcome.lateral)),
        "distance_m": float(np.nanmax(outcome.distance)),
        "shielded_lateral_m": float(np.nanmax(held.lateral)),
        "kept_lateral_m": lateral,
        "kept_distance_m": distance,
        "over_corridor": lateral / (width + bound),
        "over_tube": distance / bound,
    }
