"""Planners that try to drive a car off its road, through the shield of a certified policy and without it.

python -m benchmarks.quality.shield --runs DIR ... [--drives 200 --episodes 16 --seconds 60
--out benchmarks/quality/shield.json] DIR: with policy.safetensors and a certificate.json that has a
corridor. The true car on S3 roads, seen through its sensors. Asked for with the shield:
no departure whatever is planned; for the policy's own planner at most 2 % more error on
the same episodes, requests cut in at most 1 % of the steps, at most 1 ms more a step.
"""

import argparse
import json
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import harness
from benchmarks.quality.shield_table import ASKED, FLAGS, misses, table
from benchmarks.robustness.soak import ENVIRONMENT, LANE
from sfkd_jax import build, policy, scenarios
from sfkd_jax.control import PathLaw, along_reference
from sfkd_jax.evaluation import first_reference
from sfkd_jax.geometry import LATERAL
from sfkd_jax.plants import Vehicle
from sfkd_jax.rollout import fold
from sfkd_jax.types import Controller

SCRIPTS = ("nothing", "worst", "bang-bang", "random", "constant", "NaN", "full lock")
"""ν = 0; at its limit, outwards of the measured e_y; to and fro with a period of 1 to 8
s; to either side, drawn every step; to one side for ever; not a number; u, not ν, at
the actuators' limits.
"""
BATCH, SETTLED = 20, 2.0


class Car(NamedTuple):
    """A certified policy and the plant that it drives."""

    plant: Vehicle
    trained: policy.TrainedModel
    law: PathLaw
    params: dict
    certificate: dict

    @property
    def settings(self):
        """Of the policy's own planner."""
        return self.trained.settings["controller"]

    @property
    def sensors(self):
        """Standard deviation of every entry of the state."""
        noise = self.certificate["corridor"]["conditions"]["sensor_noise"]
        return jnp.asarray(noise[: len(self.plant.state_names)])


def load(run):
    """The car of a run directory."""
    trained = policy.restore(run)
    certificate, reason = policy.read_certificate(run, trained)
    if trained.law is None or not (certificate or {}).get("corridor"):
        raise SystemExit(
            f"{run}: no certified corridor; {reason or 'python -m sfkd_jax.certify makes one'}"
        )
    return Car(
        trained.vehicle,
        trained,
        trained.law,
        jax.jit(partial(fold, trained.model))(trained.params),
        certificate,
    )


def scripted(car, kind, onset=0):
    """A planner of `SCRIPTS`, by its index, that may be traced; before step `onset` it
    asks for nothing.
    """
    low, high = jnp.asarray(car.plant.control_low), jnp.asarray(car.plant.control_high)

    def act(params, state, xi, env, preview):
        key, step = state
        side_key, period_key, now = (
            jax.random.fold_in(key, stream) for stream in (0, 1, 2 + step)
        )
        side = jax.random.rademacher(side_key, (2,), float)
        period = jax.random.uniform(period_key, minval=1.0, maxval=8.0)
        swing = jnp.where(jnp.mod(step * car.plant.dt / period, 1.0) < 0.5, 1.0, -1.0)
        shares = {
            "nothing": jnp.zeros(2),
            "worst": jnp.stack([jnp.where(xi[LATERAL] < 0.0, -1.0, 1.0), 1.0]),
            "bang-bang": swing * side,
            "random": jax.random.rademacher(now, (2,), float),
            "constant": side,
            "NaN": jnp.full(2, jnp.nan),
        }
        lawful = car.law(xi, *preview.road[0], env)
        args = [lawful + share * car.law.perturbation for share in shares.values()]
        control = jnp.stack([*args, jnp.where(side > 0.0, high, low)])[
            jnp.where(step < onset, 0, kind)
        ]
        ahead = jnp.tile(xi, (preview.road.shape[0], 1))
        info = {"predicted_states": ahead}
        return jnp.clip(control, low, high), (key, step + 1), info

    return Controller(lambda key: (key, jnp.zeros((), jnp.int32)), act)


