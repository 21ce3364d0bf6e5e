"""The steps of the walk that several doors need: what is missing is made, what lies there is checked."""

from __future__ import annotations

import json
import math
from functools import lru_cache, partial
from typing import Any

import jax
import jax.numpy as jnp

from sfkd_jax import artefacts, build, policy
from sfkd_jax.certification import progress
from sfkd_jax.datasets import (
    Columns,
    Dataset,
    check_on_path,
    first_share,
    from_logs,
    measure_space,
    random_windows,
    split,
    spread_windows,
)
from sfkd_jax.evaluation import open_loop
from sfkd_jax.pipeline import path_law, store
from sfkd_jax.training import fit, multi_step_loss
from sfkd_jax.types import Model, Trajectory
from sfkd_jax.vehicle import Vehicle

SPLIT = ("shares", "env_low", "env_high", "seed")
STARTS = ("random", "identified")
START = 1
"""Folded into the run's seed; initial weights and windows take the stream 0."""
SWITCHING = 2
"""Folded into the data set's seed; driving and splitting it take the streams 0 and 1."""


def ensure_dataset(settings: dict[str, Any]) -> tuple[Dataset, str]:
    """The data set and its hash, read from logs or driven now if it does not lie on the shelf."""
    path = store.dataset_path(settings)
    if not artefacts.exists(path):
        with artefacts.locked(
            path.parent, wait=True
        ):  # whoever makes it now makes it for all
            if not artefacts.exists(path):
                dataset = (
                    _from_logs(settings)
                    if store.is_logged(settings)
                    else _driven(settings)
                )
                store.write_dataset(settings, dataset)
    return store.read_dataset(settings)


def _driven(settings: dict[str, Any]) -> Dataset:
    """A data set that the vehicle's own step drives."""
    asked = settings["dataset"]
    drive_key, split_key = jax.random.split(jax.random.key(asked["seed"]))
    options = build.as_kwargs(asked, *SPLIT, "law")
    drives = path_law.drives(settings, options)
    artefacts.print_message(f"generating {asked['segments']} segments")
    trajectories = jax.jit(drives)(drive_key)
    if store.is_along_path(settings):
        check_on_path(trajectories)
    low, high = jnp.asarray(asked["env_low"]), jnp.asarray(asked["env_high"])
    return split(
        trajectories,
        split_key,
        shares=tuple(asked["shares"]),
        env_low=low,
        env_high=high,
    )


def _from_logs(settings: dict[str, Any]) -> Dataset:
    """A data set from logs; what they cover is said, and kept beside it."""
    asked, plant = settings["dataset"], build.build_vehicle(settings["vehicle"])
    columns = Columns(**build.as_kwargs(asked["columns"]))
    if len(columns.state) != len(plant.state_names):
        named = f"vehicle {plant.name} has {', '.join(plant.state_names)}"
        raise ValueError(
            f"dataset.columns.state names {len(columns.state)} columns, {named}; name as many, in this order"
        )
    artefacts.print_message(f"reading {asked['path']}")
    known = {
        "dt": plant.dt,
        "wheelbase": plant.wheelbase,
        "told": store.has_environment(settings),
    }
    known["limits"] = (plant.control_low or None, plant.control_high or None)
    logged = from_logs(
        asked["path"],
        columns,
        say=artefacts.print_message,
        **known,
        **build.as_kwargs(asked, "path", "columns"),
    )
    artefacts.write_json(
        store.dataset_path(settings).with_name("coverage.json"), logged.coverage
    )
    return logged.dataset


def _check_enough(settings: dict[str, Any]) -> None:
    """Refuse logs, or levels that so few segments cannot support, before a run is begun.

    Raises:
        ValueError: naming the settings and the levels that can be asked for.
    """
    count = ensure_dataset(settings)[0].calibration.controls.shape[0]
    asked = {
        name: settings["certification"][name] for name in ("level", "monitor_level")
    }
    if most := [
        name for name, level in asked.items() if math.ceil((count + 1) * level) > count
    ]:
        wanted = " ".join(f"certification.{name}={asked[name]:g}" for name in most)
        possible = " ".join(
            f"certification.{name}={math.floor(100 * count / (count + 1)) / 100:g}"
            for name in most
        )
        raise ValueError(
            f"{count} calibration segments are too few for {wanted}: record more, or pass {possible}"
        )


def held_out_parts(
    settings: dict[str, Any], dataset: Dataset
) -> dict[str, Trajectory]:
    """What coverage is counted on: the test split, its S1 and S2 parts, and as many drives under S3's switching.

    Of logged drives the test split alone: where they were driven has no name, and
    nothing drives them elsewhere.
    """
    if store.is_logged(settings):
        return {"test": dataset.test}
    constant = jnp.all(dataset.test.envs == dataset.test.envs[:, :1], axis=(1, 2))
    asked = {name: settings[name] for name in ("vehicle", "dataset", "root")}
    asked |= {"segments": dataset.test.controls.shape[0]}
    parts = {"test": dataset.test, "s3": _switching(json.dumps(asked))}
    for name, chosen in (("s1", constant), ("s2", ~constant)):
        if chosen.any():
            parts[name] = jax.tree.map(
                lambda leaf, chosen=chosen: leaf[chosen], dataset.test
            )
    return parts


