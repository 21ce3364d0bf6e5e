"""A vehicle of logs: a model of one step that is fitted to them drives in its place."""

from __future__ import annotations

import time
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sfkd_jax import build, models, store
from sfkd_jax.build import LoggedVehicleSettings, VehicleSettings
from sfkd_jax.data import (
    PARTS,
    Columns,
    Dataset,
    LoggedDataset,
    fingerprint,
    from_logs,
    measure_space,
    random_windows,
)
from sfkd_jax.evaluation import open_loop
from sfkd_jax.experiment.options import EnvironmentSettings, LogSettings, Settings
from sfkd_jax.settings import arguments, replace
from sfkd_jax.training import descend, one_step_loss
from sfkd_jax.types import Key, Model, Params, Step

REGRESSION = 16_000
"""Optimiser steps of the model that a law is derived from."""
STEEPEST = ("peak_curvature", "lateral_acceleration", "acceleration")
"""Settings of drives that end where the logs of a vehicle do."""
LIMITS, HEADROOM = ("control_low", "control_high"), 1.5
"""Of the actuators: if they are not given, this many times as wide as in the logs."""
HORIZON = 20
"""Steps ahead at which models are compared."""


def read(
    vehicle: VehicleSettings,
    environment: EnvironmentSettings,
    logs: LogSettings | LoggedVehicleSettings,
) -> LoggedDataset:
    """Read the logs of a vehicle."""
    plant = build.build_vehicle(vehicle)
    columns = Columns(**arguments(logs.columns, Columns))
    if len(columns.state) != len(plant.state_names):
        raise ValueError(
            f"dataset.columns.state names {len(columns.state)} columns, "
            f"vehicle {plant.name} has {', '.join(plant.state_names)}; "
            "name as many, in this order"
        )
    store.print_message(f"reading {logs.path}")
    options: Any = arguments(logs, from_logs)
    options |= {"dt": plant.dt, "wheelbase": plant.wheelbase}
    return from_logs(
        str(logs.path),
        columns,
        report=store.print_message,
        needs_environment=environment.is_known,
        limits=(plant.control_low or None, plant.control_high or None),
        **environment.box,
        **options,
    )


def with_identified(settings: Settings) -> Settings:
    """Return the settings with a model in place of a vehicle that is known from logs.

    Its limits, the box of e and the class of drives become those that the logs reach:
    beyond them a model extrapolates. Other settings are returned as they are.
    """
    vehicle, environment = settings.vehicle, settings.environment
    if not isinstance(vehicle, LoggedVehicleSettings):
        return settings
    if vehicle.path is None:
        raise ValueError("vehicle=logged needs vehicle.path=FOLDER, where its logs are")
    vehicle = replace(vehicle, contents=fingerprint(vehicle.path))
    about = store.plain({"vehicle": vehicle, "environment": environment.box})
    del about["vehicle"]["path"]
    about["environment_known"] = environment.is_known
    names = vehicle.columns.environment if environment.is_known else ()
    folder = f"logged-{store.sha256(about)[:8]}"
    path = Path(settings.root) / "vehicles" / folder / "vehicle.safetensors"
    with store.locked(path.parent, wait=True):  # other runs share the vehicle
        if not path.is_file():
            logged = read(vehicle, environment, vehicle).dataset
            low, high = map(np.asarray, (logged.env_low, logged.env_high))
            if not names:  # nothing depends on what nobody measured
                low, high = -np.ones_like(low), np.ones_like(high)
            if (still := low == high).any():
                raise ValueError(
                    f"{names[int(still.argmax())]} is always the same in the logs: "
                    "leave it out of vehicle.columns.environment"
                )
            arrays = _identify(logged, vehicle.dt)
            arrays |= {"env_low": low, "env_high": high}
            store.write_arrays(path, arrays, kind=build.IDENTIFIED, config=about)
    arrays, _ = store.read_arrays(path, kind=build.IDENTIFIED, config=about)
    reached = {name: np.asarray(value).tolist() for name, value in arrays.items()}
    limits = {name: getattr(vehicle, name) or reached[name] for name in LIMITS}
    scenario: Any = settings.scenario
    box = {"low": reached["env_low"], "high": reached["env_high"]}
    box |= {"names": environment.names or names}
    slowest, fastest = reached["speed"]
    return replace(
        settings,
        vehicle=replace(vehicle, identified=str(path), **limits),
        environment=replace(environment, **box),
        scenario=replace(scenario, speed=min(max(scenario.speed, slowest), fastest)),
        dataset=_within(settings.dataset, reached),
    )


