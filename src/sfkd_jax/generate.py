"""python -m sfkd_jax.generate: drive the training vehicle and store the data set."""

from __future__ import annotations

import time
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from sfkd_jax import artefacts, assembly, shelf
from sfkd_jax.config import door
from sfkd_jax.datasets import generate, split

SPLIT = ("shares", "env_low", "env_high", "seed")


def run(settings: dict[str, Any]) -> dict[str, Any]:
    """Generate the data set, unless it lies on the shelf already."""
    began = time.perf_counter()
    path, asked = shelf.dataset_path(settings), settings["dataset"]
    if artefacts.exists(path):
        dataset, _ = shelf.read_dataset(settings)
    else:
        shelf.say(f"generating {asked['segments']} segments")
        plant = assembly.build_vehicle(settings["vehicle"])
        drive_key, split_key = jax.random.split(jax.random.key(asked["seed"]))
        options = {name: value for name, value in asked.items() if name not in SPLIT}
        trajectories = jax.jit(partial(generate, plant, assembly.build_driver(plant), **options))(drive_key)
        low, high = jnp.asarray(asked["env_low"]), jnp.asarray(asked["env_high"])
        dataset = split(trajectories, split_key, shares=tuple(asked["shares"]), env_low=low, env_high=high)
        shelf.write_dataset(settings, dataset)
    return {
        "dataset": str(path),
        "segments": sum(getattr(dataset, part).controls.shape[0] for part in shelf.PARTS),
        "seconds": time.perf_counter() - began,
    }


if __name__ == "__main__":
    door(run)()
