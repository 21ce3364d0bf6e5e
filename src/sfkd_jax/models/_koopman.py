"""The Koopman baseline: EDMD with thin-plate functions in coordinates along a path."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.geometry import between, compose
from sfkd_jax.models._edmd import KoopmanFiber, Lift, identify, random_centres
from sfkd_jax.ranges import AtLeastTwo, NonNegativeInt, Positive
from sfkd_jax.types import (
    POSE,
    Control,
    Fitting,
    Key,
    LinearPredictor,
    Model,
    Params,
    Pose,
    Space,
    State,
    Structure,
)


class KoopmanLatent(NamedTuple):
    """The lift of a state, and the start of the straight path it is measured along."""

    frame: Pose
    z: Float[Array, " rank"]


def koopman(
    space: Space,
    *,
    functions: int = 100,
    environment: bool = True,
    environment_degree: NonNegativeInt = 2,
    ridges: tuple[Positive, ...] = (1e-6, 1e-5, 1e-4, 1e-3),
    lateral_range: Positive = 4.0,
    heading_range: Positive = 0.5,
    curvature_range: Positive = 0.03,
    transitions: int = 100_000,
    horizon: AtLeastTwo = 20,
) -> Model:
    """EDMD in path coordinates x = (progress, e_y, e_ψ, s), linear in a lift of x.

        z = (x, |ξ − c_i|² log |ξ − c_i|),   ξ = (e_y, e_ψ, s) scaled to [-1, 1],
        z⁺ = z + Wᵀ (rbf, m(e) ⊗ (ξ, u, κ, 1)) = A(e) z + B(e) u + d(e) κ + c(e),
        x = C z + o,   c_i uniform in the box of ξ

    The lift holds the state itself. m(e) are the monomials of the scaled environment up
    to a degree. At every e the predictor is linear in z, u and the path's curvature κ;
    no products of state and control enter, as in the original. A model that ignores e
    has the original's one (A, B) for all e; matrices that vary with e are an extension.

    `identify` regresses z⁺ − z on pairs of logged states, each relative to a circle of
    random curvature and offset (how a car moves does not depend on the path it is on),
    with the ridge that predicts validation runs best over a horizon; the original has
    no ridge. It is pure and may be compiled. A `Model` is given no path, so its rollout
    follows a straight path from its initial pose.

    Args:
        space: measured scales; fixes all sizes.
        functions: number of thin-plate functions.
        environment: whether e is used.
        environment_degree: of m(e).
        ridges: to choose from, for columns scaled to mean square 1, per sample.
        lateral_range: largest |e_y| of the pairs [m]; also its scale.
        heading_range: largest |e_ψ| of the pairs [rad]; also its scale.
        curvature_range: largest |κ| of the pairs [1/m]; also its scale.
        transitions: largest number of pairs in the regression.
        horizon: of the predictions that choose the ridge, steps.

    Source: Korda and Mezić (2018), sections 4 to 6, and the authors' code.
    """
    # Degree 0 leaves the monomial 1 alone: one (A, B) for all e, as in the original.
    degree = environment_degree if environment else 0
    lift = Lift(space, functions, degree, lateral_range, heading_range, curvature_range)
    regressors = functions + len(lift.monomials) * lift.columns

    options = {"ridges": ridges, "transitions": transitions, "horizon": horizon}

    def init(key: Key) -> Params:
        return {
            "centres": random_centres(lift, key),
            # Zero increments: before `identify` the model predicts that nothing moves.
            "weights": jnp.zeros((regressors, lift.rank)),
        }

    def observe(
        fiber: KoopmanFiber, latent: KoopmanLatent, state: State
    ) -> KoopmanLatent:
        # Along the straight path that the rollout began on, hence in its frame.
        path = state.at[POSE].set(between(latent.frame, state[POSE]))
        return latent._replace(z=lift(fiber.centres, path))

    def encode(fiber: KoopmanFiber, state: State) -> KoopmanLatent:
        if state.shape != (lift.size,):
            raise ValueError(f"state must have shape ({lift.size},), got {state.shape}")
        # The frame takes the pose, so that the path begins where the car is.
        return KoopmanLatent(state[POSE], lift(fiber.centres, state.at[POSE].set(0.0)))

    def step(
        fiber: KoopmanFiber, latent: KoopmanLatent, control: Control
    ) -> KoopmanLatent:
        # No d κ: the path of a model without a path is straight, κ = 0.
        return latent._replace(z=fiber.A @ latent.z + fiber.B @ control + fiber.c)

    def decode(fiber: KoopmanFiber, latent: KoopmanLatent) -> State:
        path = lift.centre + lift.scale * latent.z[: lift.size]
        return path.at[POSE].set(compose(latent.frame, path[POSE]))

    def linear(fiber: KoopmanFiber) -> LinearPredictor:
        # The state is the first part of z, so that the read-out is exact.
        readout = jnp.eye(lift.size, lift.rank) * lift.scale[:, None]
        up = partial(lift, fiber.centres)
        return LinearPredictor(
            up, fiber.A, fiber.B, fiber.d, fiber.c, readout, lift.centre
        )

    return Model(
        init=init,
        fiber=lift.at,
        encode=encode,
        step=step,
        decode=decode,
        # All environments share the lift, thus z means the same in each of them.
        transport=lambda fiber, fiber_next, latent: latent,
        observe=observe,
        # Without the progress, which no other entry of z depends on.
        vector=lambda latent: latent.z[1 : lift.size],
        fitting=Fitting(identify=partial(identify, lift, **options)),
        structure=Structure(linear=linear),
    )
