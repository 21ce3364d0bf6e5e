"""Train a shipped policy on with drives of a CommonRoad car, and certify it again."""

import sys
import time
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

import sfkd_jax
from sfkd_jax import (
    adapters,
    build,
    certification,
    evaluation,
    policy,
    store,
)
from sfkd_jax import (
    data as datasets,
)
from sfkd_jax.pipeline import runs
from sfkd_jax.training import fit, multi_step_loss
from sfkd_jax.types import Trajectory

SHARES = (0.6, 0.1, 0.2, 0.1)
LEVEL = 0.95
"""Of the conformal bounds and of the monitor: 40 calibration drives carry no higher
one.
"""
FIT = {"learning_rate": 3e-4, "log_every": 50, "save_every": 50}
WINDOWS = {"batch": 128, "length": 20}
SEED = 7
"""Of drives, splits and windows: another than that of the roads that are evaluated on."""


def collect(plant, args, segments, path):
    """Drives of 5 s as our own data sets have them: S1 and S2 with levels drawn per
    drive, both controls excited.
    """
    if not store.exists(path):
        began = time.perf_counter()
        drive = jax.jit(
            partial(
                datasets.generate,
                plant,
                build.build_driver(plant),
                segments=segments,
                steps=50,
            )
        )
        driven = jax.tree.map(np.asarray, drive(jax.random.key(SEED)))
        path.parent.mkdir(parents=True, exist_ok=True)
        store.write_arrays(
            path,
            driven._asdict(),
            kind="drives",
            config={"segments": segments, "seed": SEED},
        )
        print(
            f"collected {segments} drives in {time.perf_counter() - began:.0f} s",
            file=sys.stderr,
            flush=True,
        )
    driven = Trajectory(**store.read_arrays(path, kind="drives")[0])
    whole = np.isfinite(driven.states).all(axis=(1, 2))
    box = {
        f"env_{side}": jnp.asarray(args["dataset"][f"env_{side}"])
        for side in ("low", "high")
    }
    saved = jax.tree.map(lambda leaf: jnp.asarray(leaf[whole]), driven)
    return datasets.split(saved, jax.random.key(SEED + 1), shares=SHARES, **box), int(
        whole.sum()
    )


def seen(data, states):
    """The same drives as a model of so many states is told of them."""
    parts = {name: getattr(data, name) for name in runs.PARTS}
    parts = {
        name: part._replace(
            states=adapters.commonroad_observation(part.states, states=states)
        )
        for name, part in parts.items()
    }
    return data._replace(**parts)


def tune(trained, data, args, directory, steps):
    """Train on from the policy's own parameters, certify and store; how it went."""
    began, settings = time.process_time(), trained.settings
    space = build.space_from_settings(settings["space"])
    loss = multi_step_loss(trained.model, space, **settings["training"]["loss"])
    draw = partial(datasets.random_windows, **WINDOWS)
    held_out = datasets.spread_windows(data.validation, length=WINDOWS["length"])
    start = trained.model._replace(init=lambda key: trained.weights)
    key = jax.random.key(SEED + 2)
    params, best = fit(
        start, loss, draw, data.train, held_out, key, directory, steps=steps, **FIT
    )
    directory.mkdir(parents=True, exist_ok=True)
    spent = time.process_time() - began
    proof = certification.issue(
        trained.model,
        params,
        **{name: getattr(data, name) for name in ("validation", "calibration")},
        held_out={"test": data.test},
        boxes=runs.boxes(data),
        sensor_noise=tuple(args["evaluation"]["observation_noise"]),
        level=LEVEL,
        monitor_level=LEVEL,
    )
    manifest = policy.save(
        directory / "policy.npz", params, settings | {"best_step": best}, made_from={}
    )
    about = {
        "weights_sha256": manifest["sha256"],
        "policy_sha256": policy.policy_hash(manifest),
    }
    store.write_json(directory / "certificate.json", proof | about)
    errors = {"before": trained.params, "after": params}
    predict = jax.jit(
        partial(evaluation.open_loop, trained.model, horizon=WINDOWS["length"])
    )
    result = {
        name: jnp.hypot(*predict(weights, data.test).T[:2])[-1].item()
        for name, weights in errors.items()
    }
    print(
        f"tuned to step {best} in {spent:.0f} s: {result}", file=sys.stderr, flush=True
    )
    d_bar = {"d_bar": proof["d_bar"]["value"], "coverage": proof["d_bar"]["coverage"]}
    return {
        "best_step": best,
        "cpu_seconds": spent,
        "alpha": proof["alpha"],
        **d_bar,
        "position_rmse_2s_m": result,
    }


def tune_all(before, plant, args, root, *, segments, steps):
    """Every policy on the same drives of one car; what an earlier run of the same sizes
    finished is read.
    """
    data, whole = collect(plant, args, segments, root / f"drives-{segments}.npz")
    after, records = {}, {"drives": whole}
    for row, trained in before.items():
        directory = root / f"{row}-{segments}-{steps}"
        record = directory / "record.json"
        if not record.exists():
            states = len(build.build_vehicle(trained.settings["vehicle"]).state_names)
            store.write_json(
                record, tune(trained, seen(data, states), args, directory, steps)
            )
        after[row], records[row] = sfkd_jax.load(directory), store.read_json(record)
    return after, records
