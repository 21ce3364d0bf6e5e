"""Search for the worst drives along a corridor by the cross-entropy method."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.geometry import LATERAL, path_state
from sfkd_jax.plants import Vehicle
from sfkd_jax.types import BODY, Environment, Key, Model, Params

BLOCK = 5
"""Steps for which the attack holds ν."""
GENERATIONS = 10
AIMS = ("lateral", "distance", "within")
"""Far from the path; far from the copy; far from the copy while the tube's hypothesis
holds.
"""
ELITE = 0.1
"""Share of a generation that the next one is drawn around."""


class Drives(NamedTuple):
    """Inputs of drives.

    Attributes:
        inputs: w, (drive, time, 4).
        envs: e, (drive, time, environment).
    """

    inputs: Float[Array, "drive time 4"]
    envs: Float[Array, "drive time environment"]


class Tube(NamedTuple):
    """The claimed tube |e_y − ê_y| ≤ L α R + ε with R⁺ = α R + |d|_P.

    The radius, the right-hand side, is claimed to stay below a bound.

    Attributes:
        alpha: α.
        lipschitz: L.
        factor: of P = factor factor'.
        bound: of the radius [m].
    """

    alpha: float
    lipschitz: float
    factor: Float[Array, "rank rank"]
    bound: float


class Outcome(NamedTuple):
    """Largest values of a drive, (drive,).

    Attributes:
        lateral: |e_y| [m].
        distance: |e_y − ê_y| from a copy with the same inputs [m].
        radius: of the tube, from the disturbances of this drive [m].
    """

    lateral: Float[Array, " drive"]
    distance: Float[Array, " drive"]
    radius: Float[Array, " drive"]


class WorstDrives(NamedTuple):
    """The worst drives of each aim, (aim, drive, …), see `AIMS`."""

    drives: Drives
    outcome: Outcome


class _Roads(NamedTuple):
    """Ranges of roads and environments, as in `attack_corridor`."""

    dt: float
    env_low: Float[Array, " environment"]
    env_high: Float[Array, " environment"]
    perturbation: Float[Array, " 2"]
    speed: tuple[float, float]
    peak_curvature: float
    wavelengths: tuple[float, float]
    lateral_acceleration: float


class _Search(NamedTuple):
    """The settings of one search.

    Attributes:
        tube: that is attacked.
        shapes: of the genes by name.
        population: drives per generation.
        keep: worst drives kept per generation.
        drive: genes -> inputs of a drive.
        outcome: a batch of drives -> their outcomes.
    """

    tube: Tube
    shapes: dict[str, tuple[int, ...]]
    population: int
    keep: int
    drive: Callable[[dict[str, Array]], Drives]
    outcome: Callable[[Drives], Outcome]


def attack_corridor(
    loop: Vehicle,
    model: Model,
    params: Params,
    key: Key,
    tube: Tube,
    *,
    env_low: tuple[float, ...],
    env_high: tuple[float, ...],
    perturbation: Float[Array, " 2"],
    speed: tuple[float, float],
    peak_curvature: float,
    wavelengths: tuple[float, float],
    lateral_acceleration: float,
    dwell: float,
    steps: int = 1_000_000,
    length: int = 200,
    keep: int = 20,
) -> WorstDrives:
    """Search for the worst drives, with a third of the steps for each of `AIMS`.

    ν is held for `BLOCK` steps within ±`perturbation`, e for the dwell time anywhere in
    E, the road is a sinusoid of any wavelength and phase of the class at a constant
    speed. The result is a lower bound of the worst case.

    Args:
        loop: the true plant along a path.
        model: of the copy.
        params: of the copy, folded.
        key: consumed.
        tube: that is claimed.
        env_low: lower corner of E.
        env_high: upper corner of E.
        perturbation: largest |ν|.
        speed: range, see `datasets.drive_along_path`.
        peak_curvature: of the roads.
        wavelengths: of the roads.
        lateral_acceleration: largest on the roads.
        dwell: least time between switches [s].
        steps: in all.
        length: of a drive.
        keep: worst drives returned per aim.
    """
    held = max(1, round(dwell / loop.dt))
    roads = _Roads(
        dt=loop.dt,
        env_low=jnp.asarray(env_low),
        env_high=jnp.asarray(env_high),
        perturbation=perturbation,
        speed=speed,
        peak_curvature=peak_curvature,
        wavelengths=wavelengths,
        lateral_acceleration=lateral_acceleration,
    )
    search = _Search(
        tube=tube,
        shapes={
            "nu": (-(-length // BLOCK), 2),
            "env": (-(-length // held), len(env_low)),
            "road": (4,),
        },
        population=max(keep, steps // (len(AIMS) * GENERATIONS * length)),
        keep=keep,
        drive=partial(_drive, roads, length=length, held=held),
        outcome=jax.vmap(partial(outcome_of, loop, model, params, tube)),
    )
    keys = jax.random.split(key, len(AIMS))
    worst = [_attack(search, aim, k) for aim, k in zip(AIMS, keys, strict=True)]
    return WorstDrives(*jax.tree.map(lambda *leaves: jnp.stack(leaves), *worst))


def _drive(roads: _Roads, genes: dict[str, Array], *, length: int, held: int) -> Drives:
    """Inputs of one drive from its genes."""
    nu = (
        # Saturates: the worst ν are mostly at the limits.
        jnp.repeat(jnp.tanh(2.0 * genes["nu"]), BLOCK, axis=0)[:length]
        * roads.perturbation
    )
    low, high = roads.env_low, roads.env_high
    envs = low + (high - low) * jnp.repeat(_share(genes["env"]), held, axis=0)[:length]
    fast, wave, phase, tight = _share(genes["road"])
    speed = roads.speed[0] + (roads.speed[1] - roads.speed[0]) * fast
    shortest, longest = roads.wavelengths
    wavelength = shortest + (longest - shortest) * wave
    # Fast roads are gentle, as in the conditions of the corridor.
    peak = jnp.minimum(roads.peak_curvature, roads.lateral_acceleration / speed**2)
    along = jnp.arange(length) * speed * roads.dt
    bend = jnp.clip(
        (1.0 + tight) * jnp.sin(2 * jnp.pi * (along / wavelength + phase)), -1.0, 1.0
    )
    return Drives(jnp.column_stack([nu, peak * bend, jnp.full(length, speed)]), envs)


def _attack(search: _Search, aim: str, key: Key) -> tuple[Drives, Outcome]:
    """The worst drives of one aim over all generations."""
    mean = {name: jnp.zeros(shape) for name, shape in search.shapes.items()}
    start = mean, jax.tree.map(jnp.ones_like, mean)
    keys = jax.random.split(key, GENERATIONS)
    _, drives = jax.lax.scan(partial(_generation, search, aim), start, keys)
    drives = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), drives)
    worst = jnp.argsort(-_score(aim, drives[1], search.tube))[: search.keep]
    return jax.tree.map(lambda leaf: leaf[worst], drives)


def _generation(
    search: _Search, aim: str, carry: Any, key: Key
) -> tuple[Any, tuple[Drives, Outcome]]:
    """Draw a generation and return the next distribution and the worst drives."""
    mean, spread = carry
    genes = {
        name: mean[name]
        + spread[name] * jax.random.normal(part, (search.population, *shape))
        for part, (name, shape) in zip(
            jax.random.split(key, len(search.shapes)),
            search.shapes.items(),
            strict=True,
        )
    }
    drives = jax.vmap(search.drive)(genes)
    outcome = search.outcome(drives)
    order = jnp.argsort(-_score(aim, outcome, search.tube))
    best = order[: max(2, int(ELITE * search.population))]
    elite = jax.tree.map(lambda leaf: leaf[best], genes)
    mean = jax.tree.map(lambda leaf: jnp.mean(leaf, axis=0), elite)
    # A floor under the spread: a search that has converged stops finding.
    spread = jax.tree.map(lambda leaf: jnp.std(leaf, axis=0) + 0.1, elite)
    worst = best[: search.keep]
    return (mean, spread), jax.tree.map(lambda leaf: leaf[worst], (drives, outcome))


def _score(aim: str, outcome: Outcome, tube: Tube) -> Array:
    """What an aim maximises; drives outside the hypothesis rank last for "within"."""
    if aim == "within":
        # Outside the hypothesis nothing is claimed; nearer to it ranks higher.
        return jnp.where(
            outcome.radius <= tube.bound, outcome.distance, -outcome.radius
        )
    return getattr(outcome, aim)


def outcome_of(
    loop: Vehicle,
    model: Model,
    params: Params,
    tube: Tube,
    drives: Drives,
    safety_filter: Callable[..., Any] | None = None,
) -> Outcome:
    """Return the outcome of one drive of the plant beside its copy; callers vmap.

    Both start on the path.

    Args:
        loop: the plant.
        model: of the copy.
        params: of the copy, folded.
        tube: of e_y.
        drives: inputs of one drive.
        safety_filter: (fiber, latent, ν, index) -> ν, or None for none.
    """
    start = path_state(
        jnp.zeros(len(loop.state_names) - 3).at[2].set(drives.inputs[0, 3])
    )
    latent = model.encode(model.fiber(params, drives.envs[0]), start)

    def step(
        carry: Any, given: tuple[Array, Environment, Array]
    ) -> tuple[Any, Outcome]:
        state, latent, error = carry
        inputs, env, index = given
        fiber = model.fiber(params, env)
        if safety_filter is not None:
            inputs = inputs.at[:2].set(safety_filter(fiber, latent, inputs[:2], index))
        expected = model.step(fiber, model.encode(fiber, state), inputs)
        state, latent = loop.step(state, inputs, env), model.step(fiber, latent, inputs)
        decoded = model.decode(fiber, latent), model.decode(fiber, expected)
        true, copy, predicted = (x[BODY][LATERAL] for x in (state, *decoded))
        radius = tube.lipschitz * tube.alpha * error + jnp.abs(true - predicted)
        gap = model.vector(model.encode(fiber, state)) - model.vector(expected)
        error = tube.alpha * error + jnp.linalg.norm(gap @ tube.factor)
        return (state, latent, error), Outcome(
            jnp.abs(true), jnp.abs(true - copy), radius
        )

    given = (drives.inputs, drives.envs, jnp.arange(len(drives.inputs)))
    _, outcomes = jax.lax.scan(step, (start, latent, jnp.zeros(())), given)
    return jax.tree.map(jnp.max, outcomes)


def _share(gene: Array) -> Array:
    """Map a gene to [0, 1]; both ends are reached."""
    return jnp.clip(0.5 + 0.5 * gene, 0.0, 1.0)
