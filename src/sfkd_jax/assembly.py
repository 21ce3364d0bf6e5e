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
    """A row of a table: a model with its parameters, what it is told about the environment, and its certificate.

    Of a model in path coordinates also the law that it was learned around.
    """

    model: Model
    params: Any
    env: str
    certificate: dict[str, Any] | None = None
    law: control.PathLaw | None = None


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
    law: control.PathLaw | None = None,
) -> Controller:
    """The planner of the settings, watched by a monitor if there is a certificate, told an estimate if `env` asks.

    Args:
        law: of a model in path coordinates, the one that it was learned around.

    Raises:
        ValueError: an unknown planner, a vehicle without limits of its controls, or a model and a planner of
            different frames.
    """
    if not plant.control_low:
        raise ValueError("a controller needs vehicle.control_low and vehicle.control_high, as in [-0.4,-3.0]")
    build = choose(PLANNERS, settings.get("planner", "mppi"), "controller.planner")
    if model.along_path:
        if settings["sampling"] != "law" or env == "estimated" or law is None:
            raise ValueError(
                "a model in path coordinates needs controller.sampling=law, its law, and env=measured or none"
            )
        return build(settings, model, plant, env_low, env_high, law)
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
    search: str,
    settings: Settings,
    model: Model,
    plant: vehicle.Vehicle,
    env_low: Any,
    env_high: Any,
    law: control.PathLaw | None = None,
) -> Controller:
    """A planner that searches around a law: the path-following one (`sampling: feedback`), the model's own, none.

    In path coordinates it is the law of the policy, and the model already holds it (`sampling: law`).
    """
    cost = control.tracking_cost(dt=plant.dt, speed_loop=plant.speed_loop, **without(settings["cost"]))
    limits = {"dt": plant.dt, "control_low": plant.control_low, "control_high": plant.control_high}
    if law is not None:
        task = control.following_law(model, cost, law, **limits, **without(settings["task"], "latent_weight"))
    else:
        laws = {"feedback": _feedback, "model": _model_law, "plain": _no_feedback}
        around = choose(laws, settings["sampling"], "controller.sampling")(settings, plant)
        ancillary = _model_law(settings, plant) if settings["ancillary"] else None
        task = control.path_tracking(model, cost, around, **limits, ancillary=ancillary, **without(settings["task"]))
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


def build_law(settings: Settings, plant: vehicle.Vehicle) -> control.PathLaw | None:
    """The law of a data set in path coordinates, derived from the vehicle's own step; None for other data sets.

    Args:
        settings: of the data set. plant: any vehicle with limits of its controls.
    """
    if "law" not in settings:
        return None
    box = {name: _floats(settings[name]) for name in ("env_low", "env_high")}
    size = len(plant.state_names) - 1
    return control.derive_path_law(plant.step, coordinates=size, **box, **without(settings["law"]))


def reference_systems(plant: vehicle.Vehicle, law: control.PathLaw | None = None) -> dict[str, System]:
    """Rows that need no learning: the nominal bicycle, the true plant, and the true plant wrong about e.

    With a law they are those of the loop around the plant, in path coordinates.
    """

    def biased(entry: int, factor: float) -> Callable[[Environment], Environment]:
        return lambda env: env.at[entry].multiply(factor)

    along = law is not None
    plant = plant if law is None else vehicle.along_path(plant, law)
    oracle = partial(models.physics, plant.step, along_path=along)
    rows = {
        "nominal": System(models.physics(plant.nominal, along_path=along), {}, "none"),
        "oracle": System(oracle(), {}, "measured"),
    }
    distortions = {"friction_x0.7": (0, 0.7), "friction_x1.3": (0, 1.3), "wind_x0": (1, 0.0), "wind_x2": (1, 2.0)}
    for name, change in distortions.items():
        rows[f"oracle_{name}"] = System(oracle(distort=biased(*change)), {}, "measured")
    return {name: row._replace(law=law) for name, row in rows.items()}
