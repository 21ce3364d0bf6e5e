"""The Koopman baseline: EDMD with thin-plate functions in coordinates along a path."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from itertools import combinations_with_replacement
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float

from sfkd_jax.geometry import between, circle_errors, compose
from sfkd_jax.ranges import AtLeastTwo, NonNegativeInt, Positive
from sfkd_jax.types import (
    BODY,
    POSE,
    Control,
    Environment,
    Fitting,
    Key,
    LinearPredictor,
    Model,
    Params,
    Pose,
    Scalar,
    Space,
    State,
    Structure,
    Trajectory,
)

STRAIGHT = 1e-12
"""Smallest curvature [1/m], so that nothing divides by 0."""
VALIDATION_SHARE = 0.1
"""Share of the ranges that the validation predictions use: a controller keeps the car
near its path.
"""


class KoopmanFiber(NamedTuple):
    """z⁺ = A z + B u + d κ + c for one environment, in units of the lift."""

    A: Float[Array, "rank rank"]
    B: Float[Array, "rank control"]
    d: Float[Array, " rank"]
    c: Float[Array, " rank"]
    centres: Float[Array, "function coordinate"]


class KoopmanLatent(NamedTuple):
    """The lift of a state, and the start of the straight path it is measured along."""

    frame: Pose
    z: Float[Array, " rank"]


@dataclass(eq=False)
class Lift:
    """The lift z = (x, rbf(ξ)) and the regressors of its increment.

        z⁺ − z = Wᵀ (rbf, m(e) ⊗ (ξ, u, κ, 1)),   x = (progress, ξ),   ξ = (e_y, e_ψ, s)

    x and ξ are scaled; `degree` is that of m(e), other fields are as in `koopman`.
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
        # The units of x, and the value of x that is scaled to 0.
        self.scale = jnp.concatenate([path, self.space.body_scale])
        self.centre = jnp.concatenate([jnp.zeros(3), self.space.body_mean])
        # Entries of x, of z and of (ξ, u, κ, 1).
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
        # With replacement but unordered: e_1 e_2 twice would give equal regressors.
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
        # Of ξ alone: the progress is unbounded and must not enter the radial functions.
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
        # ξ is read off z: one code for the regression and for predictions in z.
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
        # No column for the progress: where on the path a car is does not matter.
        A = jnp.concatenate([jnp.zeros((self.rank, 1)), states, of_functions.T], axis=1)
        # Scales of u folded in, so that a controller multiplies physical controls.
        B = inputs / self.space.control_scale
        return KoopmanFiber(
            # The regression is of the increment z⁺ − z; the identity makes it z⁺.
            jnp.eye(self.rank) + A,
            B,
            bend[:, 0] / self.curvature_range,
            rest[:, 0] - B @ self.space.control_mean,
            params["centres"],
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


def identify(
    lift: Lift,
    train: Trajectory,
    validation: Trajectory,
    key: Key,
    *,
    ridges: tuple[float, ...],
    transitions: int,
    horizon: int,
) -> Params:
    """Fit the weights by ridge regression, with the ridge that predicts best.

    Pairs are of the training runs; those of validation choose the ridge. The centres of
    the lift are drawn here, and the key is consumed.
    """
    # A key each: the centres do not change with the number of pairs.
    centre_key, pair_key, circle_key = jax.random.split(key, 3)
    centres = lift.random_centres(centre_key)
    # All ridges share one factorisation of the pairs, the expensive part.
    fits = ridge_regression(
        *_pairs(lift, train, centres, pair_key, transitions), jnp.asarray(ridges)
    )
    count, steps = validation.controls.shape[:2]
    length = min(horizon, steps)
    # From the first step on: the offset of a circle refers to the first state.
    states, *inputs = validation
    windows = Trajectory(
        states[:, : length + 1], *(leaf[:, :length] for leaf in inputs)
    )
    drawn = [VALIDATION_SHARE * part for part in _circles(lift, circle_key, count)]

    def error(weights: Float[Array, "regressor rank"]) -> Scalar:
        params = {"centres": centres, "weights": weights}
        errors = jax.vmap(lambda *each: _prediction_error(lift, params, *each))
        return jnp.mean(errors(windows, *drawn))

    # By free prediction over a horizon, which is what a controller uses.
    errors = jax.lax.map(error, fits)
    return {
        "centres": centres,
        # A prediction that diverged has a NaN or inf, and argmin would choose a NaN.
        "weights": fits[jnp.argmin(jnp.where(jnp.isfinite(errors), errors, jnp.inf))],
    }


def _circles(
    lift: Lift, key: Key, count: int
) -> tuple[Float[Array, "sample 2"], Float[Array, " sample"]]:
    """Draw offsets (e_y, e_ψ) from circles, and their curvatures, uniformly."""
    drawn = jax.random.uniform(key, (count, 3), minval=-1.0)
    ranges = jnp.asarray([lift.lateral_range, lift.heading_range])
    return drawn[:, :2] * ranges, lift.curvature_range * drawn[:, 2]


def _pairs(
    lift: Lift,
    train: Trajectory,
    centres: Float[Array, "function coordinate"],
    key: Key,
    most: int,
) -> tuple[Float[Array, "sample regressor"], Float[Array, "sample rank"]]:
    """Regressors and increments of the lift, one row per transition."""
    choice_key, circle_key = jax.random.split(key)
    # Paired before the shuffle: a pair must not mix two runs or two times.
    ends = jnp.stack([train.states[:, :-1], train.states[:, 1:]], axis=2).reshape(
        -1, 2, lift.size
    )
    # Drawn over all runs: neighbours in time are nearly the same pair.
    chosen = jax.random.permutation(choice_key, ends.shape[0])[:most]
    # The same permutation, so that each pair keeps its own control and environment.
    controls, envs = (
        leaf.reshape(ends.shape[0], -1)[chosen] for leaf in (train.controls, train.envs)
    )
    offsets, curvatures = _circles(lift, circle_key, chosen.shape[0])
    paths = jax.vmap(along_circle)(ends[chosen], offsets, curvatures)
    before, after = (
        jax.vmap(lift, in_axes=(None, 0))(centres, paths[:, k]) for k in (0, 1)
    )
    return jax.vmap(lift.regressors)(before, controls, envs, curvatures), after - before


def _prediction_error(
    lift: Lift,
    params: Params,
    window: Trajectory,
    offset: Float[Array, " 2"],
    change: Scalar,
) -> Scalar:
    """Mean square error of a prediction relative to a circle close to the window."""
    steps = jnp.hypot(*jnp.diff(window.states[:, :2], axis=0).T)
    turned = jax.vmap(between)(window.states[:-1, POSE], window.states[1:, POSE])[:, 2]
    # The circle that the car really drove; a controller sees paths close to it.
    # At least 1 m, or a car that stands would have an infinite curvature.
    bend = jnp.sum(turned) / jnp.maximum(jnp.sum(steps), 1.0)
    kappa = jnp.clip(bend + change, -lift.curvature_range, lift.curvature_range)
    paths = along_circle(window.states, offset, kappa)

    def advance(z: Array, inputs: tuple[Control, Environment]) -> tuple[Array, Array]:
        # Never lifted again: a controller propagates
        # z, and this error is what it meets.
        z = z + lift.regressors(z, *inputs, kappa) @ params["weights"]
        return z, z[1 : lift.size]

    _, predicted = jax.lax.scan(
        advance, lift(params["centres"], paths[0]), (window.controls, window.envs)
    )
    # Without the progress: it is of metres, and no feedback looks at it.
    return jnp.mean((predicted - ((paths - lift.centre) / lift.scale)[1:, 1:]) ** 2)


def along_circle(
    states: Float[Array, "time state"], offset: Float[Array, " 2"], curvature: Scalar
) -> Float[Array, "time state"]:
    """Return states relative to a circle from which the first one has a given offset.

        s = atan2(κX, 1 − κY) / κ,   e_y and e_ψ of `circle_errors`,

    (X, Y, Θ) the pose in the frame of the circle's point closest to the first state.
    Returns (s, e_y, e_ψ, body state) at every time.

    Args:
        states: x_0 … x_T.
        offset: e_y [m] and e_ψ [rad] of x_0.
        curvature: κ [1/m].
    """
    # A straight path is a circle so large that float32 sees no difference.
    kappa = jnp.where(jnp.abs(curvature) < STRAIGHT, STRAIGHT, curvature)
    # Heading of the path first, then a step
    # across it: e_y is measured along its normal.
    tangent = states[0, POSE].at[2].add(-offset[1])
    foot = compose(tangent, jnp.stack([jnp.zeros(()), -offset[0], jnp.zeros(())]))

    def one(state: State) -> State:
        pose = between(foot, state[POSE])
        # An arc of the angle, exact for large turns, where a chord would be too short.
        arc = jnp.arctan2(kappa * pose[0], 1.0 - kappa * pose[1]) / kappa
        return jnp.stack([arc, *circle_errors(pose, kappa), *state[BODY]])

    return jax.vmap(one)(states)


def ridge_regression(
    inputs: Float[Array, "sample p"],
    targets: Float[Array, "sample q"],
    ridges: Float[Array, " ridge"],
) -> Float[Array, "ridge p q"]:
    """Return W = argmin |X W − Y|² + λ N |D W|² for inputs X, targets Y, ridges λ > 0.

    D are the root mean squares of the columns of X. Solved by an orthogonal
    factorisation of [X D⁻¹, Y] instead of X'X, which float32 cannot resolve.
    """
    count = inputs.shape[1]
    spread = jnp.sqrt(jnp.mean(inputs**2, axis=0))
    # A column of zeros has no unit; any will do.
    spread = jnp.where(spread > 0, spread, 1.0)
    columns = jnp.concatenate([inputs / spread, targets], axis=1)
    # Not X'X, whose condition is the square of that of X.
    triangle = jnp.linalg.qr(columns, mode="r")[:count]

    def solve(ridge: Scalar) -> Float[Array, "p q"]:
        # √ridge D appended as rows: the penalty without ever forming X'X.
        penalty = jnp.sqrt(ridge * inputs.shape[0]) * jnp.eye(count)
        orthogonal, upper = jnp.linalg.qr(
            jnp.concatenate([triangle[:, :count], penalty])
        )
        right = orthogonal[: triangle.shape[0]].T @ triangle[:, count:]
        return solve_triangular(upper, right) / spread[:, None]

    # One ridge at a time: a vmap would hold every factorisation in memory.
    return jax.lax.map(solve, ridges)


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
        functions: number of thin-plate functions.
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
    about: Any = {"ridges": ridges, "transitions": transitions, "horizon": horizon}

    def init(key: Key) -> Params:
        return {
            "centres": lift.random_centres(key),
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
        fitting=Fitting(identify=partial(identify, lift, **about)),
        structure=Structure(linear=linear),
    )
