"""The lift of the Koopman baseline: thin-plate functions of path coordinates."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations_with_replacement
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.types import Control, Environment, Key, Params, Scalar, Space, State


class KoopmanFiber(NamedTuple):
    """z⁺ = A z + B u + d κ + c for one environment.

    z is in units of the lift; u and κ are in physical units.
    """

    A: Float[Array, "rank rank"]
    B: Float[Array, "rank control"]
    d: Float[Array, " rank"]
    c: Float[Array, " rank"]
    centres: Float[Array, "function coordinate"]


class LinearPredictor(NamedTuple):
    """A predictor of the state along a path that is linear in a lift, for one e.

        z⁺ = A z + B u + d κ + c,   x = C z + o,   z = lift(x)

    x is a `State` whose pose is (progress [m], distance left of the path [m], yaw
    relative to it [rad]); κ is the path's curvature [1/m].
    """

    lift: Callable[[State], Float[Array, " rank"]]
    A: Float[Array, "rank rank"]
    B: Float[Array, "rank control"]
    d: Float[Array, " rank"]
    c: Float[Array, " rank"]
    C: Float[Array, "state rank"]
    o: State


@dataclass(eq=False)
class Lift:
    """The lift z = (x, rbf(ξ)) and the regressors of its increment.

        z⁺ − z = Wᵀ (rbf, m(e) ⊗ (ξ, u, κ, 1)),   x = (progress, ξ),   ξ = (e_y, e_ψ, s)

    x and ξ are scaled. `degree` is that of m(e); the other fields are the arguments of
    `koopman`.
    """

    space: Space
    functions: int
    degree: int
    lateral_range: float
    heading_range: float
    curvature_range: float

    def __post_init__(self) -> None:
        """Derive units, centre and sizes."""
        path = jnp.asarray([1.0, self.lateral_range, self.heading_range])
        # The units of x, and the x that is scaled to 0.
        self.scale = jnp.concatenate([path, self.space.body_scale])
        self.centre = jnp.concatenate([jnp.zeros(3), self.space.body_mean])
        # The numbers of entries of x, of z and of (ξ, u, κ, 1).
        self.size = 3 + self.space.body_mean.shape[0]
        self.rank = self.size + self.functions
        self.columns = self.size - 1 + self.space.control_mean.shape[0] + 2

    def random_centres(self, key: Key) -> Float[Array, "function coordinate"]:
        """Draw centres uniformly from the box [-1, 1] of ξ."""
        return jax.random.uniform(key, (self.functions, self.size - 1), minval=-1.0)

    @property
    def monomials(self) -> list[tuple[int, ...]]:
        """The entries of e in each monomial; the first is the empty product, 1."""
        entries = range(self.space.env_mean.shape[0])
        # Unordered, or e_1 e_2 and e_2 e_1 would give equal regressors.
        return [
            term
            for degree in range(self.degree + 1)
            for term in combinations_with_replacement(entries, degree)
        ]

    def __call__(
        self, centres: Float[Array, "function coordinate"], path: State
    ) -> Float[Array, " rank"]:
        """Return z of a state along the path, which is in physical units."""
        scaled = (path - self.centre) / self.scale
        # The progress is unbounded and must not enter the radial functions.
        return jnp.concatenate([scaled, thin_plate(scaled[1:], centres)])

    def features(self, env: Environment) -> Float[Array, " monomial"]:
        """Return the monomials m(e)."""
        scaled = self.space.scaled_env(env)
        return jnp.stack(
            [jnp.prod(scaled[jnp.asarray(term, int)]) for term in self.monomials]
        )

    def regressors(
        self,
        z: Float[Array, " rank"],
        control: Control,
        env: Environment,
        kappa: Scalar,
    ) -> Float[Array, " regressor"]:
        """Return (rbf, m(e) ⊗ (ξ, u, κ, 1))."""
        inputs = self.space.scaled_control(control)
        rest = jnp.stack([kappa / self.curvature_range, jnp.ones(())])
        linear = jnp.concatenate([z[1 : self.size], inputs, rest])
        # ξ is a part of z, so the same code serves the regression and predictions in z.
        return jnp.concatenate(
            [z[self.size :], jnp.outer(self.features(env), linear).ravel()]
        )

    def at(self, params: Params, env: Environment) -> KoopmanFiber:
        """Return the matrices at e."""
        of_functions, of_features = jnp.split(params["weights"], [self.functions])
        by_feature = of_features.reshape(-1, self.columns, self.rank)
        linear = jnp.tensordot(self.features(env), by_feature, axes=1).T
        of_state, of_control, of_curvature, constant = jnp.split(
            linear, (self.size - 1, self.columns - 2, self.columns - 1), axis=1
        )
        # The column of the progress is 0: the place of a car on its path does not
        # matter.
        of_progress = jnp.zeros((self.rank, 1))
        A = jnp.concatenate([of_progress, of_state, of_functions.T], axis=1)
        # With the scales of u, so that a controller multiplies physical controls.
        B = of_control / self.space.control_scale
        return KoopmanFiber(
            # The regression is of the increment z⁺ − z; the identity makes it z⁺.
            A=jnp.eye(self.rank) + A,
            B=B,
            d=of_curvature[:, 0] / self.curvature_range,
            c=constant[:, 0] - B @ self.space.control_mean,
            centres=params["centres"],
        )


def thin_plate(
    point: Float[Array, " n"], centres: Float[Array, "function n"]
) -> Float[Array, " function"]:
    """Return r² log r of the distances r to every centre; 0 at r = 0."""
    squares = jnp.sum((point - centres) ** 2, axis=1)
    # Both branches need a finite logarithm, or the gradient at a centre is NaN.
    positive = squares > 0
    logarithms = jnp.log(jnp.where(positive, squares, 1.0))
    return jnp.where(positive, 0.5 * squares * logarithms, 0.0)
