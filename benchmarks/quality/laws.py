"""Trained policies driven by MPPI around different laws, samplers and numbers of samples, on the same episodes.

python -m benchmarks.quality.laws RUN ... [--scenarios s2 s3 --episodes 32 --seconds 15 --only
LABEL ... --out FILE] RUN: directories with policy.npz in them. Differences are to the
first contender, with a paired 95 % interval.
"""

import argparse
import json
import time
from functools import partial

import jax
import numpy as np

import sfkd_jax
from sfkd_jax import control, evaluation, scenarios
from sfkd_jax.build import build_vehicle

SENSORS = (0.015, 0.015, 0.002, 0.03, 0.02, 0.002, 0.001)
SPREAD = (0.02, 0.3)
WHITE = {"noise": "white"}
KNOTS = {"noise": "rbf", "noise_knots": 4}
CURVED = WHITE | {"curvature": True}


def tenth(samples, **options):
    """Options under which a tenth of the samples counts, at most 30."""
    return {"effective_samples": min(30.0, samples / 10), **options}


CONTENDERS = {
    "feedback, 1500, white": ("feedback", 1500, WHITE),
    "feedback, 1500": ("feedback", 1500, {}),
    "feedback, 300, white": ("feedback", 300, WHITE),
    "feedback, 300": ("feedback", 300, {}),
    "feedback, 300, 30 effective": ("feedback", 300, tenth(300)),
    "feedback, 75, 7.5 effective": ("feedback", 75, tenth(75)),
    "feedback, 300, knots": ("feedback", 300, tenth(300, **KNOTS)),
    "feedback, 300, curvature": ("feedback", 300, tenth(300, **CURVED)),
    "feedback, 300, ancillary": ("ancillary", 300, {}),
    "feedback, 75, ancillary": ("ancillary", 75, tenth(75)),
    "feedback, 300, curvature, ancillary": ("ancillary", 300, tenth(300, **CURVED)),
    "model, 1500": ("model", 1500, {}),
    "model, 300": ("model", 300, {}),
    "model, 300, 30 effective": ("model", 300, tenth(300)),
    "model, 75, 7.5 effective": ("model", 75, tenth(75)),
    "model, 300, knots": ("model", 300, tenth(300, **KNOTS)),
    "model, 300, curvature": ("model", 300, tenth(300, **CURVED)),
    "model, 150, curvature": ("model", 150, tenth(150, **CURVED)),
    "model, 75, curvature": ("model", 75, tenth(75, **CURVED)),
    "model, 50, curvature": ("model", 50, tenth(50, **CURVED)),
    "model, alone": ("model", 1, {"noise_std": (1e-6, 1e-6)}),
}
"""Label -> law, number of samples, options of the planner."""


def planner_of(policy, plant, law, samples, options):
    """One contender."""
    model_law = control.ModelLaw(dt=plant.dt)
    laws = {
        "model": model_law,
        "feedback": control.path_feedback(wheelbase=plant.wheelbase),
    }
    task = control.path_tracking(
        policy.model,
        control.tracking_cost(dt=plant.dt),
        laws["model" if law == "model" else "feedback"],
        dt=plant.dt,
        control_low=plant.control_low,
        control_high=plant.control_high,
        ancillary=model_law if law == "ancillary" else None,
    )
    box = {
        side: tuple(policy.settings["dataset"][side])
        for side in ("env_low", "env_high")
    }
    return control.mppi(
        task, num_samples=samples, **{"noise_std": SPREAD, **box, **options}
    )


def drive(policy, plant, planner, roads, keys):
    """Lateral RMSE of every episode [mm], and the mean steering rate [rad/s]."""
    run = partial(
        evaluation.simulate,
        plant.step,
        planner,
        policy.params,
        dt=plant.dt,
        horizon=20,
        observation_noise=SENSORS,
    )
    episodes = jax.jit(evaluation.over_episodes(run))(roads, keys)
    rate = (
        np.abs(np.diff(np.asarray(episodes.controls)[..., 0], axis=1)).mean() / plant.dt
    )
    return 1e3 * np.sqrt((np.asarray(episodes.lateral) ** 2).mean(axis=1)), float(rate)


def episodes_of(plant, scenario, args):
    """Roads of a scenario and the keys of their drives, from a seed."""
    road_key, drive_key = jax.random.split(jax.random.key(args.seed))
    family = scenarios.scenario(
        name=scenario,
        duration=args.seconds,
        state_size=len(plant.state_names),
        dt=plant.dt,
    )
    roads = jax.jit(jax.vmap(family))(jax.random.split(road_key, args.episodes))
    return roads, jax.random.split(drive_key, args.episodes)


def compared(run, scenario, args):
    """Rows of one policy on one scenario; printed as they come."""
    policy = sfkd_jax.load(run)
    plant = build_vehicle(policy.settings["vehicle"])
    roads, keys = episodes_of(plant, scenario, args)
    first = None
    for label in args.only:
        began = time.perf_counter()
        result, rate = drive(
            policy, plant, planner_of(policy, plant, *CONTENDERS[label]), roads, keys
        )
        assert np.all(np.isfinite(result))
        first = result if first is None else first
        row = {
            "vehicle": plant.name,
            "scenario": scenario,
            "label": label,
            "rmse_mm": [float(rmse) for rmse in result],
        }
        row |= {
            "steering_rate": rate,
            "difference_mm": evaluation.paired_difference(result, first),
        }
        low, high = row["difference_mm"]["ci95"]
        print(
            f"{plant.name:9} {scenario} {label:36} {result.mean():6.1f} mm  {result.mean() - first.mean():+6.1f}",
            end=" ",
        )
        print(
            f"({low:+.1f}, {high:+.1f})  {rate:.3f} rad/s  {time.perf_counter() - began:.0f} s",
            flush=True,
        )
        yield row


def main():
    """Parse, drive, print, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("runs", nargs="+", metavar="RUN")
    parser.add_argument("--scenarios", nargs="+", default=["s2", "s3"])
    parser.add_argument("--episodes", type=int, default=32)
    parser.add_argument("--seconds", type=float, default=15.0)
    parser.add_argument("--seed", type=int, default=2026)
    parser.add_argument(
        "--only",
        nargs="+",
        default=list(CONTENDERS),
        choices=list(CONTENDERS),
        metavar="LABEL",
    )
    parser.add_argument("--out")
    args = parser.parse_args()
    rows = [
        row
        for run in args.runs
        for scenario in args.scenarios
        for row in compared(run, scenario, args)
    ]
    if args.out:
        settings = {key: getattr(args, key) for key in ("episodes", "seconds", "seed")}
        with open(args.out, "w") as file:
            json.dump(
                {"rows": rows, "settings": settings, "jax": jax.__version__},
                file,
                indent=1,
            )


if __name__ == "__main__":
    main()
