"""A corridor without a copy of the car: how far it is from where the model alone would come to rest.

For constant w = (0, κ, v) and e the step contracts to one fixed point z*(κ, v, e).
Along a drive V_k = |z_k − z*_k|_P obeys, with Δ the move of z* over a step of the road,
J that at a switch of e, U the largest |F(z*; ν) − z*|_P, and N the least steps between
two switches,

    V_{k+1} ≤ α V_k + |d_{k+1}|_P + Δ + U (+ J at a switch),
    |e_y,k+1| ≤ |c'z*_k + o| + L (α V_k + U) + ε_{k+1}.

α, L and P are proved. Δ, J, U and the first term are measured, on a grid of e and on
steps of roads.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from itertools import product
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sfkd_jax.certification._claims import Refuted
from sfkd_jax.certification._output_metrics import OutputMetric
from sfkd_jax.core.path_frame import LATERAL, PERTURBATION
from sfkd_jax.core.rollouts import in_batches
from sfkd_jax.types import BODY, Environment, Model, Params, State

BATCH = 500
"""Steps of roads at once."""
LEVELS = 5
"""Of every entry of e, its ends among them."""
ACCURACY = 1e-7
"""To which part of its first distance from the fixed point an iterate comes."""
REPEATED = 1e-9
"""Relative, of what is computed again from the same numbers."""
SIZES = ("centre_m", "road", "switch", "push")


class FixedPoints(NamedTuple):
    """Largest values over a class of roads and a grid of e.

    Attributes:
        centre_m: |c'z* + o| [m].
        road: Δ.
        switch: J.
        push: U; all three in the metric P.
        points: how many fixed points were looked at.
    """

    centre_m: float
    road: float
    switch: float
    push: float
    points: int


def fixed_points(
    model: Model,
    params: Params,
    claim: OutputMetric,
    steps: Float[Array, "step 2 2"],
    *,
    start: State,
    env_box: Sequence[Sequence[float]],
    perturbation: Float[Array, " 2"],
) -> FixedPoints:
    """Where the model comes to rest on every road and in every environment, and how far that moves.

    Args:
        model: along a path.
        params: folded.
        claim: proved of e_y.
        steps: (κ [1/m], v_ref [m/s]) before and after a step of a road.
        start: any path state.
        env_box: lower and upper corner of E.
        perturbation: largest |ν|.
    """
    levels = [
        np.linspace(low, high, LEVELS) for low, high in zip(*env_box, strict=True)
    ]
    envs = jnp.asarray([*product(*levels)], dtype=float)
    iterations = math.ceil(math.log(ACCURACY) / math.log(claim.alpha))
    latents, lateral, pushed = _rests(
        model, params, steps, envs, start, perturbation, iterations
    )
    factor = np.linalg.cholesky(claim.metric)

    def size(gaps: Any) -> float:
        return float(
            np.max(np.linalg.norm(np.asarray(gaps, dtype=np.float64) @ factor, axis=-1))
        )

    before, after = latents[:, 0], latents[:, 1]
    return FixedPoints(
        centre_m=float(np.max(np.abs(lateral))),
        road=size(after - before),
        switch=max(size(before - before[:, index, None]) for index in range(len(envs))),
        push=size(pushed),
        points=lateral.size,
    )


@partial(jax.jit, static_argnums=(0, 6))
def _rests(
    model: Model,
    params: Params,
    steps: Float[Array, "step 2 2"],
    envs: Float[Array, "grid environment"],
    start: State,
    perturbation: Float[Array, " 2"],
    iterations: int,
) -> tuple[
    Float[Array, "step 2 grid rank"],
    Float[Array, "step 2 grid"],
    Float[Array, "step 2 grid corner rank"],
]:
    """z* and its e_y, and F(z*; ν) − z* for ν at the corners of its box."""
    corners = perturbation * jnp.asarray([*product((-1.0, 1.0), repeat=2)])

    def rest(road: Float[Array, " 2"], env: Environment) -> tuple[Array, Array, Array]:
        fiber = model.fiber(params, env)
        alone = jnp.concatenate([jnp.zeros(2), road])
        latent = jax.lax.fori_loop(
            0,
            iterations,
            lambda _, latent: model.step(fiber, latent, alone),
            model.encode(fiber, start),
        )
        known = model.vector(latent)
        pushed = [
            model.vector(model.step(fiber, latent, alone.at[PERTURBATION].set(nu)))
            - known
            for nu in corners
        ]
        return known, model.decode(fiber, latent)[BODY][LATERAL], jnp.stack(pushed)

    each = jax.vmap(jax.vmap(rest, (None, 0)), (0, None))
    return in_batches(lambda step: each(step, envs), steps, size=BATCH)


def fixed_point_corridor(
    found: FixedPoints,
    *,
    alpha: float,
    lipschitz: float,
    for_ever: float,
    steps_between_switches: int,
) -> dict[str, Any]:
    """The document's part: what was measured, and the corridors that follow from it [m].

    Args:
        alpha, lipschitz: proved of e_y.
        for_ever: L α d̄/(1 − α) + ε̄ of it [m].
    """
    law = found.centre_m + for_ever + lipschitz * alpha * found.road / (1.0 - alpha)
    planner = law + lipschitz * found.push / (1.0 - alpha)
    switch = lipschitz * alpha * found.switch / (1.0 - alpha**steps_between_switches)
    return {
        **found._asdict(),
        "steps_between_switches": steps_between_switches,
        "corridor_m": {"law": law, "planner": planner},
        "after_switch_m": {"law": law + switch, "planner": planner + switch},
    }


def require_fixed_points(
    part: Mapping[str, Any], output: Mapping[str, Any], for_ever: float
) -> None:
    """Check that both corridors follow from what was measured.

    Args:
        part: of the document.
        output: e_y's constants, proved.
        for_ever: its calibrated tube [m].

    Raises:
        Refuted: naming what does not follow.
    """
    sizes = {name: part[name] for name in SIZES}
    count, points = part["steps_between_switches"], part["points"]
    whole = all(type(number) is int and number > 0 for number in (count, points))
    if not whole or not all(
        isinstance(size, float) and 0 <= size < math.inf for size in sizes.values()
    ):
        raise Refuted("corridor.fixed_points holds what is no size or no count")
    constants = {name: output[name] for name in ("alpha", "lipschitz")}
    expected = fixed_point_corridor(
        FixedPoints(**sizes, points=points),
        **constants,
        for_ever=for_ever,
        steps_between_switches=count,
    )
    for name in ("corridor_m", "after_switch_m"):
        stated = part[name]
        if stated.keys() != expected[name].keys() or not all(
            math.isclose(stated[key], value, rel_tol=REPEATED)
            for key, value in expected[name].items()
        ):
            raise Refuted(
                f"corridor.fixed_points.{name} does not follow from what was measured"
            )