def _within(drives: Any, reached: dict[str, Any]) -> Any:
    """Return settings of drives, and of a law for them, that stay inside of logs."""
    if not hasattr(drives, "speed"):
        return drives
    (low, high), (slowest, fastest) = drives.speed, reached["speed"]
    speed = max(low, slowest), min(high, fastest)
    if not speed[0] < speed[1]:
        raise ValueError(
            f"dataset.speed is {low:g} to {high:g} m/s, "
            f"the logs of the vehicle reach {slowest:.3g} to {fastest:.3g}"
        )
    changes: dict[str, Any] = {"speed": speed}
    for name in STEEPEST:
        if hasattr(drives, name):
            changes[name] = min(getattr(drives, name), reached[name])
    if hasattr(drives, "law"):
        changes["law"] = _within(drives.law, reached)
    return replace(drives, **changes)


def _identify(dataset: Dataset, dt: float) -> dict[str, Any]:
    """Fit a model of one step to logs; return its arrays, and what the logs reach."""
    began = time.perf_counter()
    model, start, fitted = regression(dataset, *jax.random.split(jax.random.key(0)))
    found = {"least squares": _linear(start), "regression": fitted}
    horizon = min(HORIZON, dataset.validation.controls.shape[1])

    def error(params: Params) -> float:
        """Root mean square error of the position after the horizon [m]."""
        ahead = open_loop(model, params, dataset.validation, horizon=horizon)
        return float(jnp.nan_to_num(jnp.hypot(*ahead[-1, :2]), nan=jnp.inf))

    errors = {name: error(params) for name, params in found.items()}
    best = min(errors, key=lambda name: errors[name])
    told = ", ".join(f"{value:.3g} m by {name}" for name, value in errors.items())
    store.print_message(
        f"fitted a model to the logs in {time.perf_counter() - began:.0f} s; position "
        f"error {horizon * dt:.2g} s ahead on validation: {told}; it is the {best}"
    )
    parts = [getattr(dataset, part) for part in PARTS]
    states, controls, _ = map(np.concatenate, zip(*parts, strict=True))
    # A law steers more than a driver: at the ends of the logs it would stop short.
    low, high = controls.min(axis=(0, 1)), controls.max(axis=(0, 1))
    more = 0.5 * (HEADROOM - 1.0) * (high - low)
    fitted = {"space": measure_space(dataset)._asdict(), "params": found[best]}
    limits = dict(zip(LIMITS, (low - more, high + more), strict=True))
    return limits | _drives(states, dt) | models.flat(fitted)


def _drives(states: np.ndarray, dt: float) -> dict[str, Any]:
    """Range of the speed, and the largest of `STEEPEST`, without outliers."""
    speed, lag = states[..., 3], min(5, states.shape[1] - 1)
    # Over half a second: the noise of a sensor is no turn.
    rates = (states[:, lag:, 2:4] - states[:, :-lag, 2:4]) / (lag * dt)
    turn, push = np.abs(np.moveaxis(rates, -1, 0))
    moving = np.maximum(np.abs(speed[:, lag:]), 1.0)
    steepest = turn / moving, turn * moving, push
    largest = (np.quantile(values, 0.998) for values in steepest)
    return {
        "speed": np.quantile(speed, [0.001, 0.999]),
        **dict(zip(STEEPEST, largest, strict=True)),
    }


def regression(
    dataset: Dataset, start_key: Key, fit_key: Key
) -> tuple[Model, Params, Params]:
    """The model of one step, its parameters before any training, and after it."""
    model, start = _one_step(dataset, start_key)
    loss, draw = one_step_loss(model), partial(random_windows, batch=512, length=1)
    fitted = descend(start, loss, draw, dataset.train, fit_key, steps=REGRESSION)
    return model, start, fitted


def least_squares(dataset: Dataset) -> Step:
    """Return the best linear model of one step, of the training part of a data set."""
    model, params = _one_step(dataset, jax.random.key(0))
    return models.step_of(model, _linear(params))


def _linear(params: Params) -> Params:
    """The linear part alone: without a scale the network has no say."""
    return params | {"scale": 0.0 * params["scale"]}


def _one_step(dataset: Dataset, key: Key) -> tuple[Model, Params]:
    model = models.one_step(measure_space(dataset))
    identify: Any = model.fitting.identify
    return model, jax.jit(identify)(dataset.train, dataset.validation, key)
