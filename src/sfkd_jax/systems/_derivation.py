"""The law of a system: gains whose closed loop contracts in one metric."""

from __future__ import annotations

import warnings

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from sfkd_jax.ranges import Fraction, Span
from sfkd_jax.systems._closed_loop import ClosedLoop
from sfkd_jax.systems._law import Law
from sfkd_jax.systems._runs import tried
from sfkd_jax.systems._steady_states import NoLaw, SteadyStates
from sfkd_jax.systems._tracking import Tracked
from sfkd_jax.types import Key

SENSORS = 0.01
"""Share of the variance of the sensors that counts as a disturbance of a step."""
GROWTH_STEPS = 10
"""Steps over which disturbances grow that scale the states of a semidefinite program.
"""
RATES = (0.7, 0.75, 0.8, 0.83, 0.86, 0.9, 0.93, 0.95, 0.97, 0.98, 0.99)
"""Rates that are tried, fastest first."""
ROUNDS = 8
"""Number of times that conditions are added inside the table."""
ADDED = 4
"""Number of points of the table that are added at a time."""
UNREACHED = 1e-9
"""Effect of a control that is none."""
SATURATED = 0.01
"""Largest share of steps in which a control is at its limit."""
WORSE = 2
"""Number of slower laws in a row with larger errors after which none is tried."""
TRIAL_STEPS = 300
"""Steps of the runs with which a law is tried."""


def best_law(
    tracked: Tracked,
    steady: SteadyStates,
    key: Key,
    *,
    dwell: Span,
    perturbation: Fraction = 0.05,
) -> tuple[Law, float]:
    """Return the law of that of `RATES` with the smallest errors, and its rate.

    Every law is tried on the same simulated runs. Where a control is at its limit the
    loop is open, so laws that saturate are left out. The fastest of the others is not
    always the best: its gains are large, and answer to each switch of e with motions
    for which the linear model of the system does not hold.

    Args:
        tracked: the system.
        steady: its steady states.
        key: of the runs; consumed.
        dwell: range of times between two switches of e [s].
        perturbation: largest |ν|, relative to half of the range of each control.

    Raises:
        NoLaw: the law of every rate saturates, or does not exist.
    """
    reason = ""
    best = None
    smallest = np.inf
    worse = 0
    for rate in RATES:
        try:
            law = derive_law(tracked, steady, rate=rate, perturbation=perturbation)
        except NoLaw as failure:
            reason = str(failure)
            continue
        trial = tried(ClosedLoop(tracked, law), key, steps=TRIAL_STEPS, dwell=dwell)
        if trial.saturated > SATURATED:
            reason = (
                f"saturation: at a rate of {rate:g} a control is at its limit in "
                f"{100 * trial.saturated:.0f} % of the steps. Make the reference "
                "slower, or the ranges smaller"
            )
            continue
        if trial.error < smallest:
            best = law, rate
            smallest = trial.error
            worse = 0
        else:
            worse += 1
        if worse == WORSE:
            break
    if best is None:
        raise NoLaw(reason)
    return best


def derive_law(
    tracked: Tracked,
    steady: SteadyStates,
    *,
    rate: Fraction,
    perturbation: Fraction = 0.05,
) -> Law:
    """Return the law with the least effort whose closed loop contracts at a rate.

        minimise  mean_i tr Z_i   over X, Y_i, Z_i
        (A_i X − B_i Y_i) in [α² X, X],   A_cl X A_cl' + W ≤ X,   [Z_i Y_i; Y_i' X] ≥ 0
        K_i = Y_i X⁻¹

    One metric X⁻¹ serves all corners i of the table: what switches between them
    contracts as well, and so can a model with one certificate for all of them. X is a
    bound of the covariance of ξ under the disturbances W: changes of the steady state,
    ν and noise. Gains inside the table are interpolated, and so are Y_i. Points of the
    table where the loop does not contract in this metric are added to the conditions.

    Args:
        tracked: the system.
        steady: its steady states.
        rate: α.
        perturbation: largest |ν|, relative to half of the range of each control.

    Raises:
        NoLaw: no gains contract at this rate in one metric.

    Source: Boyd, El Ghaoui, Feron and Balakrishnan (1994), Linear Matrix Inequalities
        in System and Control Theory, chapters 5 and 7.
    """
    low, high = map(np.asarray, tracked.system.control_box)
    half_ranges = 0.5 * (high - low)
    disturbance = _disturbance(tracked, steady, perturbation * half_ranges)
    gains = _contracting_gains(steady, disturbance, half_ranges, rate)
    if gains is None:
        raise NoLaw(
            f"no gains contract {', '.join(tracked.names)} at a rate of {rate:g} in "
            f"one metric for all references and e{_unreachable(tracked, steady, rate)}"
        )

    def table(values: np.ndarray) -> Array:
        shape = (*steady.counts, *values.shape[1:])
        return jnp.asarray(values.reshape(shape), jnp.float32)

    return Law(
        low=jnp.asarray(steady.low, jnp.float32),
        high=jnp.asarray(steady.high, jnp.float32),
        perturbation=jnp.asarray(perturbation * half_ranges, jnp.float32),
        state=table(steady.states),
        control=table(steady.controls),
        gain=table(gains),
    )