def planner(car, *, shield):
    """The policy's own planner."""
    box = {
        f"env_{side}": car.trained.settings["environment"][side]
        for side in ("low", "high")
    }
    settings, about = (
        car.settings | {"shield": shield},
        {"certificate": car.certificate, "law": car.law},
    )
    return build.build_controller(
        settings, car.trained.model, car.plant, **box, **about
    )


def alone(car, controller):
    """A controller along a path in the world."""
    return along_reference(controller, coordinates=car.law.gain.shape[-1])


def shielded(car, controller):
    """The same controller in the certified corridor."""
    guarded = build.in_corridor(
        controller, car.trained.model, car.plant, car.law, car.certificate
    )
    return alone(car, guarded)


def drive(car, controller, road, key):
    """e_y before every step and after the last one [m], (time + 1,), and what the
    shield said at every step.
    """
    return drive_states(car, controller, road, key)[1:]


def drive_states(car, controller, road, key):
    """States before every step and after the last one, (time + 1, state), and the rest
    as `drive` returns it.
    """
    planner_key, noise_key = jax.random.split(key)
    horizon = build.controller_horizon(car.settings)

    def step(carry, given):
        state, progress, memory = carry
        env, sensor_key = given
        observation = state + car.sensors * jax.random.normal(sensor_key, state.shape)
        window = scenarios.reference_window(
            road.path, progress, road.speed, dt=car.plant.dt, horizon=horizon
        )
        control, memory, info = controller.act(
            car.params, memory, observation, env, window
        )
        state = car.plant.step(state, control, env)
        progress, lateral = scenarios.project(
            road.path, state[:2], progress + road.speed * car.plant.dt
        )
        message = {}
        if "nominal_state" in info:
            message = {
                "void": info["outside_box"],
                "broken": info["bound_exceeded"],
                "infeasible": ~info["feasible"],
                "copy": info["nominal_state"][LATERAL],
                "intervened": info["intervention"] > 0.0,
            }
        return (state, progress, memory), (state, lateral, message)

    start = road.initial_state, jnp.zeros(()), controller.init(planner_key)
    given = road.envs, jax.random.split(noise_key, len(road.envs))
    _, (states, lateral, message) = jax.lax.scan(step, start, given)
    states = jnp.concatenate([road.initial_state[None], states])
    return states, jnp.concatenate([jnp.zeros(1), lateral]), message


def episodes(car, count, seconds, seed):
    """Roads and keys of as many S3 episodes."""
    sizes = {
        "duration": seconds,
        "state_size": len(car.plant.state_names),
        "dt": car.plant.dt,
    }
    road_key, drive_key = jax.random.split(jax.random.key(seed))
    roads = jax.jit(jax.vmap(scenarios.scenario(name="s3", **sizes)))(
        jax.random.split(road_key, count)
    )
    return roads, jax.random.split(drive_key, count)


def batches(driven, roads, keys):
    """A vectorised function of (roads, keys), some at a time."""
    parts = []
    for begin in range(0, len(keys), BATCH):
        some = jax.tree.map(
            lambda leaf, begin=begin: leaf[begin : begin + BATCH], (roads, keys)
        )
        parts.append(jax.device_get(driven(*some)))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)


def summary(lateral, message, bounds):
    """What some drives come to."""
    worst = np.max(np.where(np.isfinite(lateral), np.abs(lateral), np.inf), axis=1)
    largest = float(np.max(worst))
    result = {"drives": len(worst), "departures": int(np.sum(~(worst <= LANE)))}
    result |= {"largest_m": largest if np.isfinite(largest) else None}
    if not message:
        return result
    separate = np.abs(lateral[:, :-1] - message["copy"])
    width, tube = bounds["nominal"], bounds["vehicle_to_nominal_position"]
    result |= {
        "copy_m": float(np.max(np.abs(message["copy"]))),
        "distance_m": float(np.max(separate)),
    }
    result |= {"inside": float(np.mean(worst <= width + tube))}
    return result | {
        name: float(np.mean(message[name])) for name in ("intervened", *FLAGS)
    }


