"""From plain settings (nested dicts) to vehicles, models, controllers and scenarios; knows no file and no Hydra."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

import jax.numpy as jnp

from sfkd_jax import control, datasets, models, scenarios, vehicle
from sfkd_jax.types import Control, Controller, Environment, Model, Reference, Space, State

Settings = Mapping[str, Any]

ENVS = ("measured", "estimated", "none")
"""How a controller learns of the environment."""
PLANTS = {"kinematic": vehicle.kinematic, "dynamic": vehicle.dynamic, "own": vehicle.own}
INNER_LOOPS = ("none", "speed")


class System(NamedTuple):
    """A row of a table: a model with its parameters, what it is told about the environment, and its certificate."""

    model: Model
    params: Any
    env: str
    certificate: dict[str, Any] | None = None


def choose(table: Mapping[str, Any], name: str, what: str) -> Any:
    """`table[name]`, or an error that lists the choices."""
    if name not in table:
        raise ValueError(f"unknown {what} {name!r}; choose one of {', '.join(sorted(table))}")
    return table[name]


def without(settings: Settings, *names: str) -> dict[str, Any]:
    """Settings of a factory, sequences as tuples: the rest after the names that choose it."""
    rest = {name: value for name, value in settings.items() if name not in names}
    return {name: tuple(value) if isinstance(value, list) else value for name, value in rest.items()}


def build_vehicle(settings: Settings) -> vehicle.Vehicle:
    """A plant by name, wrapped in its inner loop."""
    loop = settings["inner_loop"]
    if loop not in INNER_LOOPS:
        raise ValueError(f"unknown vehicle.inner_loop {loop!r}; choose one of {', '.join(INNER_LOOPS)}")
    factory = choose(PLANTS, settings["name"], "vehicle")
    options = without(settings, "name", "inner_loop", "speed_gain")
    if options.get("step") is not None:
        options["step"] = vehicle.step_named(options["step"])
    plant = factory(**options)
    return vehicle.with_speed_loop(plant, gain=settings["speed_gain"]) if loop == "speed" else plant


def build_model(settings: Settings, space: Space, plant: vehicle.Vehicle) -> Model:
    """A learned model by the name of its factory; those that lean on textbook knowledge get it from the vehicle."""
    factory = choose(models.FACTORIES, settings["name"], "model")
    known = {"dt": plant.dt, "nominal": plant.nominal_derivative}
    given = {name: value for name, value in known.items() if name in inspect.signature(factory).parameters}
    return factory(space, **given, **without(settings, "name", "system"))


def space_to_settings(space: Space) -> dict[str, list[float]]:
    """Scales as plain lists, to lie in a manifest."""
    return {name: [float(entry) for entry in value] for name, value in space._asdict().items()}


def space_from_settings(settings: Settings) -> Space:
    """Scales from a manifest."""
    return Space(**{name: jnp.asarray(settings[name], dtype=jnp.float32) for name in Space._fields})


def build_controller(
    settings: Settings,
    model: Model,
    plant: vehicle.Vehicle,
    *,
    env_low: Any = None,
    env_high: Any = None,
    certificate: Settings | None = None,
    env: str = "measured",
) -> Controller:
    """The planner of the settings, watched by a monitor if there is a certificate, told an estimate if `env` asks.

    Raises:
        ValueError: an unknown planner, or a vehicle without limits of its controls.
    """
    if not plant.control_low:
        raise ValueError("a controller needs vehicle.control_low and vehicle.control_high, as in [-0.4,-3.0]")
    build = choose(PLANNERS, settings.get("planner", "mppi"), "controller.planner")
    planner = build(settings, model, plant, env_low, env_high)
    watched = planner if certificate is None else _monitored(planner, settings, model, certificate)
    return _estimated(watched, settings, model, plant, env_low, env_high) if env == "estimated" else watched


def _monitored(planner: Controller, settings: Settings, model: Model, certificate: Settings) -> Controller:
    corners = {name: certificate["boxes"][name] for name in ("state", "control", "env")}
    boxes = {f"{name}_{side}": tuple(box[k]) for name, box in corners.items() for k, side in enumerate(("low", "high"))}
    bounds = tuple(certificate["monitor"]["bounds"])
    return control.monitored(planner, model, bounds=bounds, **boxes, **without(settings.get("monitor", {})))


def _estimated(
    planner: Controller, settings: Settings, model: Model, plant: vehicle.Vehicle, env_low: Any, env_high: Any
) -> Controller:
    box = {"env_low": _floats(env_low), "env_high": _floats(env_high)}
    sizes = {"states": len(plant.state_names), "controls": len(plant.control_low)}
    return control.estimated(planner, model, **box, **sizes, **without(settings.get("estimator", {})))


def _sampled(
    search: str, settings: Settings, model: Model, plant: vehicle.Vehicle, env_low: Any, env_high: Any
) -> Controller:
    """A planner that searches around the path-following law (`sampling: feedback`), the model's own, or nothing."""
    laws = {"feedback": _feedback, "model": _model_law, "plain": _no_feedback}
    law = choose(laws, settings["sampling"], "controller.sampling")
    task = control.path_tracking(
        model,
        control.tracking_cost(dt=plant.dt, speed_loop=plant.speed_loop, **without(settings["cost"])),
        law(settings, plant),
        dt=plant.dt,
        control_low=plant.control_low,
        control_high=plant.control_high,
        ancillary=_model_law(settings, plant) if settings["ancillary"] else None,
        **without(settings["task"]),
    )
    boxes = {"env_low": _floats(env_low), "env_high": _floats(env_high)}
    return SEARCHES[search](task, **boxes, **without(settings[search]))


