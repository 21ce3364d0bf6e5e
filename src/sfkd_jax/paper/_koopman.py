"""The Koopman baseline: a linear predictor in a lift of coordinates along a path."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.geometry import between, compose
from sfkd_jax.paper._edmd import identify
from sfkd_jax.paper._lift import KoopmanFiber, Lift, LinearPredictor
from sfkd_jax.ranges import AtLeastTwo, NonNegativeInt, Positive
from sfkd_jax.types import (
    POSE,
    Control,
    Environment,
    Fitting,
    Key,
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


@dataclass(frozen=True, eq=False)
class KoopmanModel:
    """The functions of `Model` for a linear predictor in a lift.

    Without a path, the state is measured along the straight path from its first pose.

    Attributes:
        lift: of states along a path.
    """

    lift: Lift

    def init(self, key: Key) -> Params:
        """Draw the centres; before `identify` the model predicts that nothing moves."""
        lift = self.lift
        regressors = lift.functions + len(lift.monomials) * lift.columns
        return {
            "centres": lift.random_centres(key),
            "weights": jnp.zeros((regressors, lift.rank)),
        }

    def fiber(self, params: Params, env: Environment) -> KoopmanFiber:
        """Return the matrices at e."""
        return self.lift.at(params, env)

    def encode(self, fiber: KoopmanFiber, state: State) -> KoopmanLatent:
        """Return the lift of a state, along the straight path that begins there."""
        size = self.lift.size
        if state.shape != (size,):
            raise ValueError(f"state must have shape ({size},), got {state.shape}")
        path_state = state.at[POSE].set(0.0)
        return KoopmanLatent(state[POSE], self.lift(fiber.centres, path_state))

    def step(
        self, fiber: KoopmanFiber, latent: KoopmanLatent, control: Control
    ) -> KoopmanLatent:
        """Advance the lift by one sampling period."""
        # There is no d κ, because the path is straight.
        return latent._replace(z=fiber.A @ latent.z + fiber.B @ control + fiber.c)

    def decode(self, fiber: KoopmanFiber, latent: KoopmanLatent) -> State:
        """Return the state of a latent."""
        lift = self.lift
        path_state = lift.centre + lift.scale * latent.z[: lift.size]
        return path_state.at[POSE].set(compose(latent.frame, path_state[POSE]))

    def transport(
        self, fiber: KoopmanFiber, fiber_next: KoopmanFiber, latent: KoopmanLatent
    ) -> KoopmanLatent:
        """Return the same latent: all environments share the lift."""
        return latent

    def observe(
        self, fiber: KoopmanFiber, latent: KoopmanLatent, state: State
    ) -> KoopmanLatent:
        """Return the lift of a state, along the path that the rollout began on."""
        path_state = state.at[POSE].set(between(latent.frame, state[POSE]))
        return latent._replace(z=self.lift(fiber.centres, path_state))

    def vector(self, latent: KoopmanLatent) -> Float[Array, " coordinate"]:
        """Return the scaled ξ, without the progress, on which no entry of z depends."""
        return latent.z[1 : self.lift.size]

    def linear(self, fiber: KoopmanFiber) -> LinearPredictor:
        """Return the linear predictor at the e of a fiber."""
        lift = self.lift
        return LinearPredictor(
            lift=partial(lift, fiber.centres),
            A=fiber.A,
            B=fiber.B,
            d=fiber.d,
            c=fiber.c,
            # The state is the first part of z, so the read-out is exact.
            C=jnp.eye(lift.size, lift.rank) * lift.scale[:, None],
            o=lift.centre,
        )


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
    to a degree. At every e the predictor is linear in z, u and the path's curvature κ.
    As in the original, it has no products of state and control. A model that ignores e
    has one (A, B) for all e, like the original; matrices that vary with e are an
    extension.

    `identify` regresses z⁺ − z on pairs of logged states. Each pair is relative to a
    circle of random curvature and offset, since the motion of a car does not depend on
    the path it is on. The ridge is the one that predicts validation runs best over a
    horizon; the original has no ridge. `identify` is pure and may be compiled. A
    `Model` has no path, so its rollout follows a straight path from its first pose.

    Args:
        space: measured scales, which fix all sizes.
        functions: number of thin-plate functions.
        environment: whether e is used.
        environment_degree: largest degree of a monomial of m(e).
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
    model = KoopmanModel(lift)
    fit = partial(
        identify, lift, ridges=ridges, transitions=transitions, horizon=horizon
    )
    return Model(
        init=model.init,
        fiber=model.fiber,
        encode=model.encode,
        step=model.step,
        decode=model.decode,
        transport=model.transport,
        observe=model.observe,
        vector=model.vector,
        fitting=Fitting(identify=fit),
        structure=Structure(linear=model.linear),
    )
