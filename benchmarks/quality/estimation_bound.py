"""What the sensors tell about friction and side force: a posterior Cramér-Rao bound.

python -m benchmarks.quality.estimation_bound --vehicle dynamic [--episodes 16
--seconds 30 --seed 2028]
The recursion of Tichavský et al. (1998) along drives of the oracle on S3, whose
environment is constant between switches. An estimator that knows the car, and when e
switches, starts after a switch with the variances of E; none that is unbiased does
better. Beside it stand the errors of `control.adaptive`, and the oracle driven
with an e that is as wrong as the bound says. Writes estimation_bound_VEHICLE.json.
"""

import argparse
import json

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import harness
from benchmarks.quality import adaptation
from sfkd_jax import store
from sfkd_jax.plants import side_force

AFTER = (0, 1, 2, 3, 5, 10, 20, 29)
"""Steps after a switch that are reported."""
CASE = adaptation.Case(estimate_env=True)


def to_force(plant, envs):
    """(friction, wind) -> (friction, side force [N])."""
    return np.stack(
        [envs[..., 0], side_force(envs[..., 1], wind_force=plant.wind_force)], -1
    )


def to_wind(plant, causes):
    """(friction, side force [N]) -> (friction, wind)."""
    wind = jnp.sign(causes[..., 1]) * jnp.sqrt(
        jnp.abs(causes[..., 1]) / plant.wind_force
    )
    return jnp.stack([causes[..., 0], wind], -1)


def transitions(plant, states, controls, causes):
    """Jacobians of the step in (state, friction, force), one per step."""
    size = states.shape[-1]
    causes = causes + np.array([0.0, 1.0])  # wind has no derivative by no force

    def step(vector, control):
        return plant.step(vector[:size], control, to_wind(plant, vector[size:]))

    vectors = jnp.concatenate([states[:-1], causes], -1)
    top = np.asarray(jax.jit(jax.vmap(jax.jacfwd(step)))(vectors, controls), np.float64)
    bottom = np.broadcast_to(np.eye(2, size + 2, size), (len(top), 2, size + 2))
    return np.concatenate([top, bottom], axis=1)


def bounds(jacobians, switched, noise, prior):
    """Standard deviations of friction and force that the sensors allow, (time, 2).

    The last entry is of the causes that act from the last measurement on.
    """
    size = len(noise)
    sensors = np.diag(np.square(noise))
    covariance = np.zeros((size + 2, size + 2))
    covariance[:size, :size] = sensors
    result = []
    for jacobian, new in zip(jacobians, switched, strict=True):
        if new:
            covariance[size:] = covariance[:, size:] = 0.0
            covariance[size:, size:] = np.diag(np.square(prior))
        result.append(np.sqrt(np.diag(covariance)[size:]))
        covariance = jacobian @ covariance @ jacobian.T
        gain = np.linalg.solve(covariance[:size, :size] + sensors, covariance[:size])
        covariance = covariance - covariance[:, :size] @ gain
        covariance = (covariance + covariance.T) / 2
    return np.stack(result)


def bounds_of(plant, noise, prior, episodes, envs):
    """The bounds of all drives, (episode, time, 2), and steps since the last switch."""
    causes = to_force(plant, envs)
    switched = np.any(np.diff(envs, axis=1, prepend=np.inf), axis=-1)
    spread = [
        bounds(transitions(plant, states, controls, each), new, noise, prior)
        for states, controls, each, new in zip(
            episodes.states, episodes.controls, causes, switched, strict=True
        )
    ]
    time = np.arange(envs.shape[1])
    since = time - np.maximum.accumulate(np.where(switched, time, 0), axis=1)
    return np.stack(spread), since


def episodes_of(rows, system, scene):
    """Episodes of a (controller, parameters) in its scenario, as numpy arrays."""
    episodes = adaptation.episodes_of(rows, rows.plant, system, scene)
    return jax.tree.map(np.asarray, episodes)


def by_steps(errors, since):
    """Root mean squares of (episode, time, 2) for every number of steps in `AFTER`."""
    return {
        str(after): np.sqrt(np.mean(errors[since == after] ** 2, axis=0)).tolist()
        for after in AFTER
    }


def rmse(episodes):
    """Lateral RMSE in mm, as `adaptation` reports it."""
    return adaptation.summary(episodes)["rmse_mm"]


def main():
    """Parse, drive, bound, drive again with the bound's errors, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--vehicle", choices=adaptation.DEFAULTS, required=True)
    parser.add_argument("--episodes", type=int, default=16)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--seed", type=int, default=2028)
    given = parser.parse_args()
    rows = adaptation.shipped(given.vehicle)
    plant = rows.plant
    made, keys = adaptation.roads(
        plant, CASE, given.episodes, given.seconds, given.seed
    )
    envs = np.asarray(made.envs)
    box = to_force(plant, np.asarray([rows.box["env_low"], rows.box["env_high"]]))
    prior = (box[1] - box[0]) / np.sqrt(12.0)
    noise = adaptation.sensor_noise(rows)

    oracle = rows.planner(rows.oracle(plant)), {}
    told = episodes_of(rows, oracle, (made, keys))
    spread, since = bounds_of(plant, noise, prior, told, envs)
    visits = since[0] == 0
    draw = np.random.default_rng(given.seed).standard_normal((*envs.shape,))
    draw = draw[:, np.flatnonzero(visits)[np.cumsum(visits) - 1]]
    wrong = np.clip(to_force(plant, envs) + draw * spread, *box)
    misled = made._replace(observed_envs=to_wind(plant, jnp.asarray(wrong, envs.dtype)))
    rows_driven = {
        "oracle, e measured": rmse(told),
        "oracle, e as wrong as the bound": rmse(
            episodes_of(rows, oracle, (misled, keys))
        ),
    }
    estimators = {
        "oracle, e estimated": (rows.oracle(plant), {}),
        "SFKD, e estimated": (rows.loaded.model, rows.loaded.params),
    }
    errors = {"bound": by_steps(spread, since)}
    for name, (model, params) in estimators.items():
        system = rows.adaptive(model, estimate_env=True), params
        driven = episodes_of(rows, system, (made, keys))
        error = to_force(plant, driven.assumed_envs) - to_force(plant, envs)
        errors[name] = by_steps(error, since)
        rows_driven[name] = rmse(driven)
    document = {
        "protocol": vars(given),
        "prior": prior.tolist(),
        "errors": errors,
        "rmse_mm": rows_driven,
        "machine": harness.machine(),
        "versions": store.versions(),
    }
    out = harness.ROOT / f"benchmarks/quality/estimation_bound_{given.vehicle}.json"
    store.write_json(out, document)
    print(json.dumps({"results": str(out)}))


if __name__ == "__main__":
    main()
