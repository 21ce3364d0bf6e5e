"""Search for the worst runs along a corridor by the cross-entropy method."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
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
"""Far from the path; far from the nominal model; far from it while the tube's
hypothesis holds.
"""
LENGTH = 200
"""Of a run, in steps."""
KEEP = 20
"""Worst runs returned per aim."""
ELITE = 0.1
"""Part of a generation that the next one is drawn around."""

Genes = dict[str, Array]


class Runs(NamedTuple):
    """Inputs of runs.

    Attributes:
        inputs: w, (run, time, 4).
        envs: e, (run, time, environment).
    """

    inputs: Float[Array, "run time 4"]
    envs: Float[Array, "run time environment"]


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
    """Largest values over a run, (run,).

    Attributes:
        lateral: |e_y| [m].
        distance: |e_y − ê_y| from the nominal model with the same inputs [m].
        radius: of the tube, from the disturbances of this run [m].
    """

    lateral: Float[Array, " run"]
    distance: Float[Array, " run"]
    radius: Float[Array, " run"]


class WorstRuns(NamedTuple):
    """The worst runs of each aim, (aim, run, …), see `AIMS`."""

    runs: Runs
    outcome: Outcome


@dataclass(frozen=True, eq=False)
class CorridorAttack:
    """A search for the worst runs, with a third of the steps for each of `AIMS`.

    ν is held for `BLOCK` steps within ±`perturbation`, e for the dwell time anywhere in
    its box, the road is a sinusoid of any wavelength and phase within the conditions
    at a constant speed. The result is a lower bound of the worst case.

    Attributes:
        loop: the true plant along a path.
        model: the nominal model.
        tube: that is claimed.
        env_low: lower corner of the box of e.
        env_high: upper corner of the box of e.
        perturbation: largest |ν|.
        speed: range [m/s].
        peak_curvature: of the roads [1/m].
        wavelengths: range, of the roads [m].
        lateral_acceleration: largest on the roads [m/s²].
        dwell: least time between switches of e [s].
        steps: in all.
    """

    loop: Vehicle
    model: Model
    tube: Tube
    env_low: tuple[float, ...]
    env_high: tuple[float, ...]
    perturbation: Float[Array, " 2"]
    speed: tuple[float, float]
    peak_curvature: float
    wavelengths: tuple[float, float]
    lateral_acceleration: float
    dwell: float
    steps: int

    def __call__(self, params: Params, key: Key) -> WorstRuns:
        """Search with the folded parameters of the nominal model."""
        keys = jax.random.split(key, len(AIMS))
        worst = [self._worst(params, *of) for of in zip(AIMS, keys, strict=True)]
        return WorstRuns(*jax.tree.map(lambda *leaves: jnp.stack(leaves), *worst))

    @property
    def _held(self) -> int:
        """Steps between switches of e."""
        return max(1, round(self.dwell / self.loop.dt))

    @property
    def _shapes(self) -> dict[str, tuple[int, ...]]:
        """Shapes of the genes of a run."""
        return {
            "nu": (-(-LENGTH // BLOCK), 2),
            "env": (-(-LENGTH // self._held), len(self.env_low)),
            "road": (4,),
        }

    def _run(self, genes: Genes) -> Runs:
        """Inputs of one run from its genes."""
        nu = (
            # Saturates: the worst ν are mostly at the limits.
            jnp.repeat(jnp.tanh(2.0 * genes["nu"]), BLOCK, axis=0)[:LENGTH]
            * self.perturbation
        )
        low, high = jnp.asarray(self.env_low), jnp.asarray(self.env_high)
        env = jnp.repeat(_unit(genes["env"]), self._held, axis=0)[:LENGTH]
        fast, wave, phase, tight = _unit(genes["road"])
        speed = self.speed[0] + (self.speed[1] - self.speed[0]) * fast
        shortest, longest = self.wavelengths
        wavelength = shortest + (longest - shortest) * wave
        # Fast roads are gentle, as in the conditions of the corridor.
        peak = jnp.minimum(self.peak_curvature, self.lateral_acceleration / speed**2)
        along = jnp.arange(LENGTH) * speed * self.loop.dt
        sine = jnp.sin(2 * jnp.pi * (along / wavelength + phase))
        # Clipped: a road that is tight throughout, not only at its peaks.
        bend = jnp.clip((1.0 + tight) * sine, -1.0, 1.0)
        inputs = jnp.column_stack([nu, peak * bend, jnp.full(LENGTH, speed)])
        return Runs(inputs, low + (high - low) * env)

    def _worst(self, params: Params, aim: str, key: Key) -> tuple[Runs, Outcome]:
        """The worst runs of one aim over all generations."""
        # However few steps are given, as many runs as are asked for.
        population = max(KEEP, self.steps // (len(AIMS) * GENERATIONS * LENGTH))

        def outcome(runs: Runs) -> Outcome:
            return outcome_of(self.loop, self.model, params, self.tube, runs)

        def generation(
            carry: tuple[Genes, Genes], key: Key
        ) -> tuple[Any, tuple[Runs, Outcome]]:
            mean, spread = carry
            keys = jax.random.split(key, len(self._shapes))
            genes = {
                name: mean[name]
                + spread[name] * jax.random.normal(part, (population, *shape))
                for part, (name, shape) in zip(keys, self._shapes.items(), strict=True)
            }
            runs = jax.vmap(self._run)(genes)
            found = runs, jax.vmap(outcome)(runs)
            best = jnp.argsort(-_score(aim, found[1], self.tube))
            best = best[: max(2, int(ELITE * population))]
            elite = jax.tree.map(lambda leaf: leaf[best], genes)
            mean = jax.tree.map(lambda leaf: jnp.mean(leaf, axis=0), elite)
            # A floor under the spread: a search that has converged stops finding.
            spread = jax.tree.map(lambda leaf: jnp.std(leaf, axis=0) + 0.1, elite)
            worst = best[:KEEP]
            return (mean, spread), jax.tree.map(lambda leaf: leaf[worst], found)

        mean = {name: jnp.zeros(shape) for name, shape in self._shapes.items()}
        start = mean, jax.tree.map(jnp.ones_like, mean)
        # The worst of all generations: the last one need not have it.
        _, runs = jax.lax.scan(generation, start, jax.random.split(key, GENERATIONS))
        runs = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), runs)
        worst = jnp.argsort(-_score(aim, runs[1], self.tube))[:KEEP]
        return jax.tree.map(lambda leaf: leaf[worst], runs)


def _score(aim: str, outcome: Outcome, tube: Tube) -> Array:
    """What an aim maximises; runs outside the hypothesis rank last for "within"."""
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
    run: Runs,
    safety_filter: Callable[..., Any] | None = None,
) -> Outcome:
    """Return the outcome of one run of plant and nominal model; callers vmap.

    Both start on the path.

    Args:
        loop: the plant.
        model: the nominal model.
        params: of the model, folded.
        tube: of e_y.
        run: inputs of one run.
        safety_filter: (fiber, latent, ν, index) -> ν, or None for none.
    """
    rest = jnp.zeros(len(loop.state_names) - 3)
    start = path_state(rest.at[2].set(run.inputs[0, 3]))
    latent = model.encode(model.fiber(params, run.envs[0]), start)

    def step(
        carry: Any, given: tuple[Array, Environment, Array]
    ) -> tuple[Any, Outcome]:
        state, latent, error = carry
        inputs, env, index = given
        fiber = model.fiber(params, env)
        # The filter sees the nominal model, as in the controller.
        if safety_filter is not None:
            inputs = inputs.at[:2].set(safety_filter(fiber, latent, inputs[:2], index))
        expected = model.step(fiber, model.encode(fiber, state), inputs)
        state, latent = loop.step(state, inputs, env), model.step(fiber, latent, inputs)
        decoded = model.decode(fiber, latent), model.decode(fiber, expected)
        true, nominal, predicted = (x[BODY][LATERAL] for x in (state, *decoded))
        # The tube holds before its radius grows by the disturbance of this step.
        radius = tube.lipschitz * tube.alpha * error + jnp.abs(true - predicted)
        gap = model.vector(model.encode(fiber, state)) - model.vector(expected)
        error = tube.alpha * error + jnp.linalg.norm(gap @ tube.factor)
        values = Outcome(jnp.abs(true), jnp.abs(true - nominal), radius)
        return (state, latent, error), values

    given = (run.inputs, run.envs, jnp.arange(len(run.inputs)))
    _, outcomes = jax.lax.scan(step, (start, latent, jnp.zeros(())), given)
    return jax.tree.map(jnp.max, outcomes)


def _unit(gene: Array) -> Array:
    """Map a gene to [0, 1]; both ends are reached."""
    return jnp.clip(0.5 + 0.5 * gene, 0.0, 1.0)