def _disturbance(
    tracked: Tracked, steady: SteadyStates, perturbation: np.ndarray
) -> np.ndarray:
    """Return W, the covariance of what disturbs a step.

    Reference and e change once in a mean dwell, to a place of the table whose steady
    state is another one.
    """
    dt = tracked.system.dt
    size = len(tracked.names)
    changes = 2.0 * dt / np.mean(tracked.frame.dwell)
    B = steady.slopes[len(steady.slopes) // 2][:, size:]
    pushed = B * (0.5 * perturbation)
    noise = np.asarray(tracked.system.sensor_noise)
    of_steady = changes * np.cov(steady.states.T).reshape(size, size)
    return of_steady + pushed @ pushed.T + SENSORS * np.diag(noise**2)


def _contracting_gains(
    steady: SteadyStates, disturbance: np.ndarray, half_ranges: np.ndarray, rate: float
) -> np.ndarray | None:
    """Return the gains at all points of the table, see `derive_law`; None if none."""
    size = disturbance.shape[0]
    scales = _scales(steady.slopes[steady.corners].mean(axis=0)[:, :size], disturbance)
    # In these units all states and controls are of about 1.
    A = steady.slopes[:, :, :size] * scales / scales[:, None]
    B = steady.slopes[:, :, size:] * half_ranges / scales[:, None]
    W = disturbance / scales / scales[:, None]
    # Of all points: the shares of the corners, with which gains are interpolated.
    shares = _interpolated_inside(steady, np.eye(len(steady.corners)))
    places = list(steady.corners)
    for _ in range(ROUNDS):
        solution = _solution(A[places], B[places], W, shares[places], rate)
        if solution is None:
            return None
        X, at_corners = solution
        gains = np.tensordot(shares, at_corners, 1)
        rates = _rates_in(X, A - B @ gains)
        worst = np.argsort(rates)[-ADDED:]
        expanding = worst[rates[worst] >= 1.0]
        if len(expanding) == 0:
            return half_ranges[:, None] * gains / scales
        places.extend(expanding)
    return None


def _solution(
    A: np.ndarray, B: np.ndarray, W: np.ndarray, shares: np.ndarray, rate: float
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return X and the gains at the corners of the table, from conditions at places.

    Args:
        A: of the places, the corners first.
        B: of the places.
        W: covariance of the disturbances.
        shares: of the corners in the gains of the places.
        rate: α.
    """
    import cvxpy as cp

    size, controls = B.shape[1:]
    corners = shares.shape[1]
    X = cp.Variable((size, size), symmetric=True)
    Ys = [cp.Variable((controls, size)) for _ in range(corners)]
    Zs = [cp.Variable((controls, controls), symmetric=True) for _ in range(corners)]
    conditions = [cp.bmat([[Z, Y], [Y.T, X]]) >> 0 for Z, Y in zip(Zs, Ys, strict=True)]
    for A_i, B_i, of_corners in zip(A, B, shares, strict=True):
        used = np.flatnonzero(of_corners)
        Y = sum(of_corners[index] * Ys[index] for index in used)
        closed = A_i @ X - B_i @ Y
        conditions += [
            cp.bmat([[rate**2 * X, closed.T], [closed, X]]) >> 0,
            cp.bmat([[X - W, closed], [closed.T, X]]) >> 0,
        ]
    effort = sum(cp.trace(Z) for Z in Zs) / corners
    problem = cp.Problem(cp.Minimize(effort), [*conditions])
    try:
        with warnings.catch_warnings():
            # No warning about an inaccurate answer: the rates are computed.
            warnings.simplefilter("ignore")
            problem.solve(solver=cp.CLARABEL)
    except cp.SolverError:
        return None
    if problem.status not in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE):
        return None
    covariance = np.asarray(X.value)
    metric = np.linalg.inv(covariance)
    return covariance, np.stack([np.asarray(Y.value) @ metric for Y in Ys])


def _rates_in(X: np.ndarray, closed: np.ndarray) -> np.ndarray:
    """Return the rates at which closed loops contract in the metric X⁻¹."""
    values, vectors = np.linalg.eigh(X)
    # Rounding may leave an eigenvalue at 0, where nothing contracts.
    root = np.sqrt(np.maximum(values, 1e-12))
    turned = vectors.T @ closed @ vectors
    return np.linalg.norm(turned * root / root[:, None], ord=2, axis=(1, 2))


def _unreachable(tracked: Tracked, steady: SteadyStates, rate: float) -> str:
    """Return which states no control makes contract, as part of a message.

    A left eigenvector w of A with an eigenvalue above the rate and w B = 0 says so.
    """
    size = len(tracked.names)
    for index in steady.corners:
        A, B = np.split(steady.slopes[index], [size], axis=1)
        values, vectors = np.linalg.eig(A.T)
        for value, mode in zip(values, vectors.T, strict=True):
            if abs(value) > rate and np.abs(mode @ B).max() <= UNREACHED:
                state = tracked.names[int(np.argmax(np.abs(mode)))]
                return f": no control acts on {state}, which changes by itself"
    return ""


def _scales(A: np.ndarray, disturbance: np.ndarray) -> np.ndarray:
    """Return the standard deviations of ξ after a few steps of disturbances."""
    covariance = np.zeros_like(disturbance)
    for _ in range(GROWTH_STEPS):
        covariance = A @ covariance @ A.T + disturbance
    return np.sqrt(np.maximum(np.diag(covariance), 1e-12))


def _interpolated_inside(steady: SteadyStates, gains: np.ndarray) -> np.ndarray:
    """Return gains at all points of a table from those at its corners."""
    axes = len(steady.low)
    values = gains.reshape(*(2,) * axes, *gains.shape[1:])
    shares = np.linspace(0.0, 1.0, steady.points)
    for axis in range(axes):
        first, last = np.moveaxis(values, axis, 0)
        along = np.multiply.outer(1.0 - shares, first) + np.multiply.outer(shares, last)
        values = np.moveaxis(along, 0, axis)
    return values.reshape(-1, *gains.shape[1:])
