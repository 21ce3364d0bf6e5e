"""Adaptation while driving: unmeasured causes are estimated and taken into account."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.control import Stateful
from sfkd_jax.driving.path_coordinates import LATERAL, PATH_FRAME, PATH_SPEED, PathState
from sfkd_jax.driving.path_following.laws._path_law import PathLaw
from sfkd_jax.driving.path_following.tasks._preview import Preview
from sfkd_jax.driving.path_following.wrappers._estimator import (
    CAUSES,
    FRICTION,
    WIND,
    Applied,
    Bank,
    Belief,
    Estimator,
    Loop,
    input_error,
    side_force,
    transition_matrix,
)
from sfkd_jax.driving.path_following.wrappers._innovations import expected_coordinates
from sfkd_jax.geometry import without_pose
from sfkd_jax.info import AdaptationInfo, ControllerInfo, reported
from sfkd_jax.latency import ON_TIME, CommandDelay
from sfkd_jax.ranges import (
    AtLeastTwo,
    Fraction,
    Interval,
    MayBeEmpty,
    Numbers,
    Positive,
    check_intervals,
)
from sfkd_jax.rollout import Offset, fold
from sfkd_jax.types import Control, Controller, Environment, Key, Model, Params, Scalar

TOLERANCE = 1.1
"""Factor by which the squared prediction errors with the estimates may exceed those of
the model alone. Beyond it the estimates are not used.
"""


class AdaptiveState(NamedTuple):
    """What the adaptation carries from one control step to the next."""

    inner: Any  # state of the wrapped controller
    belief: Belief  # of the estimator; the part to save and resume


@dataclass(frozen=True, kw_only=True)
class Adaptation(Stateful):
    """A controller along a path that estimates what nobody measures.

    The unmeasured causes θ are a side force f (relative to the largest one of E), an
    error of the steering, an error of the drive, and a steering error and a side force
    that are proportional to κ:

        ξ⁺ = F(ξ, u + Δu(θ); κ, v_ref, e(f)) + (f beyond E) ∂F/∂f

    An extended Kalman filter estimates (ξ, θ). Between two steps f stays or jumps. Two
    filters that are joined by a Markov chain follow that (interacting multiple models).
    With `estimate_env` each of them exists for every friction of a grid, f is the wind,
    and nothing else is estimated. In each control step

    1. the measured ξ corrects (ξ, θ); see `Estimator.follow` for one that does not fit;
    2. e takes up the force within E, a compensation takes up the rest of the force, and
       u the input errors;
    3. the wrapped controller plans with all of that.

    Only e, an offset of the inputs and an offset of the latent step change. The weights
    that a certificate is about do not, so the rate and its witness stay what they are.
    θ is data of the state, so nothing is compiled again.

    `info` gains `adaptation`, see `AdaptationInfo`. The estimates are used as long as
    they predicted no worse than the model alone over the last seconds (`adapting`).

    Attributes:
        inner: controller that was built with `with_offset(model)`, since it receives
            `Offset` parameters.
        model: in path coordinates, without offset.
        law: around which the model was learned.
        control_low: lower limits of u.
        control_high: upper limits of u.
        env_low: lower end of E = (friction, wind).
        env_high: upper end of E; the box of the wind is symmetric.
        estimate_env: whether e is estimated as well; the `env` argument of `act` is
            then not read.
        delay: of the commands after an observation.
        power: exponent of the second entry of e in its side force: 2 of a wind, 1 of a
            force.
        jump: probability that the force jumps between two steps.
        jump_size: standard deviation of a jump, relative to the largest force of E.
        force_drift: standard deviation of its change over a step without a jump.
        slow_prior: standard deviations, before the first measurement, of the errors of
            steering [rad] and drive [control unit], and of the steering error and
            relative side force in the tightest turn.
        slow_drift: standard deviations of their changes over a step. The smaller they
            are, the longer is the memory of the estimates.
        shrinkage: of a force that could be noise, see `Estimator.causes`; not used with
            `estimate_env`.
        friction_points: number of hypotheses on friction, with `estimate_env`.
        friction_drift: standard deviation of the change of friction over a step.
        dwell: mean number of steps between jumps of friction.
        sensor_noise: standard deviation of each measured state of the vehicle; further
            entries are ignored. As a setting, () stands for the sensors that the
            vehicle states.
        model_error: standard deviation of one step of the model, for each entry of ξ;
            further entries are ignored. As a setting, () stands for the errors of the
            models that ship, which are known for their states alone.

    Source: Blom and Bar-Shalom (1988); Pannocchia and Rawlings (2003).
    """

    inner: Controller
    model: Model
    law: PathLaw
    control_low: tuple[float, ...]
    control_high: tuple[float, ...]
    env_low: tuple[float, ...]
    env_high: tuple[float, ...]
    estimate_env: bool = False
    delay: CommandDelay = ON_TIME
    power: Positive = 2.0
    jump: Fraction = 0.03
    jump_size: Positive = 0.8
    force_drift: Positive = 0.05
    slow_prior: tuple[Positive, ...] = (0.01, 0.05, 0.02, 2.0)
    slow_drift: tuple[Positive, ...] = (1e-4, 0.005, 1e-4, 0.02)
    shrinkage: float = 0.3
    friction_points: AtLeastTwo = 7
    friction_drift: Positive = 0.01
    dwell: Annotated[float, Interval("(1, inf)")] = 30.0
    sensor_noise: Numbers = ()
    model_error: Annotated[tuple[Positive, ...], MayBeEmpty()] = ()

    def __post_init__(self) -> None:
        low = self.env_low
        high = self.env_high
        if self.model.frame is not PATH_FRAME:
            raise ValueError("adaptation needs a model in path coordinates")
        symmetric = len(low) == len(high) == 2 and -low[WIND] == high[WIND] > 0
        if not symmetric:
            raise ValueError(
                "adaptation needs e = (friction, wind) with a wind in [-w, w], "
                f"got {low} and {high}"
            )
        noise, error = self._noise
        size = self.law.gain.shape[-1]
        if not len(noise) == len(error) == size or min(*noise, *error) <= 0:
            raise ValueError(
                "sensor_noise and model_error need positive numbers for "
                f"{size} path coordinates, got {noise} and {error}"
            )
        check_intervals(self)

    @property
    def _noise(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Standard deviations of the measured ξ and of one step of the model."""
        size = self.law.gain.shape[-1]
        # The two entries of the position become the one of e_y.
        sensors = (self.sensor_noise[0], *self.sensor_noise[2:])
        return sensors[:size], self.model_error[:size]

    def init(self, key: Key) -> AdaptiveState:
        """Return the state before the first control step."""
        noise, _ = self._noise
        # The force is only what the measured e misses.
        causes = [0.1, *self.slow_prior]
        if self.estimate_env:
            # If e is unknown the prior of the force is wide. Other causes cannot be
            # told from it in so short a time.
            causes = [1.0, *[0.0] * len(self.slow_prior)]
        prior = jnp.asarray([*noise, *causes], dtype=float) ** 2
        count = self._estimator.frictions.shape[0]
        belief = Belief(
            bank=Bank(
                jnp.zeros((count, len(noise) + CAUSES)),
                jnp.tile(jnp.diag(prior), (count, 1, 1)),
                jnp.full(count, 1.0 / count, dtype=float),
            ),
            applied=Applied(jnp.zeros(2), jnp.zeros(2), self._inside(jnp.zeros(2))),
            scores=jnp.zeros(2),
        )
        return AdaptiveState(self.inner.init(key), belief)

    def act(
        self,
        params: Params,
        state: AdaptiveState,
        xi: PathState,
        env: Environment,
        preview: Preview,
    ) -> tuple[Control, AdaptiveState, ControllerInfo]:
        """Take one control step."""
        estimator = self._estimator
        before = state.belief
        loop = estimator.loop
        size = xi.shape[0]
        params = fold(self.model, params)
        env = self._inside(env)
        road = preview.road[0]
        # Nothing is learned from a measurement that the gate did not believe, nor at
        # another rate.
        usable = jnp.all(preview.measured) & preview.on_time
        belief, rejected = estimator.follow(params, before, xi, usable)
        adapting = belief.scores[0] <= TOLERANCE * belief.scores[1]
        # Causes that predict worse than none are not used, unless e depends on them.
        shrinkage = 0.0 if self.estimate_env else self.shrinkage
        causes = estimator.causes(belief, shrinkage)
        causes = jnp.where(adapting | self.estimate_env, causes, 0.0)

        if self.estimate_env:
            friction = belief.bank.probabilities @ estimator.frictions
            env = jnp.zeros_like(env).at[FRICTION].set(friction)
        inside, excess = loop.split_force(env, side_force(causes, road))
        estimate = belief.bank.mean()[:size]
        offset = _compensation(loop, params, inside, road, estimate, excess)
        error = input_error(causes, road)
        # The controller inside knows its commands without the corrections below.
        sent = preview.sent - offset.inputs[:2] + error
        shown = preview._replace(sent=sent)
        control, inner, info = self.inner.act(offset, state.inner, xi, inside, shown)
        control = control + offset.inputs[:2] - error
        control = jnp.clip(
            control, jnp.asarray(self.control_low), jnp.asarray(self.control_high)
        )

        adaptation = AdaptationInfo(
            env=inside,
            causes=causes,
            causes_std=jnp.sqrt(belief.bank.variance()[size:]),
            rejected=rejected,
            adapting=adapting,
        )
        acting = self.delay.acting(preview.sent, control, later=preview.later)
        belief = belief._replace(applied=Applied(acting, road, env))
        info = reported(info)._replace(adaptation=adaptation)
        return control, AdaptiveState(inner, belief), info

    @cached_property
    def _estimator(self) -> Estimator:
        """The estimator: two filters for each friction; the force stays or jumps."""
        # These arrays are constants, even if a program is being traced at the time.
        with jax.ensure_compile_time_eval():
            noise, error = self._noise
            low = jnp.asarray(self.env_low, dtype=float)
            high = jnp.asarray(self.env_high, dtype=float)
            frictions = jnp.full(1, jnp.nan, dtype=float)
            chain = jnp.ones((1, 1))
            slow_drift = self.slow_drift
            if self.estimate_env:
                slow_drift = (0.0,) * (CAUSES - 1)
                lowest = self.env_low[FRICTION]
                highest = self.env_high[FRICTION]
                frictions = jnp.linspace(lowest, highest, self.friction_points)
                chain = transition_matrix(
                    lowest,
                    highest,
                    self.friction_points,
                    self.friction_drift,
                    self.dwell,
                )
            jumps = jnp.tile(jnp.array([1.0 - self.jump, self.jump]), (2, 1))
            drift = jnp.asarray([*error, self.force_drift, *slow_drift]) ** 2
            drifts = jnp.stack([drift, drift.at[len(error)].set(self.jump_size**2)])
            return Estimator(
                loop=Loop(self.model, self.law, low, high, self.power),
                transition=jnp.kron(chain, jumps),
                frictions=jnp.repeat(frictions, 2),
                sensors=jnp.asarray(noise) ** 2,
                noise=jnp.tile(jax.vmap(jnp.diag)(drifts), (frictions.shape[0], 1, 1)),
            )

    def _inside(self, env: Environment) -> Environment:
        """Return e, clipped to its box; the middle of the box if e is estimated."""
        low = jnp.asarray(self.env_low)
        high = jnp.asarray(self.env_high)
        if self.estimate_env:
            return 0.5 * (low + high)
        return jnp.clip(env, low, high)


