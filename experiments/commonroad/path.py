"""Drive CommonRoad's drift car along paths with the package's own functions: does it stay in its certified corridor?

python -m experiments.commonroad.path [--root runs --drives 40 --out
experiments/commonroad] experiments/commonroad/path.sh makes the policy first. Law,
model and certificate come from `commonroad_traced`; the drives here are of the class of
its certificate and of `adapters.commonroad_vehicle`, which nothing before has met.
"""

import argparse
import json
import sys
import time
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from experiments.commonroad import traced_car
from sfkd_jax import adapters, policy, store
from sfkd_jax.certification import corridor_coverage, output_metrics_from
from sfkd_jax.control import law_to_arrays
from sfkd_jax.corridor import drive_measurement, drive_options, policy_loop
from sfkd_jax.data import drive_switching
from sfkd_jax.geometry import (
    CURVATURE,
    PATH_SPEED,
    PERTURBATION,
    REFERENCE_SPEED,
    vehicle_state,
)
from sfkd_jax.types import BODY, Trajectory

RUN = Path("commonroad_path", "sfkd_path", "seed=0")
SEED = 11
BATCH = 10
"""Drives of the package at once: minutes."""
STEPS_COMPARED = 300


def collect(loop, about, drives, directory):
    """Drives of a class on a loop, in batches that are kept: after an interruption the
    same command continues.
    """
    options = drive_options(loop, about, about["duration_s"]) | {
        "dwell": tuple(about["dwell_s"]),
        "drives": BATCH,
    }
    options |= dict(
        zip(("env_low", "env_high"), map(tuple, about["env_box"]), strict=True)
    )
    drive = jax.jit(partial(drive_switching, loop.plant, **options))
    law = store.sha256(
        {
            name: np.asarray(table).tolist()
            for name, table in law_to_arrays(loop.law).items()
        }
    )
    parts = []
    for index in range(drives // BATCH):
        path, config = (
            directory / f"{index}.npz",
            {"class": about, "law": law, "index": index, "seed": SEED},
        )
        if not store.exists(path):
            began = time.perf_counter()
            made = jax.tree.map(
                np.asarray, drive(jax.random.fold_in(jax.random.key(SEED), index))
            )
            path.parent.mkdir(parents=True, exist_ok=True)
            store.write_arrays(path, made._asdict(), kind="drives", config=config)
            print(
                f"{BATCH} drives in {time.perf_counter() - began:.0f} s",
                file=sys.stderr,
                flush=True,
            )
        saved = store.read_arrays(path, kind="drives", config=config)[0]
        parts.append(
            Trajectory(**{name: jnp.asarray(leaf) for name, leaf in saved.items()})
        )
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)


def driven(trained, certificate, drives, directory):
    """Drives of the certified class by the package's car; their scores under the
    certified bounds.
    """
    about = certificate["corridor"]["class"]
    loop = policy_loop(
        adapters.commonroad_vehicle(model="std"), trained, about["sensor_noise"]
    )
    made = collect(loop, about, drives, directory)
    measured = drive_measurement(loop, output_metrics_from(certificate["outputs"]))(
        made, jax.random.key(SEED + 1)
    )
    bounds, lateral = certificate["corridor"]["bounds"], np.abs(measured.lateral)
    result = corridor_coverage(bounds, measured.scores)
    result |= {
        "lateral_m": float(lateral.max()),
        "distance_m": float(np.abs(measured.lateral - measured.copied).max()),
        "inside_corridor": int(
            np.sum(lateral.max(axis=1) <= certificate["corridor"]["corridor_m"])
        ),
        "slowest_m_per_s": float(made.states[..., BODY][..., PATH_SPEED].min()),
    }
    return result, made


def compared(trained, made):
    """One step of the traced car beside the package's, from states and controls of
    those drives.
    """
    chosen = np.random.default_rng(SEED).choice(
        made.controls[..., 0].size, STEPS_COMPARED, replace=False
    )
    states, inputs, envs = (
        jnp.asarray(np.asarray(leaf).reshape(-1, leaf.shape[-1])[chosen])
        for leaf in (made.states[:, :-1, BODY], made.controls, made.envs)
    )
    args = jax.vmap(trained.law)(
        states, inputs[:, CURVATURE], inputs[:, REFERENCE_SPEED], envs
    )
    low, high = (
        jnp.asarray(getattr(trained.vehicle, name))
        for name in ("control_low", "control_high")
    )
    controls = jnp.clip(args + inputs[:, PERTURBATION], low, high)
    separate = traced_car.disagreement(jax.vmap(vehicle_state)(states), controls, envs)
    return {"steps": STEPS_COMPARED, "largest": separate}


def main():
    """Parse, drive, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--root", type=Path, default=Path("runs"))
    parser.add_argument("--drives", type=int, default=40)
    parser.add_argument("--out", type=Path, default=Path("experiments/commonroad"))
    given = parser.parse_args()
    trained = policy.restore(given.root / RUN)
    certificate, reason = policy.read_certificate(given.root / RUN, trained)
    if certificate is None or "corridor" not in certificate:
        raise SystemExit(
            f"{given.root / RUN}: {reason or 'no corridor in its certificate'}; run path.sh first"
        )
    result, made = driven(
        trained, certificate, given.drives, given.root / RUN.parts[0] / "package"
    )
    saved = {
        name: certificate[name]
        for name in (
            "alpha",
            "outputs",
            "boxes",
            "corridor",
            "seconds",
            "policy_sha256",
        )
    }
    saved["outputs"] = {
        name: {key: value for key, value in claim.items() if key != "witness"}
        for name, claim in saved["outputs"].items()
    }
    document = {
        "certificate": saved,
        "package": result,
        "step": compared(trained, made),
    }
    document |= {"settings": trained.settings, "versions": store.versions()}
    store.write_json(given.out / "path.json", document)
    print(json.dumps({"results": str(given.out / "path.json"), **result}))


if __name__ == "__main__":
    main()
