"""Corridor of the car from the fixed points of the model, without simulating a copy.

For constant w = (0, κ, v) and e, the step contracts to one fixed point z*(κ, v, e). Let
V_k = |z_k − z*_k|_P along a drive, Δ the distance that z* moves over a step of the
road, J that at a switch of e, U the largest |F(z*; ν) − z*|_P, and N the smallest
number of steps between two switches. Then

    V_{k+1} ≤ α V_k + |d_{k+1}|_P + Δ + U (+ J at a switch),
    |e_y,k+1| ≤ |c'z*_k + o| + L (α V_k + U) + ε_{k+1}.

α, L and P are proved. Δ, J, U and |c'z* + o| are measured on a grid of e and on steps
of roads.
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
from sfkd_jax.geometry import LATERAL, PERTURBATION
from sfkd_jax.rollout import in_batches
from sfkd_jax.types import BODY, Environment, Latent, Model, Params, State

BATCH = 500
"""Steps of roads in a batch."""
LEVELS = 5
"""Grid points for each entry of e, including both ends."""
ACCURACY = 1e-7
"""Final distance of the iteration from its fixed point, relative to the initial one."""
REPEATED = 1e-9
"""Relative tolerance of recomputed values."""
SIZES = ("centre_m", "road", "switch", "push")


class FixedPoints(NamedTuple):
    """Largest values over steps of roads and a grid of e.

    Attributes:
        centre_m: |c'z* + o| [m].
        road: Δ, in the metric P.
        switch: J, in the metric P.
        push: U, in the metric P.
        points: number of fixed points.
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
    """Measure the fixed points z* on all roads and in all environments.

    Args:
        model: a model along a path.
        params: folded parameters.
        claim: proved metric of e_y.
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
    latents, lateral, moves = _fixed_points_on_grid(
        model, params, steps, envs, start, perturbation, iterations
    )
    factor = np.linalg.cholesky(claim.metric)

    def largest(differences: Any) -> float:
        scaled = np.asarray(differences, dtype=np.float64) @ factor
        return float(np.max(np.linalg.norm(scaled, axis=-1)))

    before, after = latents[:, 0], latents[:, 1]
    return FixedPoints(
        centre_m=float(np.max(np.abs(lateral))),
        road=largest(after - before),
        switch=max(largest(before - before[:, k, None]) for k in range(len(envs))),
        push=largest(moves),
        points=lateral.size,
    )


@partial(jax.jit, static_argnums=(0, 6))
def _fixed_points_on_grid(
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
    """Return z*, its e_y, and F(z*; ν) − z* for ν at the corners of its box."""
    corners = perturbation * jnp.asarray([*product((-1.0, 1.0), repeat=2)])

    def converge(
        road: Float[Array, " 2"], env: Environment
    ) -> tuple[Array, Array, Array]:
        fiber = model.fiber(params, env)
        constant = jnp.concatenate([jnp.zeros(2), road])

        def step(latent: Latent, inputs: Array) -> Latent:
            return model.step(fiber, latent, inputs)

        latent = jax.lax.fori_loop(
            0,
            iterations,
            lambda _, latent: step(latent, constant),
            model.encode(fiber, start),
        )
        fixed = model.vector(latent)
        moves = [
            model.vector(step(latent, constant.at[PERTURBATION].set(nu))) - fixed
            for nu in corners
        ]
        return fixed, model.decode(fiber, latent)[BODY][LATERAL], jnp.stack(moves)

    each = jax.vmap(jax.vmap(converge, (None, 0)), (0, None))
    return in_batches(lambda step: each(step, envs), steps, size=BATCH)


def fixed_point_corridor(
    measured: FixedPoints,
    *,
    alpha: float,
    lipschitz: float,
    for_ever: float,
    steps_between_switches: int,
) -> dict[str, Any]:
    """Return the corridors that follow from the fixed points, for the document.

    Args:
        measured: from `fixed_points`.
        alpha: proved contraction factor in the metric of e_y.
        lipschitz: proved Lipschitz constant of e_y in that metric.
        for_ever: L α d̄/(1 − α) + ε̄ of e_y [m].
        steps_between_switches: smallest number N of steps between two switches of e.

    Returns:
        The measured values; `corridor_m` [m] with the law alone and with a planner; and
        `after_switch_m` [m], the same with switches of e.
    """
    law = measured.centre_m + for_ever
    law = law + lipschitz * alpha * measured.road / (1.0 - alpha)
    planner = law + lipschitz * measured.push / (1.0 - alpha)
    jump = lipschitz * alpha * measured.switch
    switch = jump / (1.0 - alpha**steps_between_switches)
    return {
        **measured._asdict(),
        "steps_between_switches": steps_between_switches,
        "corridor_m": {"law": law, "planner": planner},
        "after_switch_m": {"law": law + switch, "planner": planner + switch},
    }


def require_fixed_points(
    part: Mapping[str, Any], output: Mapping[str, Any], for_ever: float
) -> None:
    """Check that all corridors follow from the measured fixed points.

    Args:
        part: that part of the document.
        output: the part about e_y, whose constants have been checked.
        for_ever: calibrated tube of e_y [m].

    Raises:
        Refuted: names the first value that does not follow.
    """
    sizes = {name: part[name] for name in SIZES}
    count, points = part["steps_between_switches"], part["points"]
    counted = all(type(number) is int and number > 0 for number in (count, points))
    if not counted or not all(
        isinstance(size, float) and 0 <= size < math.inf for size in sizes.values()
    ):
        raise Refuted("corridor.fixed_points must hold sizes and positive counts")
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
                f"corridor.fixed_points.{name} does not follow from the fixed points"
            )
