"""A vehicle of logs: a model of one step that is fitted to them drives in its place."""

from __future__ import annotations

import time
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sfkd_jax import assembly, models, store
from sfkd_jax.assembly import LoggedVehicleSettings
from sfkd_jax.data import PARTS, Dataset, measure_space, random_windows
from sfkd_jax.driving.logs import Columns, LoggedDataset, fingerprint, from_logs
from sfkd_jax.driving.plants import Vehicle
from sfkd_jax.evaluation import open_loop
from sfkd_jax.experiment.options import EnvironmentSettings, LogSettings, Settings
from sfkd_jax.settings import arguments, replace
from sfkd_jax.training import descend, one_step_loss
from sfkd_jax.types import Key, Model, Params, Step

REGRESSION_STEPS = 16_000
"""Optimiser steps of the model that a law is derived from."""
STEEPEST = ("peak_curvature", "lateral_acceleration", "acceleration")
"""Settings of drives that are reduced to what the logs of a vehicle reach."""
LIMITS = ("control_low", "control_high")
"""Settings of a vehicle that hold the limits of its actuators."""
HEADROOM = 1.5
"""Limits that no setting states are so many times as wide as the controls in logs."""
HORIZON = 20
"""Steps ahead at which models are compared."""


def read(
    plant: Vehicle,
    environment: EnvironmentSettings,
    logs: LogSettings | LoggedVehicleSettings,
) -> LoggedDataset:
    """Read the logs of a vehicle."""
    columns = Columns(**arguments(logs.columns, Columns))
    if len(columns.state) != len(plant.state_names):
        raise ValueError(
            f"dataset.columns.state names {len(columns.state)} columns, "
            f"vehicle {plant.name} has {', '.join(plant.state_names)}; "
            "name as many, in this order"
        )
    store.print_message(f"reading {logs.path}")
    options: Any = arguments(logs, from_logs)
    # These are settings of the vehicle, not of its logs.
    options["dt"] = plant.dt
    options["wheelbase"] = plant.wheelbase
    return from_logs(
        str(logs.path),
        columns,
        report=store.print_message,
        needs_environment=environment.is_known,
        limits=(plant.control_low or None, plant.control_high or None),
        **environment.box,
        env_roles=environment.roles,
        **options,
    )


def with_identified(settings: Settings) -> Settings:
    """Return the settings with a model in place of a vehicle that is known from logs.

    Its limits, the box of e and the class of drives become those that the logs reach:
    beyond them a model extrapolates. Other settings are returned as they are.
    """
    vehicle = settings.vehicle
    environment = settings.environment
    if not isinstance(vehicle, LoggedVehicleSettings):
        return settings
    if vehicle.path is None:
        raise ValueError("vehicle=logged needs vehicle.path=FOLDER, where its logs are")
    vehicle = replace(vehicle, contents=fingerprint(vehicle.path))
    path, arrays = _ensure_identified(Path(settings.root), vehicle, environment)
    reached = {name: np.asarray(value).tolist() for name, value in arrays.items()}
    limits = {name: getattr(vehicle, name) or reached[name] for name in LIMITS}
    scenario: Any = settings.scenario
    slowest, fastest = reached["speed"]
    return replace(
        settings,
        vehicle=replace(vehicle, identified=str(path), **limits),
        environment=replace(
            environment,
            low=reached["env_low"],
            high=reached["env_high"],
            names=environment.names or _env_columns(environment, vehicle),
        ),
        scenario=replace(scenario, speed=min(max(scenario.speed, slowest), fastest)),
        dataset=_within(settings.dataset, reached),
    )


def _env_columns(
    environment: EnvironmentSettings, vehicle: LoggedVehicleSettings
) -> tuple[str, ...]:
    """Return the columns of the logs that hold e; none if nobody measured it."""
    if environment.is_known:
        return vehicle.columns.environment
    return ()


def _ensure_identified(
    root: Path, vehicle: LoggedVehicleSettings, environment: EnvironmentSettings
) -> tuple[Path, dict[str, np.ndarray]]:
    """Return the file of the model of a vehicle, and its arrays; fit it if missing.

    Args:
        root: the directory of all artefacts.
        vehicle: with the hash of its logs in `contents`.
        environment: settings of E.
    """
    config = store.plain({"vehicle": vehicle, "environment": environment.box})
    # Contents instead of the path: the same logs elsewhere make the same model.
    del config["vehicle"]["path"]
    config["environment_known"] = environment.is_known
    folder = f"logged-{store.sha256(config)[:8]}"
    path = root / "vehicles" / folder / "vehicle.safetensors"
    with store.locked(path.parent, wait=True):  # other runs share the vehicle
        if not path.is_file():
            plant = assembly.build_vehicle(vehicle)
            logged = read(plant, environment, vehicle).dataset
            names = _env_columns(environment, vehicle)
            env_low, env_high = _logged_env_box(logged, names)
            arrays = _identify(logged, vehicle.dt)
            arrays["env_low"] = env_low
            arrays["env_high"] = env_high
            store.write_arrays(path, arrays, kind=assembly.IDENTIFIED, config=config)
    arrays, _ = store.read_arrays(path, kind=assembly.IDENTIFIED, config=config)
    return path, arrays


