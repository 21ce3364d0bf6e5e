"""Files of runs and of comparisons, as the commands write them, with made-up numbers."""

import json

import numpy as np
from helpers import WEIGHTS_SHA256, write_policy

from sfkd_jax import store

STEPS, DT = 60, 0.1
RMSE = {
    ("sfkd", "measured"): 0.020,
    ("sfkd_no_fiber", "none"): 0.060,
    ("koopman_mpc", "measured"): 0.090,
    ("icode_mppi", "measured"): 0.025,
    ("icode_mppi", "none"): 0.080,
    ("nominal", "none"): 0.120,
    ("oracle", "measured"): 0.016,
}
"""(system, env) -> RMSE on S3 [m]."""


def row(system, env="measured", scenario="s3", vehicle="kinematic", **more):
    mean = RMSE[system, env] * {"s1": 0.5, "s2": 0.8, "s3": 1.0}[scenario]
    gap = mean - RMSE["sfkd", "measured"]
    own = system == "sfkd"
    planner = "koopman_mpc" if system == "koopman_mpc" else "mppi"
    record = {
        "system": system, "model": system, "controller": planner, "planner": planner,
        "sampling": None if system == "koopman_mpc" else "feedback", "env": env,
        "scenario": scenario, "vehicle": vehicle, "inner_loop": "none",
        "seeds": [0], "episodes": 2, "episode_s": 12.0, "params": 12345,
        "alpha": 0.93207 if own else None,
        "rmse_m": {"mean": mean, "std": 0.1 * mean, "ci95": [0.9 * mean, 1.1 * mean], "median": mean},
        "max_deviation_m": 4 * mean, "smoothness_rad_per_s": 0.081, "departures": 0,
        "difference_to_sfkd": None if own else {"mean": gap, "ci95": [gap - 1e-3, gap + 1e-3], "p_holm": 0.01},
    }  # fmt: skip
    return record | more


def road():
    s = 0.5 * np.arange(2 * STEPS + 300)
    curvature = 0.02 * np.sin(2 * np.pi * s / 90)
    yaw = 0.5 * np.cumsum(curvature)
    x, y = 0.5 * np.cumsum(np.cos(yaw)), 0.5 * np.cumsum(np.sin(yaw))
    return np.stack([x, y, yaw, curvature], axis=1)


def arrays(size=0.05, episodes=2):
    """Episodes of a row whose deviation swings by `size` [m]."""
    path, time = road(), np.arange(STEPS + 1)
    offset = size * np.sin(0.15 * time)
    here = path[2 * time]
    x = here[:, 0] - offset * np.sin(here[:, 2])
    y = here[:, 1] + offset * np.cos(here[:, 2])
    states = np.stack([x, y, here[:, 2], np.full(STEPS + 1, 10.0)], axis=1)
    levels = np.array([[0.9, 0.0], [0.6, 4.0], [0.3, -8.0], [0.6, -4.0]])
    parts = {
        "lateral": offset[1:],
        "states": states,
        "envs": levels[np.arange(STEPS) // 15],
        "path": path,
    }
    return {name: np.stack([part] * episodes) for name, part in parts.items()}


BOXES = {"env": [[0.3, -8.0], [0.9, 8.0]], "control": None}


def certificate(*, alpha=0.93207, weights=WEIGHTS_SHA256, boxes=BOXES, **more):
    radii = [0.0123 * (1 - 0.93207**k) / (1 - 0.93207) for k in range(1, 21)]
    corridor = {
        "corridor_m": 0.14301, "level": 0.95,
        "coverage": {"share": 0.99, "ci95": [0.96, 1.0]},
        "runs": 150, "conditions": {"speed": [8.0, 10.5], "duration_s": 60.0},
    }  # fmt: skip
    measured = {
        "tube": {"latent": radii, "physical": {"position_m": radii}, "ultimate": 0.18115},
        "d_bar": {"one_step": {"latent": 0.0123}, "level": 0.95, "trajectories": 400},
        "boxes": boxes,
    }  # fmt: skip
    return {
        "valid": True, "proof": {"alpha": alpha}, "measured": measured, "corridor": corridor,
        "provenance": {"weights_sha256": weights},
    } | more  # fmt: skip


def keep_arrays(path, size):
    path.parent.mkdir(exist_ok=True)
    stored = arrays(size) | {"dt": np.asarray(DT)}
    store.write_arrays(path, stored, kind="episodes", config={})


def write_run(run, *, episodes=True, **changes):
    """A run directory; `results=None` leaves results.json out."""
    run.mkdir(parents=True, exist_ok=True)
    ahead = list(range(1, 21))
    settings = {
        "experiment": "s3",
        "seed": 0,
        "model": {"system": "sfkd"},
        "vehicle": {"name": "kinematic"},
    }
    systems = ("sfkd", "measured"), ("nominal", "none"), ("oracle", "measured")
    rows = [row(*one) for one in systems]
    for one, size in zip(rows, (0.05, 2.0, 0.02) if episodes else (), strict=False):
        one["arrays"] = f"episodes/{one['system']}.safetensors"
        keep_arrays(run / one["arrays"], size)
    documents = {
        "policy": {"config": settings, "versions": {"jax": "1"}},
        "settings": settings,
        "open_loop": {
            "steps": ahead, "dt": DT, "trajectories": 320,
            "position_rmse_m": [0.001 * k**2 for k in ahead],
            "baselines": {"kinematic_bicycle": {"position_rmse_m": [0.002 * k**2 for k in ahead]}},
        },
        "certificate": certificate(),
        "results": {"rows": rows, "config": {"command": "python -m sfkd_jax.train"}},
    }  # fmt: skip
    for name, document in (documents | changes).items():
        if name == "policy":
            write_policy(run, document)
        elif document is not None:
            (run / f"{name}.json").write_text(json.dumps(document))
    lines = [{"step": k, "loss": 10.0 / k, "validation_loss": None} for k in (1, 2, 3)]
    (run / "metrics.jsonl").write_text("".join(json.dumps(one) + "\n" for one in lines))
    return run


def write_comparison(directory, *, episodes=True, rows=None, **config):
    """A comparison directory: all systems on three scenarios and two vehicles."""
    directory.mkdir(parents=True, exist_ok=True)
    rows = rows or [
        row(*system, scenario, vehicle, arrays=f"cells/{number}.safetensors")
        for number, system in enumerate(RMSE)
        for scenario in ("s1", "s3")
        for vehicle in ("kinematic", "dynamic")
    ]
    document = {"rows": rows, "config": {"name": "table1"} | config, "failed": {}}
    (directory / "results.json").write_text(json.dumps(document))
    for number in range(len(RMSE)) if episodes else ():
        keep_arrays(directory / f"cells/{number}.safetensors", 0.02 * (1 + number))
    return directory
