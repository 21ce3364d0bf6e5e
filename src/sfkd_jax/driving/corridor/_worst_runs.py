"""Attack on a corridor: a search for runs that leave it, repeated with the shield."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sfkd_jax.certificate import OutputMetric
from sfkd_jax.certification import CertificateContradicted
from sfkd_jax.driving.certificate import CorridorAttack
from sfkd_jax.driving.corridor._closed_loop import Loop, law_sensors
from sfkd_jax.driving.path_coordinates import (
    LATERAL,
    PATH_SPEED,
    PERTURBATION,
    REFERENCE_SPEED,
)
from sfkd_jax.driving.path_following import corridor_filter
from sfkd_jax.geometry import without_pose
from sfkd_jax.types import BODY, Control, Environment, Key, Params

BLOCK = 5
"""Number of steps for which ν is held."""
GENERATIONS = 10
AIMS = ("lateral", "distance", "within")
"""What the search maximises: the distance from the path; the distance from the nominal
model; and the latter while the hypothesis of the tube holds.
"""
LENGTH = 200
"""Number of steps of a run."""
KEEP = 20
"""Number of worst runs that are returned for every aim."""
ELITE = 0.1
"""Share of a generation that the next one is drawn around."""

Runs: TypeAlias = tuple[Array, Array]
"""Inputs w (time, 4) and environments (time, environment) of a run, or of several."""


class Outcome(NamedTuple):
    """Largest values over a run.

    Attributes:
        lateral: |e_y| [m].
        distance: |e_y − ê_y| from the nominal model with the same inputs [m].
        radius: of the tube of e_y, from the disturbances of this run [m].
    """

    lateral: Float[Array, " run"]
    distance: Float[Array, " run"]
    radius: Float[Array, " run"]


@dataclass(frozen=True, eq=False)
class WorstRuns:
    """Search for the worst runs by the cross-entropy method.

    A third of the steps is spent on each of `AIMS`. A run is described by its genes,
    which the search draws from normal distributions. ν is held for `BLOCK` steps within
    its limits, and e is held for the dwell time anywhere in its box. The road is a
    sinusoid of any wavelength and phase within the conditions, at a constant speed. The
    result is a lower bound of the worst case.

    Attributes:
        loop: that is attacked.
        claim: proved metric of e_y.
        bound: claimed radius of the tube of e_y [m].
        data: settings of the data set: those of its `DriveClass`, env_low and env_high.
        dwell_steps: number of steps between switches of e.
        steps: number of simulated steps in all.
    """

    loop: Loop
    claim: OutputMetric
    bound: float
    data: Mapping[str, Any]
    dwell_steps: int
    steps: int

    def __call__(self, params: Params, key: Key) -> tuple[Runs, Outcome]:
        """Return the worst runs of each aim, one aim after another."""
        keys = jax.random.split(key, len(AIMS))
        worst = [
            self._worst(params, aim, aim_key)
            for aim, aim_key in zip(AIMS, keys, strict=True)
        ]
        return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *worst)

    def _run(self, genes: Float[Array, " gene"]) -> Runs:
        """Return a run from its genes."""
        nu_genes, env_genes, road_genes = jnp.split(genes, self._edges[:2])
        # tanh saturates: the worst ν are mostly at the limits.
        nu = jnp.tanh(2.0 * nu_genes).reshape(-1, 2)
        nu = jnp.repeat(nu, BLOCK, axis=0)[:LENGTH]
        low = jnp.asarray(self.data["env_low"])
        high = jnp.asarray(self.data["env_high"])
        shares = _unit(env_genes).reshape(-1, len(low))
        shares = jnp.repeat(shares, self.dwell_steps, axis=0)[:LENGTH]
        curvature, speed = self._road(road_genes)
        nu = nu * self.loop.law.perturbation
        inputs = jnp.column_stack([nu, curvature, jnp.full(LENGTH, speed)])
        return inputs, low + (high - low) * shares

    def _road(
        self, genes: Float[Array, " 4"]
    ) -> tuple[Float[Array, " time"], Float[Array, ""]]:
        """Return the curvature of a road at every step, and its speed."""
        data = self.data
        speed_share, wavelength_share, phase, clipping = _unit(genes)
        slowest, fastest = data["speed"]
        shortest, longest = data["wavelengths"]
        speed = slowest + (fastest - slowest) * speed_share
        wavelength = shortest + (longest - shortest) * wavelength_share
        # A fast road has gentle curves, as the conditions of the corridor demand.
        peak = jnp.minimum(
            data["peak_curvature"], data["lateral_acceleration"] / speed**2
        )
        along = jnp.arange(LENGTH) * speed * self.loop.plant.dt
        sine = jnp.sin(2 * jnp.pi * (along / wavelength + phase))
        # A sinusoid that is clipped is at its peak for a while.
        return peak * jnp.clip((1.0 + clipping) * sine, -1.0, 1.0), speed

    @property
    def _edges(self) -> list[int]:
        """Where the genes of ν, of e and of the road end."""
        blocks = -(-LENGTH // BLOCK)
        switches = -(-LENGTH // self.dwell_steps)
        sizes = (2 * blocks, switches * len(self.data["env_low"]), 4)
        return np.cumsum(sizes).tolist()

    def _worst(self, params: Params, aim: str, key: Key) -> tuple[Runs, Outcome]:
        """Return the worst runs of one aim over all generations."""
        # At least as many runs as are returned, however few steps are allowed.
        population = max(KEEP, self.steps // (len(AIMS) * GENERATIONS * LENGTH))
        elite_size = max(2, int(ELITE * population))
        outcome = partial(outcome_of, self.loop, params, self.claim)

        def generation(carry: tuple[Array, Array], key: Key) -> tuple[Any, Any]:
            mean, spread = carry
            genes = mean + spread * jax.random.normal(key, (population, *mean.shape))
            runs = jax.vmap(self._run)(genes)
            outcomes = jax.vmap(outcome)(runs)
            order = jnp.argsort(-self._score(aim, outcomes))
            elite = genes[order[:elite_size]]
            # At least a spread of 0.1: a search that has converged finds nothing new.
            following = (jnp.mean(elite, axis=0), jnp.std(elite, axis=0) + 0.1)
            best = jax.tree.map(lambda leaf: leaf[order[:KEEP]], (runs, outcomes))
            return following, best

        start = (jnp.zeros(self._edges[-1]), jnp.ones(self._edges[-1]))
        keys = jax.random.split(key, GENERATIONS)
        _, best = jax.lax.scan(generation, start, keys)
        # Of all generations: the last one need not have the worst run.
        runs, outcomes = jax.tree.map(
            lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), best
        )
        worst = jnp.argsort(-self._score(aim, outcomes))[:KEEP]
        return jax.tree.map(lambda leaf: leaf[worst], (runs, outcomes))

    def _score(self, aim: str, outcome: Outcome) -> Array:
        """Return what an aim maximises."""
        if aim == "within":
            # Outside of the hypothesis nothing is claimed. Such runs come last, those
            # nearest to it first.
            inside = outcome.radius <= self.bound
            return jnp.where(inside, outcome.distance, -outcome.radius)
        return getattr(outcome, aim)


def _unit(genes: Array) -> Array:
    """Map genes to [0, 1]; both ends are reached."""
    return jnp.clip(0.5 + 0.5 * genes, 0.0, 1.0)


def outcome_of(
    loop: Loop,
    params: Params,
    claim: OutputMetric,
    run: Runs,
    nu_filter: Callable[..., Any] | None = None,
) -> Outcome:
    """Return the outcome of one run of plant and nominal model; callers vmap.

    Both start on the path, and the law reads the plant without noise. The tube of e_y
    is |e_y − ê_y| ≤ L α R + ε with R⁺ = α R + |d|_P.

    Args:
        loop: of plant and law.
        params: of the model.
        claim: proved metric of e_y, with α and L.
        run: inputs and environments.
        nu_filter: maps (fiber, latent, ν, index) to ν; None for no filter.
    """
    model = loop.model
    plant = loop.plant
    run_inputs, envs = run
    factor = jnp.asarray(np.linalg.cholesky(claim.metric), dtype=float)
    at_rest = jnp.zeros(len(plant.state_names) - BODY.start)
    start = without_pose(at_rest.at[PATH_SPEED].set(run_inputs[0, REFERENCE_SPEED]))
    sensors = law_sensors(loop, noisy=False)
    memory = sensors.init(start, run_inputs[0], envs[0])
    no_noise = jax.random.key(0)
    latent = model.encode(model.fiber(params, envs[0]), start)

    def step(carry: Any, at_step: tuple[Array, Environment, Array]) -> tuple[Any, Any]:
        state, latent, error, memory = carry
        inputs, env, index = at_step
        shown = plant.shown(state)
        fiber = model.fiber(params, env)
        # The filter sees the nominal model, as in the controller.
        if nu_filter is not None:
            nu = nu_filter(fiber, latent, inputs[PERTURBATION], index)
            inputs = inputs.at[PERTURBATION].set(nu)
        expected = model.step(fiber, model.encode(fiber, shown), inputs)
        nu, _, memory = sensors.read(memory, no_noise, shown, inputs, env)
        state = plant.step(state, inputs.at[PERTURBATION].set(nu), env)
        shown = plant.shown(state)
        latent = model.step(fiber, latent, inputs)
        nominal_state = model.decode(fiber, latent)
        expected_state = model.decode(fiber, expected)
        true, nominal, predicted = (
            each[BODY][LATERAL] for each in (shown, nominal_state, expected_state)
        )
        # The tube bounds the output before its radius grows by this disturbance.
        radius = claim.lipschitz * claim.alpha * error + jnp.abs(true - predicted)
        gap = model.vector(model.encode(fiber, shown)) - model.vector(expected)
        error = claim.alpha * error + jnp.linalg.norm(gap @ factor)
        values = Outcome(jnp.abs(true), jnp.abs(true - nominal), radius)
        return (state, latent, error, memory), values

    steps = (run_inputs, envs, jnp.arange(len(run_inputs)))
    carry = (plant.whole(start), latent, jnp.zeros(()), memory)
    _, outcomes = jax.lax.scan(step, carry, steps)
    return jax.tree.map(jnp.max, outcomes)


def attack_corridor(
    search: WorstRuns, key: Key, width: float, horizon: int
) -> CorridorAttack:
    """Search for the worst runs, and repeat them with the shield.

    Args:
        search: of the worst runs.
        key: consumed.
        width: of the corridor that the shield keeps the nominal model in [m].
        horizon: preview of the shield [steps].

    Raises:
        CertificateContradicted: a run leaves the tube, although its disturbances are
            within their bound.
    """
    loop = search.loop
    bound = search.bound
    runs, outcome = jax.jit(search)(loop.params, key)

    def shielded(params: Params, run: Runs) -> Outcome:
        inputs, _ = run
        # A preview beyond the end of a run repeats its last inputs.
        ahead = jnp.arange(LENGTH)[:, None] + jnp.arange(horizon)
        roads = inputs[jnp.minimum(ahead, LENGTH - 1), PERTURBATION.stop :]

        def admissible(fiber: Any, latent: Any, wanted: Control, index: Any) -> Control:
            filtered = corridor_filter(
                loop.model,
                fiber,
                latent,
                wanted,
                roads[index],
                loop.law.perturbation,
                width=width,
            )
            return filtered.nu

        return outcome_of(loop, params, search.claim, run, admissible)

    kept = jax.jit(jax.vmap(shielded, in_axes=(None, 0)))(loop.params, runs)
    # The corridor is claimed only while the disturbances are within their bound.
    within = np.asarray(kept.radius) <= bound
    lateral = _largest(kept.lateral, within)
    distance = _largest(kept.distance, within)
    if not distance / bound <= 1.0:
        raise CertificateContradicted(
            f"INTERNAL ERROR: {distance:.4f} m from the nominal model, "
            f"and the tube is {bound:.4f} m"
        )
    return CorridorAttack(
        steps=search.steps,
        lateral_m=float(np.nanmax(outcome.lateral)),
        distance_m=float(np.nanmax(outcome.distance)),
        shielded_lateral_m=float(np.nanmax(kept.lateral)),
        kept_lateral_m=lateral,
        kept_distance_m=distance,
        over_corridor=lateral / (width + bound),
        over_tube=distance / bound,
    )


def _largest(values: Array, chosen: np.ndarray) -> float:
    """Return the largest of the chosen values, or 0 if there are none."""
    return float(np.max(np.asarray(values), where=chosen, initial=0.0))
