"""An attack on a corridor: the ν, roads and switches that carry a car farthest from its path and from its copy."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.core.path_frame import LATERAL, path_state
from sfkd_jax.types import BODY, Environment, Key, Model, Params
from sfkd_jax.vehicle import Vehicle

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
    """What an attack drives, without its outcome: w (drive, time, 4), e (drive, time, environment)."""

    inputs: Float[Array, "drive time 4"]
    envs: Float[Array, "drive time environment"]


class Tube(NamedTuple):
    """What is claimed of e_y: |e_y − ê_y| ≤ L α R + ε with R⁺ = α R + |d|_P, and that this radius stays below a bound.

    Attributes:
        alpha, lipschitz: α and L.
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
        radius: what the tube says of that distance, from the disturbances that there
            were [m].
    """

    lateral: Float[Array, " drive"]
    distance: Float[Array, " drive"]
    radius: Float[Array, " drive"]


class Found(NamedTuple):
    """The worst drives of each aim, (aim, drive, …), see `AIMS`."""

    drives: Drives
    outcome: Outcome


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
) -> Found:
    """Search by the cross-entropy method, a third of the steps for each of `AIMS`.

    ν is held for `BLOCK` steps within ±`perturbation`, e for the dwell time anywhere in
    E, the road is a sinusoid of any wavelength and phase of the class at a constant
    speed. What is found is a lower bound of what can happen.

    Args:
        loop: the true plant along a path.
        model, params: of the copy, folded.
        key: consumed.
        tube: what is claimed.
        env_low, env_high: E.
        perturbation: largest |ν|.
        speed, peak_curvature, wavelengths, lateral_acceleration: of the roads, see
            `datasets.drive_along_path`.
        dwell: least time between switches [s].
        steps: in all.
        length: of a drive.
        keep: worst drives returned per aim.
    """
    population = max(keep, steps // (len(AIMS) * GENERATIONS * length))
    held = max(1, round(dwell / loop.dt))
    shapes = {
        "nu": (-(-length // BLOCK), 2),
        "env": (-(-length // held), len(env_low)),
        "road": (4,),
    }
    low, high = jnp.asarray(env_low), jnp.asarray(env_high)

    def drive(genes: dict[str, Array]) -> Drives:
        nu = (
            jnp.repeat(jnp.tanh(2.0 * genes["nu"]), BLOCK, axis=0)[:length]
            * perturbation
        )
        envs = (
            low + (high - low) * jnp.repeat(_share(genes["env"]), held, axis=0)[:length]
        )
        fast, wave, phase, tight = _share(genes["road"])
        driven = speed[0] + (speed[1] - speed[0]) * fast
        wavelength = wavelengths[0] + (wavelengths[1] - wavelengths[0]) * wave
        peak = jnp.minimum(peak_curvature, lateral_acceleration / driven**2)
        along = jnp.arange(length) * driven * loop.dt
        bend = jnp.clip(
            (1.0 + tight) * jnp.sin(2 * jnp.pi * (along / wavelength + phase)),
            -1.0,
            1.0,
        )
        return Drives(
            jnp.column_stack([nu, peak * bend, jnp.full(length, driven)]), envs
        )

    outcome = jax.vmap(partial(outcome_of, loop, model, params, tube))

    def generation(
        aim: str, carry: Any, key: Key
    ) -> tuple[Any, tuple[Drives, Outcome]]:
        mean, spread = carry
        drawn = {
            name: mean[name]
            + spread[name] * jax.random.normal(part, (population, *shape))
            for part, (name, shape) in zip(
                jax.random.split(key, len(shapes)), shapes.items(), strict=True
            )
        }
        drives = jax.vmap(drive)(drawn)
        reached = outcome(drives)
        best = jnp.argsort(-_score(aim, reached, tube))[
            : max(2, int(ELITE * population))
        ]
        elite = jax.tree.map(lambda leaf: leaf[best], drawn)
        mean = jax.tree.map(lambda leaf: jnp.mean(leaf, axis=0), elite)
        spread = jax.tree.map(lambda leaf: jnp.std(leaf, axis=0) + 0.1, elite)
        worst = best[:keep]
        return (mean, spread), jax.tree.map(lambda leaf: leaf[worst], (drives, reached))

    found = []
    for aim, aim_key in zip(AIMS, jax.random.split(key, len(AIMS)), strict=True):
        start = {name: jnp.zeros(shape) for name, shape in shapes.items()}
        begin = start, jax.tree.map(jnp.ones_like, start)
        _, every = jax.lax.scan(
            partial(generation, aim), begin, jax.random.split(aim_key, GENERATIONS)
        )
        every = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), every)
        worst = jnp.argsort(-_score(aim, every[1], tube))[:keep]
        found.append(jax.tree.map(lambda leaf, worst=worst: leaf[worst], every))
    return Found(*jax.tree.map(lambda *leaves: jnp.stack(leaves), *found))


def _score(aim: str, reached: Outcome, tube: Tube) -> Array:
    """What an aim makes large; drives that break the hypothesis come last where it has to hold."""
    if aim == "within":
        return jnp.where(
            reached.radius <= tube.bound, reached.distance, -reached.radius
        )
    return getattr(reached, aim)


def outcome_of(
    loop: Vehicle,
    model: Model,
    params: Params,
    tube: Tube,
    drives: Drives,
    admit: Callable[..., Any] | None = None,
) -> Outcome:
    """One drive of the plant and of the copy beside it, both from the path; of one drive, not of a batch.

    Args:
        loop: the plant.
        model, params: of the copy, folded.
        tube: of e_y.
        drives: what is driven.
        admit: (fiber, latent, ν, index) -> ν, a filter; nothing for none.
    """
    start = path_state(
        jnp.zeros(len(loop.state_names) - 3).at[2].set(drives.inputs[0, 3])
    )
    latent = model.encode(model.fiber(params, drives.envs[0]), start)

    def step(
        carry: Any, given: tuple[Array, Environment, Array]
    ) -> tuple[Any, Outcome]:
        state, latent, error = carry
        wanted, env, index = given
        fiber = model.fiber(params, env)
        if admit is not None:
            wanted = wanted.at[:2].set(admit(fiber, latent, wanted[:2], index))
        expected = model.step(fiber, model.encode(fiber, state), wanted)
        state, latent = loop.step(state, wanted, env), model.step(fiber, latent, wanted)
        here, there, near = (
            at[BODY][LATERAL]
            for at in (
                state,
                model.decode(fiber, latent),
                model.decode(fiber, expected),
            )
        )
        radius = tube.lipschitz * tube.alpha * error + jnp.abs(here - near)
        gap = model.vector(model.encode(fiber, state)) - model.vector(expected)
        error = tube.alpha * error + jnp.linalg.norm(gap @ tube.factor)
        return (state, latent, error), Outcome(
            jnp.abs(here), jnp.abs(here - there), radius
        )

    given = (drives.inputs, drives.envs, jnp.arange(len(drives.inputs)))
    _, reached = jax.lax.scan(step, (start, latent, jnp.zeros(())), given)
    return jax.tree.map(jnp.max, reached)


def _share(gene: Array) -> Array:
    """From the line to [0, 1]; both ends are reached."""
    return jnp.clip(0.5 + 0.5 * gene, 0.0, 1.0)