def _compensation(
    loop: Loop,
    params: Params,
    env: Environment,
    road: Float[Array, " 2"],
    xi: PathState,
    excess: Scalar,
) -> Offset:
    """Return the model with a force beyond E and with the steering that balances it.

        d = excess · ∂ξ⁺/∂force,   Δξ = A Δξ + B δ + d,   Δe_y = Δv = 0,
        z⁺ = F(z, w + δ; e) + ∂Φ/∂ξ d

    δ is the offset-free target of the closed loop (Pannocchia and Rawlings, 2003); only
    its steering is used. A and B are the derivatives of one step of the loop.

    Args:
        loop: the learned closed loop.
        params: of the model.
        env: e, with the part of the force that lies inside E.
        road: κ [1/m] and v_ref [m/s].
        xi: estimate of ξ.
        excess: part of the force beyond E, relative to the largest force in E.
    """
    model = loop.model
    size = xi.shape[0]
    fiber = model.fiber(params, env)
    law_control = loop.law(xi, road[0], road[1], env)
    applied = Applied(law_control, road, env)
    shifted = excess * loop.force_slope(params, applied, xi)

    def advance(xi: PathState, nu: Control) -> PathState:
        return expected_coordinates(model, fiber, xi, nu, road)

    A, B = jax.jacfwd(advance, (0, 1))(xi, jnp.zeros(2))
    # The unknowns are steering and drive in place of e_y and v, which stay at 0.
    equations = jnp.eye(size) - A
    equations = equations.at[:, LATERAL].set(-B[:, 0]).at[:, PATH_SPEED].set(-B[:, 1])
    steering = jnp.linalg.solve(equations, shifted)[LATERAL]
    # The model was not learned beyond what data and planners add to the law.
    largest = 2.0 * loop.law.perturbation[0]
    steering = jnp.clip(jnp.nan_to_num(steering), -largest, largest)
    shift = (without_pose(xi), without_pose(shifted))
    return Offset(params, jnp.zeros(4).at[0].set(steering), shift)