def of_scripts(car, args, show):
    """Script -> summaries with the shield and without it."""
    roads, keys = episodes(car, args.drives, args.seconds, args.seed)
    bounds, result = car.certificate["corridor"]["bounds"], {}

    def filtered(kind, road, key):
        return drive(car, shielded(car, scripted(car, kind)), road, key)

    def free(kind, road, key):
        return drive(car, alone(car, scripted(car, kind)), road, key)

    ways = {
        name: jax.jit(jax.vmap(way, (None, 0, 0)))
        for name, way in (("with", filtered), ("without", free))
    }
    for kind in map(SCRIPTS.index, args.scripts):
        driven = {
            name: batches(partial(way, kind), roads, keys) for name, way in ways.items()
        }
        result[SCRIPTS[kind]] = {
            name: summary(*arrays, bounds) for name, arrays in driven.items()
        }
        show(SCRIPTS[kind], result[SCRIPTS[kind]])
    return result


def of_planner(car, args):
    """The policy's own planner with the shield and without it, on the same episodes."""
    roads, keys = episodes(car, args.episodes, args.seconds, args.seed + 1)
    bounds, result, rmse = car.certificate["corridor"]["bounds"], {}, {}
    for name, shield in (("with", True), ("without", False)):
        run = jax.jit(jax.vmap(partial(drive, car, planner(car, shield=shield))))
        lateral, message = batches(run, roads, keys)
        settled = lateral[:, 1 + round(SETTLED / car.plant.dt) :]
        rmse[name] = np.sqrt(np.mean(settled**2, axis=1))
        result[name] = summary(lateral, message, bounds) | {
            "rmse_m": float(np.mean(rmse[name]))
        }
    return result | {
        "rmse_ratio": result["with"]["rmse_m"] / result["without"]["rmse_m"]
    }


def step_times(car, rounds):
    """A control step of the policy's own planner with the shield and without it [ms]."""
    roads, keys = episodes(car, 1, 5.0, 0)
    road = jax.tree.map(lambda leaf: leaf[0], roads)
    window = first_reference(
        road, horizon=build.controller_horizon(car.settings), dt=car.plant.dt
    )

    def job(shield):
        controller = planner(car, shield=shield)
        act, state = jax.jit(controller.act), controller.init(keys[0])
        given = road.initial_state, road.envs[0], window
        _, state, _ = act(
            car.params, state, *given
        )  # the copy runs from the second step on
        return lambda: jax.block_until_ready(act(car.params, state, *given))

    times = harness.in_turn({"with": job(True), "without": job(False)}, rounds)
    return times | {
        "added_ms": times["with"]["median_ms"] - times["without"]["median_ms"]
    }


def main():
    """Parse, drive, print, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", nargs="+", required=True, metavar="DIR")
    for name, value in (
        ("drives", 200),
        ("episodes", 16),
        ("seed", 0),
        ("rounds", 100),
    ):
        parser.add_argument(f"--{name}", type=int, default=value)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument(
        "--scripts", nargs="*", default=SCRIPTS, choices=SCRIPTS, metavar="PLANNER"
    )
    parser.add_argument("--out")
    parser.add_argument("--time", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.time:
        print(json.dumps(step_times(load(args.runs[0]), args.rounds)))
        return
    settings = {
        key: getattr(args, key) for key in ("drives", "episodes", "seconds", "seed")
    }
    document = {
        "cars": {},
        "settings": settings,
        "asked": ASKED,
        "machine": harness.machine(),
    }
    for run in args.runs:
        car, words = load(run), ("--runs", run, "--time", "--rounds", args.rounds)
        about = {key: car.certificate[key] for key in ("alpha", "policy_sha256")}
        result = about | {"bounds": car.certificate["corridor"]["bounds"]}
        show = lambda label, both: print(
            car.plant.name, label, json.dumps(both), flush=True
        )
        result |= {
            "scripts": of_scripts(car, args, show),
            "planner": of_planner(car, args),
        }
        result |= {
            "step": harness.in_own_process(
                "benchmarks.quality.shield", *words, environment=ENVIRONMENT
            )
        }
        document["cars"][car.plant.name] = result
        harness.write(args.out, document)
    print(table(document))
    print("\n".join(misses(document)) or "all that was asked for")


if __name__ == "__main__":
    main()
