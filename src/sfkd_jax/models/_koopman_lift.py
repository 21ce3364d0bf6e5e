"""The lift of the Koopman baseline and its linear predictor for each environment."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations_with_replacement
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.models._edmd import thin_plate
from sfkd_jax.types import Control, Environment, Params, Scalar, Space, State


class KoopmanFiber(NamedTuple):
    """z⁺ = A z + B u + d κ + c for one environment, in units of the lift."""

    A: Float[Array, "rank rank"]
    B: Float[Array, "rank control"]
    d: Float[Array, " rank"]
    c: Float[Array, " rank"]
    centres: Float[Array, "function coordinate"]


@dataclass(frozen=True)
class Lift:
    """The lift z = (x, rbf(ξ)) and the regressors of its increment.

        z⁺ − z = Wᵀ (rbf, m(e) ⊗ (ξ, u, κ, 1)),   x = (progress, ξ),   ξ = (e_y, e_ψ, s)

    x and ξ are scaled.

    Attributes:
        space: measured scales.
        functions: number of radial functions.
        degree: of the monomials m(e).
        lateral_range: unit of e_y [m].
        heading_range: unit of e_ψ [rad].
        curvature_range: unit of κ [1/m].
    """

    space: Space
    functions: int
    degree: int
    lateral_range: float
    heading_range: float
    curvature_range: float

    @property
    def scale(self) -> State:
        """The units of x."""
        return jnp.concatenate(
            [
                jnp.asarray([1.0, self.lateral_range, self.heading_range]),
                self.space.body_scale,
            ]
        )

    @property
    def centre(self) -> State:
        """The value of x that is scaled to 0."""
        return jnp.concatenate([jnp.zeros(3), self.space.body_mean])

    @property
    def size(self) -> int:
        """Number of entries of x."""
        return 3 + self.space.body_mean.shape[0]

    @property
    def rank(self) -> int:
        """Number of entries of z."""
        return self.size + self.functions

    @property
    def columns(self) -> int:
        """Number of entries of (ξ, u, κ, 1)."""
        return self.size - 1 + self.space.control_mean.shape[0] + 2

    @property
    def monomials(self) -> list[tuple[int, ...]]:
        """The entries of e in each monomial; the first is the empty product, 1."""
        entries = range(self.space.env_mean.shape[0])
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
        return jnp.concatenate([scaled, thin_plate(scaled[1:], centres)])

    def features(self, env: Environment) -> Float[Array, " monomial"]:
        """Return the monomials m(e)."""
        scaled = (env - self.space.env_mean) / self.space.env_scale
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
        inputs = (control - self.space.control_mean) / self.space.control_scale
        rest = jnp.stack([kappa / self.curvature_range, jnp.ones(())])
        linear = jnp.concatenate([z[1 : self.size], inputs, rest])
        return jnp.concatenate(
            [z[self.size :], jnp.outer(self.features(env), linear).ravel()]
        )

    def at(self, params: Params, env: Environment) -> KoopmanFiber:
        """Return the matrices at e."""
        of_functions, of_features = jnp.split(params["weights"], [self.functions])
        by_feature = of_features.reshape(-1, self.columns, self.rank)
        linear = jnp.tensordot(self.features(env), by_feature, axes=1).T
        states, inputs, bend, rest = jnp.split(
            linear, (self.size - 1, self.columns - 2, self.columns - 1), axis=1
        )
        A = jnp.concatenate([jnp.zeros((self.rank, 1)), states, of_functions.T], axis=1)
        B = inputs / self.space.control_scale
        c = rest[:, 0] - B @ self.space.control_mean
        return KoopmanFiber(
            jnp.eye(self.rank) + A,
            B,
            bend[:, 0] / self.curvature_range,
            c,
            params["centres"],
        )