def _logged_env_box(
    logged: Dataset, names: tuple[str, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the box of e in logs.

    Args:
        logged: the data set of the logs.
        names: of the entries of e; () if nobody measured it.

    Raises:
        ValueError: an entry of e never changes.
    """
    low = np.asarray(logged.env_low)
    high = np.asarray(logged.env_high)
    if not names:  # nothing depends on what nobody measured
        return -np.ones_like(low), np.ones_like(high)
    constant = low == high
    if constant.any():
        raise ValueError(
            f"{names[int(constant.argmax())]} is always the same in the logs: "
            "leave it out of vehicle.columns.environment"
        )
    return low, high


def _within(drives: Any, reached: dict[str, Any]) -> Any:
    """Return settings of drives, and of a law for them, that stay inside of logs."""
    if not hasattr(drives, "speed"):
        return drives
    low, high = drives.speed
    slowest, fastest = reached["speed"]
    speed = (max(low, slowest), min(high, fastest))
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
    start_key, fit_key = jax.random.split(jax.random.key(0))
    model, start, fitted = regression(dataset, start_key, fit_key)
    candidates = {"least squares": _linear(start), "regression": fitted}
    horizon = min(HORIZON, dataset.validation.controls.shape[1])

    def error(params: Params) -> float:
        """Return the RMS error of the position after the horizon [m]."""
        errors = open_loop(model, params, dataset.validation, horizon=horizon)
        position = jnp.hypot(*errors[-1, :2])
        return float(jnp.nan_to_num(position, nan=jnp.inf))

    errors = {name: error(params) for name, params in candidates.items()}
    best = min(errors, key=errors.__getitem__)
    listed = ", ".join(f"{value:.3g} m by {name}" for name, value in errors.items())
    store.print_message(
        f"fitted a model to the logs in {time.perf_counter() - began:.0f} s; position "
        f"error {horizon * dt:.2g} s ahead on validation: {listed}; it is the {best}"
    )
    parts = [getattr(dataset, part) for part in PARTS]
    states = np.concatenate([part.states for part in parts])
    controls = np.concatenate([part.controls for part in parts])
    # A law steers more than a driver: at the ends of the logs it would stop short.
    low = controls.min(axis=(0, 1))
    high = controls.max(axis=(0, 1))
    headroom = 0.5 * (HEADROOM - 1.0) * (high - low)
    of_model = {"space": measure_space(dataset)._asdict(), "params": candidates[best]}
    return {
        "control_low": low - headroom,
        "control_high": high + headroom,
        **_reached(states, dt),
        **models.flat(of_model),
    }


def _reached(states: np.ndarray, dt: float) -> dict[str, Any]:
    """Return the range of the speed, and the largest of `STEEPEST`, without outliers.

    Args:
        states: (run, time, state).
        dt: sampling period [s].
    """
    speed = states[..., 3]
    # Over half a second: the noise of a sensor is no turn.
    lag = min(5, states.shape[1] - 1)
    rates = (states[:, lag:, 2:4] - states[:, :-lag, 2:4]) / (lag * dt)
    yaw_rate, acceleration = np.abs(np.moveaxis(rates, -1, 0))
    moving = np.maximum(np.abs(speed[:, lag:]), 1.0)
    return {
        "speed": np.quantile(speed, [0.001, 0.999]),
        "peak_curvature": np.quantile(yaw_rate / moving, 0.998),
        "lateral_acceleration": np.quantile(yaw_rate * moving, 0.998),
        "acceleration": np.quantile(acceleration, 0.998),
    }


def regression(
    dataset: Dataset, start_key: Key, fit_key: Key
) -> tuple[Model, Params, Params]:
    """Return a model of one step, its parameters before training, and after it."""
    model, start = _one_step(dataset, start_key)
    fitted = descend(
        start,
        one_step_loss(model),
        partial(random_windows, batch=512, length=1),
        dataset.train,
        fit_key,
        steps=REGRESSION_STEPS,
    )
    return model, start, fitted


def least_squares(dataset: Dataset) -> Step:
    """Return the step of the best linear model of the training part of a data set."""
    model, params = _one_step(dataset, jax.random.key(0))
    return models.step_of(model, _linear(params))


def _linear(params: Params) -> Params:
    """Return the parameters without the network, whose output is scaled by 0."""
    return {**params, "scale": 0.0 * params["scale"]}


def _one_step(dataset: Dataset, key: Key) -> tuple[Model, Params]:
    """Return a model of one step with its parameters by least squares."""
    model = models.one_step(measure_space(dataset))
    identify: Any = model.fitting.identify
    return model, jax.jit(identify)(dataset.train, dataset.validation, key)