def _feedback(settings: Settings, plant: vehicle.Vehicle) -> control.Law:
    gains = without(settings["feedback"])
    return control.path_feedback(wheelbase=plant.wheelbase, speed_loop=plant.speed_loop, **gains)


def _model_law(settings: Settings, plant: vehicle.Vehicle) -> control.ModelLaw:
    return control.ModelLaw(dt=plant.dt, **without(settings["model_law"]))


def _no_feedback(settings: Settings, plant: vehicle.Vehicle) -> control.Law:
    del settings
    return control.no_feedback(speed_loop=plant.speed_loop)


def _koopman_mpc(settings: Settings, model: Model, plant: vehicle.Vehicle, env_low: Any, env_high: Any) -> Controller:
    """A quadratic program over a linear predictor, under the cost that the samplers have."""
    return control.koopman_mpc(
        model,
        dt=plant.dt,
        control_low=plant.control_low,
        control_high=plant.control_high,
        speed_loop=plant.speed_loop,
        terminal_weight=settings["task"]["terminal_weight"],
        env_low=_floats(env_low),
        env_high=_floats(env_high),
        **without(settings["cost"]),
        **without(settings["koopman_mpc"]),
    )


def _floats(values: Any) -> tuple[float, ...] | None:
    return None if values is None else tuple(map(float, values))


SEARCHES = {"mppi": control.mppi, "cem": control.cem, "gradient": control.gradient_planner}
PLANNERS = {search: partial(_sampled, search) for search in SEARCHES} | {"koopman_mpc": _koopman_mpc}


def controller_horizon(settings: Settings) -> int:
    """How many steps of the reference a controller wants to see."""
    return settings[settings.get("planner", "mppi")]["horizon"]


def build_scenario(settings: Settings, plant: vehicle.Vehicle, *, duration: float) -> scenarios.Family:
    """The scenario family that a vehicle is to drive, episodes of `duration` [s]."""
    return scenarios.scenario(**without(settings), duration=duration, state_size=len(plant.state_names), dt=plant.dt)


def build_driver(plant: vehicle.Vehicle) -> datasets.Driver:
    """The path-following law that keeps data collection on the road."""
    law = control.path_feedback(wheelbase=plant.wheelbase, speed_loop=plant.speed_loop)

    def driver(state: State, reference: Reference) -> Control:
        curvature = control.reference_curvature(reference)[0]
        return law(control.path_errors(state, reference[0], curvature), curvature, reference[0, 3])

    return driver


def reference_systems(plant: vehicle.Vehicle) -> dict[str, System]:
    """Rows that need no learning: the nominal bicycle, the true plant, and the true plant wrong about e."""

    def biased(entry: int, factor: float) -> Callable[[Environment], Environment]:
        return lambda env: env.at[entry].multiply(factor)

    oracle = partial(models.physics, plant.step)
    rows = {
        "nominal": System(models.physics(plant.nominal), {}, "none"),
        "oracle": System(oracle(), {}, "measured"),
    }
    distortions = {"friction_x0.7": (0, 0.7), "friction_x1.3": (0, 1.3), "wind_x0": (1, 0.0), "wind_x2": (1, 2.0)}
    for name, change in distortions.items():
        rows[f"oracle_{name}"] = System(oracle(distort=biased(*change)), {}, "measured")
    return rows