@lru_cache(maxsize=4)
def _switching(asked: str) -> Trajectory:
    """Drives under S3's switching, of these settings as JSON; kept, for every row of a comparison asks for the same."""
    settings = json.loads(asked)
    data = settings["dataset"] | {"segments": settings["segments"]}
    options = build.as_kwargs(data, *SPLIT, "law", "fixed_levels")
    drive = jax.jit(path_law.drives(settings, options, switching=True))
    return drive(jax.random.fold_in(jax.random.key(data["seed"]), SWITCHING))


def ensure_policy(settings: dict[str, Any]) -> policy.TrainedModel:
    """The policy of this run: from the shelf, or trained now, continuing what was begun.

    Raises:
        ArtefactError: what lies there was made with other settings, is damaged, or is
            being trained by another process.
    """
    place = store.run_directory(settings)
    if not artefacts.exists(place / "policy.npz"):
        if store.is_logged(settings):
            _check_enough(settings)
        with artefacts.locked(place):
            store.claim(settings)
            if not artefacts.exists(place / "policy.npz"):
                _train(settings)
    store.claim(settings)
    return policy.restore(place)


def systems(settings: dict[str, Any], plant: Vehicle) -> dict[str, build.System]:
    """The systems that `evaluation.systems` asks for; "self" is the policy of this run, made if it is missing."""
    references, found = build.reference_systems(plant, path_law.ensure(settings)), {}
    for name in settings["evaluation"]["systems"]:
        if name == "self":
            found[settings["model"]["system"]] = policy_system(settings)
        else:
            found[name] = build.choose(
                references | {"self": None}, name, "evaluation.systems entry"
            )
    return found


def policy_system(settings: dict[str, Any]) -> build.System:
    """The policy of this run as a row of a table, with its certificate if there is one.

    Raises:
        ValueError: there is none, and the monitor's fallback asks for one.
    """
    trained, fallback = (
        ensure_policy(settings),
        settings["controller"].get("monitor", {}).get("fallback", "none"),
    )
    certificate, reason = policy.read_certificate(
        store.run_directory(settings), trained
    )
    if certificate is None:
        artefacts.print_message(f"nothing is certified and nothing is monitored: {reason}")
        if fallback != "none":
            raise ValueError(
                f"controller.monitor.fallback={fallback} needs a certificate; {reason}"
            )
    told = settings["env_source"] if trained.settings["model"]["environment"] else "none"
    return build.System(trained.model, trained.params, told, certificate, trained.law)


def _train(settings: dict[str, Any]) -> None:
    """Fit, then store the best weights and their prediction error on the test split."""
    place, options = store.run_directory(settings), dict(settings["training"])
    dataset, data_hash = ensure_dataset(settings)
    kept = store.policy_settings(settings, dataset)
    dataset = dataset._replace(
        train=first_share(dataset.train, options.pop("data_share"))
    )
    space = measure_space(dataset)
    model = build.build_model(
        settings["model"], space, build.build_vehicle(settings["vehicle"])
    )
    horizon, start = options.pop("window"), options.pop("start", "random")
    key = jax.random.fold_in(jax.random.key(settings["seed"]), 0)
    if model.identify is not None:
        artefacts.print_message(f"identifying {settings['model']['system']} in {place}")
        params, best = model.identify(dataset.train, dataset.validation, key), None
    else:
        loss = multi_step_loss(model, space, **options.pop("loss"))
        draw = partial(random_windows, batch=options.pop("batch"), length=horizon)
        held_out = spread_windows(dataset.validation, length=horizon)
        artefacts.print_message(
            f"training {settings['model']['system']}, {options['steps']} steps, in {place}"
        )
        options["inspect"] = partial(progress, model)
        begun = _started(model, start, dataset.train, settings["seed"])
        params, best = fit(
            begun, loss, draw, dataset.train, held_out, key, place, **options
        )
    predict = jax.jit(
        lambda params, data: open_loop(model, model.fold(params), data, horizon=horizon)
    )
    errors = predict(params, dataset.test)
    document = store.open_loop_document(errors, dataset.test, settings["vehicle"]["dt"])
    artefacts.write_json(place / "open_loop.json", document)
    kept |= {"controller": settings["controller"], "experiment": settings["name"]}
    kept |= {"space": build.space_to_settings(space), "best_step": best}
    policy.save(
        place / "policy.npz",
        params,
        kept,
        made_from={"dataset": data_hash},
        law=path_law.ensure(settings),
    )


def _started(model: Model, start: str, train: Trajectory, seed: int) -> Model:
    """The model that training starts from: as drawn, or with the linear part that regression finds for it.

    Raises:
        ValueError: a start that there is not, or that this model does not have.
    """
    if start not in STARTS:
        raise ValueError(
            f"training.start must be one of {', '.join(STARTS)}, got {start!r}"
        )
    if start == "random":
        return model
    if model.start is None:
        raise ValueError(
            "training.start=identified needs a model=sfkd…, whose linear part can be identified"
        )
    start_from, key = model.start, jax.random.fold_in(jax.random.key(seed), START)
    return model._replace(init=lambda drawn: start_from(model.init(drawn), train, key))
