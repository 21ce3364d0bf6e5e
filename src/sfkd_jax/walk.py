"""The steps of the walk that several doors need: what is missing is made, what lies there is checked."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from sfkd_jax import artefacts, assembly, policy, shelf
from sfkd_jax.datasets import Dataset, generate, measure_space, random_windows, split, spread_windows
from sfkd_jax.evaluation import open_loop
from sfkd_jax.training import fit, multi_step_loss

SPLIT = ("shares", "env_low", "env_high", "seed")


def ensure_dataset(settings: dict[str, Any]) -> tuple[Dataset, str]:
    """The data set and its hash, driven now if it does not lie on the shelf."""
    asked = settings["dataset"]
    if not artefacts.exists(shelf.dataset_path(settings)):
        shelf.say(f"generating {asked['segments']} segments")
        plant = assembly.build_vehicle(settings["vehicle"])
        drive_key, split_key = jax.random.split(jax.random.key(asked["seed"]))
        options = assembly.without(asked, *SPLIT)
        trajectories = jax.jit(partial(generate, plant, assembly.build_driver(plant), **options))(drive_key)
        low, high = jnp.asarray(asked["env_low"]), jnp.asarray(asked["env_high"])
        dataset = split(trajectories, split_key, shares=tuple(asked["shares"]), env_low=low, env_high=high)
        shelf.write_dataset(settings, dataset)
    return shelf.read_dataset(settings)


def ensure_policy(settings: dict[str, Any]) -> policy.Policy:
    """The policy of this run: from the shelf, or trained now, continuing what was begun.

    Raises:
        ArtefactError: what lies there was made with other settings, or is damaged.
    """
    place = shelf.run_directory(settings)
    shelf.claim(settings)
    if not artefacts.exists(place / "policy.npz"):
        _train(settings)
    return policy.load(place)


def _train(settings: dict[str, Any]) -> None:
    """Fit, then store the best weights and their prediction error on the test split."""
    place, options = shelf.run_directory(settings), dict(settings["training"])
    dataset, data_hash = ensure_dataset(settings)
    space = measure_space(dataset)
    model = assembly.build_model(settings["model"], space)
    loss, horizon = multi_step_loss(model, space, **options.pop("loss")), options.pop("window")
    draw = partial(random_windows, batch=options.pop("batch"), length=horizon)
    held_out = spread_windows(dataset.validation, length=horizon)
    shelf.say(f"training {settings['model']['system']}, {options['steps']} steps, in {place}")
    key = jax.random.fold_in(jax.random.key(settings["seed"]), 0)
    params, best = fit(model, loss, draw, dataset.train, held_out, key, place, **options)
    errors = jax.jit(partial(open_loop, model, horizon=horizon))(params, dataset.test)
    document = shelf.open_loop_document(errors, dataset.test, settings["vehicle"]["dt"])
    artefacts.write_json(place / "open_loop.json", document)
    kept = shelf.identity(settings) | {"controller": settings["controller"], "experiment": settings["name"]}
    kept |= {"space": assembly.space_to_settings(space), "best_step": best}
    policy.save(place / "policy.npz", params, kept, made_from={"dataset": data_hash})
